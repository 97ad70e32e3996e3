"""All that decides a plan beside demonstrations, scene and language model, in one value."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, get_args

from numpy.typing import ArrayLike

from robust_instant_policy.checks import check_name, checked_positive, checked_whole
from robust_instant_policy.context import Frames, Layout
from robust_instant_policy.errors import InvalidValueError, UnknownNameError, UsageError
from robust_instant_policy.geometry import as_numbers
from robust_instant_policy.perception import CORRESPONDENCES, PAPER_REAL, PAPER_SIMULATION, DescriptorSettings
from robust_instant_policy.plugins import is_own
from robust_instant_policy.policies.own_keypoints import KeypointSource
from robust_instant_policy.regression import DEFAULT_DOF
from robust_instant_policy.regression.gripper import ESTIMATORS
from robust_instant_policy.trajectory import TARGET_STEPS

DOWNSAMPLING = ("masked", "uniform")
COLUMNS = ("auto", "sim", "real")
WORDS = {
    "keypoints": CORRESPONDENCES,
    "column": COLUMNS,
    "frames": get_args(Frames),
    "layout": get_args(Layout),
    "downsampling": DOWNSAMPLING,
    "estimator": ESTIMATORS,
}
# What the configurations differ in. Q, ν, K, downsampling and temperature have the paper's values by default.
_PAPER: dict[str, Any] = {"features": "dino", "keypoints": "nearest", "frames": "world", "layout": "sequence"}
CONFIGS: dict[str, dict[str, Any]] = {
    "adaptive": {},
    "paper": {**_PAPER, "column": "sim", "estimator": "network-sim"},
    "paper-real": {**_PAPER, "column": "real", "estimator": "network-real"},
}


@dataclass(frozen=True)
class Settings:
    """Equal settings give equal plans. Hashable; raises an error that names the setting where one makes no sense.

    Keypoints: ``num_keypoints`` K; ``features`` names the image descriptors, ``column`` that of the paper's Table II
    with their parameters ("auto": by the size of the images); ``keypoints`` is how they are found in an image,
    "registration" of objects, "nearest" descriptors, or a source of one's own, a `KeypointSource` or the
    ``module:Class`` of one; ``workspace ((x, y, z), (x, y, z))`` are the lower and upper corner of what is registered,
    metres, world. Trajectories: ``downsampling`` "masked" or "uniform"
    to ``num_steps`` steps. Prompt: ``frames`` and ``layout``, see `write_prompt`. Samples: ``num_queries`` Q at
    ``temperature``; with ``adaptive``, three at first and up to Q while the candidates agree little. Aggregation:
    ``dof`` ν, infinity for the Gaussian ablation; ``estimator``, see `robust_gripper_trajectory`. ``seed`` is that of
    the keypoints, the samples and the networks.
    """

    num_keypoints: int = 10
    features: str = "auto"
    column: str = "auto"
    keypoints: str | KeypointSource = "registration"
    workspace: tuple[tuple[float, ...], ...] | None = None
    downsampling: str = "masked"
    num_steps: int = TARGET_STEPS
    frames: Frames = "adaptive"
    layout: Layout = "factorised"
    seed: int = 0
    temperature: float = 0.7
    num_queries: int = 5
    adaptive: bool = False
    dof: float = DEFAULT_DOF
    estimator: str = "em"

    def __post_init__(self) -> None:
        for name, least in (("num_keypoints", 1), ("num_steps", 2), ("num_queries", 1), ("seed", 0)):
            checked_whole(name, getattr(self, name), least)
        checked_positive("dof", self.dof, infinite=True)
        if self.temperature != 0:
            checked_positive("temperature", self.temperature)
        for name, known in WORDS.items():
            word = getattr(self, name)
            own = name == "keypoints" and (is_own(word) if isinstance(word, str) else hasattr(word, "locate"))
            if not own and word not in known:
                raise UnknownNameError(name, word, (*known, "module:Class") if name == "keypoints" else known)
        if self.workspace is not None:
            object.__setattr__(self, "workspace", _corners(self.workspace))

    @classmethod
    def of(cls, config: str) -> Settings:
        """Those of the configuration ``config``, one of `CONFIGS`; raises `UnknownNameError`.

        "adaptive" is the default. "paper" is what Oh et al. (2025) did and nothing else, with the columns "Sim" of
        their Table II, "paper-real" the same with the columns "Real": DINO keypoints by nearest neighbours, whole
        trajectories in the world frame in one prompt, and the mean of the networks.
        """
        check_name("config", config, CONFIGS)
        return cls(**CONFIGS[config])

    @property
    def of_context(self) -> Settings:
        """These settings with what the context does not depend on at its default: equal ones give equal contexts."""
        names = (
            "num_keypoints", "features", "column", "keypoints", "workspace", "downsampling", "num_steps", "frames",
            "layout", "seed",
        )  # fmt: skip
        return Settings(**{name: getattr(self, name) for name in names})

    @property
    def descriptors(self) -> DescriptorSettings | None:
        """Parameters of the descriptors; None where the size of the images decides."""
        return {"auto": None, "sim": PAPER_SIMULATION, "real": PAPER_REAL}[self.column]

    @property
    def of_samples(self) -> Settings:
        """The same for samples of the language model, however many are asked for."""
        return replace(self.of_context, temperature=self.temperature)

    def changed(self, **options: object) -> Settings:
        """These settings but for ``options``; raises `UsageError` for one that does not exist."""
        known = [field.name for field in fields(self)]
        for name in options:
            if name not in known:
                raise UsageError(f"unknown setting {name!r}; known: {', '.join(known)}")
        return replace(self, **options)  # type: ignore[arg-type]


def _corners(workspace: ArrayLike) -> tuple[tuple[float, ...], ...]:
    corners = as_numbers("workspace", workspace)
    if corners.shape != (2, 3) or not (corners[0] < corners[1]).all():
        raise InvalidValueError(f"workspace must be (2, 3), lower and upper corner in metres, got {workspace!r}")
    return tuple(tuple(map(float, corner)) for corner in corners)
