"""The key of a row, independent of the run: a method with its settings, and a scene."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from robust_instant_policy.errors import InvalidValueError
from robust_instant_policy.files import file_stem
from robust_instant_policy.policies import (
    ASKING_METHODS,
    CONFIGS,
    FRAME_METHODS,
    IMAGE_METHODS,
    METHOD_NAMES,
    REGRESSING_METHODS,
    TRAINED_METHODS,
)
from robust_instant_policy.policies.settings import Settings
from robust_instant_policy.policies.training import DEFAULT_STEPS
from robust_instant_policy.regression import DEFAULT_DOF

PAPER_CONFIGS = ("paper", "paper-real")  # whose rows may stand beside the paper's numbers
REPLAY = "replay"  # no method: the demonstrator's own trajectory for the scene, thinned out and executed like a plan
ROW_METHODS = (REPLAY, *METHOD_NAMES)
EXACT = "em-number"  # the model of the paper's networks, fitted exactly: an estimator of the paper's configuration, too


@dataclass(frozen=True)
class Variant:
    """A method with every setting that its plans depend on, beside demonstrations and scene.

    ``demos`` demonstrations are shown; ``queries`` is the paper's Q, ``dof`` its ν; ``downsampling``, ``frames``,
    ``layout``, ``features``, ``keypoints``, ``column`` and ``estimator`` are those of `Settings`; ``config`` names
    their configuration: the nearest of `CONFIGS`, with the differences (computed, never an argument);
    ``model`` names the language model; ``steps`` is how long a method is trained; ``deadline_s`` bounds the
    sampling for one plan; with ``replan`` > 0 the method plans again after so many waypoints; ``code`` is the
    `code_digest` of the package, which covers all settings without a field; ``demonstrations`` is the digest of the
    demonstrations, which are of the set ``demo_set`` (see `scenes.first_demonstration_seed`). A setting that a method
    does not use is empty (a number: None), so that no work has two names; RIP with ν = ∞ is "rip-gauss", with the
    estimator "mean" it is "mean". A setting is also empty in rows of versions that did not store it.
    """

    method: str
    demos: int = 10
    queries: int = 5
    dof: float | None = DEFAULT_DOF
    downsampling: str = "masked"
    frames: str = "adaptive"
    layout: str = "factorised"
    features: str = "auto"
    model: str = ""
    steps: int | None = DEFAULT_STEPS
    deadline_s: float | None = None
    code: str = ""
    demonstrations: str = ""
    demo_set: int = 0
    keypoints: str = "registration"
    column: str = "auto"
    estimator: str = "em"
    config: str = ""
    replan: int = 0

    @classmethod
    def of(cls, settings: Settings, method: str = "rip", **others: Any) -> Variant:
        """``method`` with those of the ``settings`` that decide a row; ``others`` are fields of a variant."""
        names = ("downsampling", "frames", "layout", "features", "keypoints", "column", "estimator")
        return cls(method, **{name: getattr(settings, name) for name in names}, **others)

    def __post_init__(self) -> None:
        changed: dict[str, str | float | None] = {}
        method = self.method
        if method in ("rip", "rip-gauss") and self.estimator == "mean":
            method = "mean"
        elif method == "rip" and self.dof is not None and math.isinf(self.dof):
            method = "rip-gauss"
        changed["method"] = method
        if method not in TRAINED_METHODS:
            changed["steps"] = None
        if method == "rip-gauss":
            changed["dof"] = math.inf
        elif method not in REGRESSING_METHODS:
            changed["dof"] = None
        if method not in REGRESSING_METHODS:
            changed["estimator"] = ""
        if method not in ASKING_METHODS:
            changed |= {"layout": "", "model": "", "deadline_s": None}
        if method not in FRAME_METHODS:
            changed["frames"] = ""
        if method in IMAGE_METHODS or method == REPLAY:
            changed |= {"keypoints": "", "column": ""}
        if method in TRAINED_METHODS or method == REPLAY:
            changed["replan"] = 0
        for name, value in changed.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "config", _config(self))

    @property
    def file_name(self) -> str:
        """All settings, so that different variants have different names."""
        features = "" if self.features == "auto" else self.features
        deadline = "" if self.deadline_s is None else f"{self.deadline_s:g}s"
        column = "" if self.column == "auto" else self.column
        words = (str(self), column, features, self.model, deadline, self.code, self.demonstrations)
        return re.sub(r"[^\w.-]+", "_", "-".join(word for word in words if word))

    def __str__(self) -> str:
        """The settings in short, without descriptors, language model and versions."""
        dof = "" if self.dof is None else f"v{self.dof:g}"
        words = (
            self.method,
            f"{self.demos}demos",
            f"q{self.queries}",
            dof,
            self.config,
            self.downsampling,
            self.keypoints,
            self.frames,
            self.layout,
            self.estimator,
            "" if self.steps is None else f"{self.steps}steps",
            f"replan{self.replan}" if self.replan else "",
            f"set{self.demo_set}" if self.demo_set else "",
        )
        return "-".join(word for word in words if word)


_ADAPTIVE = {
    "keypoints": "registration", "column": "auto", "frames": "adaptive", "layout": "factorised", "estimator": "em"
}  # fmt: skip
_CONFIGURED = tuple(_ADAPTIVE)
_NAMES = ("config", *(field.name for field in fields(Variant) if field.name not in ("method", "config")))


def labels(variants: Sequence[Variant]) -> list[str]:
    """Names of ``variants``: the method and, in parentheses, the settings in which variants of one method differ.

    >>> labels([Variant("rip"), Variant("kat", model="a"), Variant("kat", model="b")])
    ['rip', 'kat (model a)', 'kat (model b)']
    """
    told = []
    for variant in variants:
        same = [other for other in variants if other.method == variant.method]
        names = [name for name in _NAMES if len({getattr(other, name) for other in same}) > 1]
        if "config" in names:  # it says what follows from it
            names = [name for name in names if name not in _CONFIGURED or _differ_within_a_config(same, name)]
        settings = ", ".join(f"{name} {_told(getattr(variant, name))}" for name in names)
        told.append(f"{variant.method} ({settings})" if settings else variant.method)
    return told


def _told(value: str | float | None) -> str:
    return "unknown" if value in ("", None) else str(value)


def configs(variants: Sequence[Variant]) -> list[str]:
    """The configurations of ``variants``, in a fixed order; ``[""]`` if no method depends on one, such as dp."""
    known = {variant.config for variant in variants} - {""}
    return sorted(known, key=lambda config: (list(CONFIGS).index(config.split(",")[0]), config)) or [""]


def _config(variant: Variant) -> str:
    used = {name: value for name in _CONFIGURED if (value := getattr(variant, name))}
    if not used:
        return ""
    if variant.method == "neighbours":  # they need the factorised layout
        used |= {"frames": "adaptive", "layout": "factorised"}
    differences = {
        name: [
            f"{key} {value}"
            for key, value in used.items()
            if value != {**_ADAPTIVE, **settings}[key] and not (name in PAPER_CONFIGS and value == EXACT)
        ]
        for name, settings in CONFIGS.items()
    }
    nearest = min(differences, key=lambda name: len(differences[name]))
    return ", ".join((nearest, *differences[nearest]))


def _differ_within_a_config(variants: Sequence[Variant], name: str) -> bool:
    return any(
        one.config == other.config and getattr(one, name) != getattr(other, name)
        for one in variants
        for other in variants
    )


def values(variants: Sequence[Variant], value: Callable[[Variant], str]) -> list[str]:
    """The ``value`` of each variant if all are different, else their `labels`."""
    told = [value(variant) for variant in variants]
    return told if len(set(told)) == len(told) else labels(variants)


def dof_symbol(variant: Variant) -> str:
    if variant.method == "mean":
        return "mean"
    return "∞" if variant.dof is None or math.isinf(variant.dof) else f"{variant.dof:g}"


def by_demos(variants: Sequence[Variant]) -> dict[str, dict[int, Variant]]:
    """Groups of variants that differ only in the number of demonstrations: label, then number, then variant."""
    groups: dict[Variant, dict[int, Variant]] = {}
    for variant in variants:
        groups.setdefault(replace(variant, demos=0), {})[variant.demos] = variant
    return dict(zip(labels(list(groups)), groups.values(), strict=True))


def require_no_path(*names: str) -> None:
    """Raises `InvalidValueError` for a name with a slash or two dots.

    ``names`` may come from another person's files; files that are named after them must stay inside the run's folder.
    """
    for name in names:
        if not isinstance(name, str) or "/" in name or ".." in name or "\0" in name:
            raise InvalidValueError(f"{name!r} leads to another folder; names of tasks, suites and objects do not")


@dataclass(frozen=True)
class Scene:
    """A drawn scene of ``task``, with ``objects`` that are "seen" in the demonstrations or "unseen".

    ``assets`` is where their shapes come from: built in "code", or "maniskill"'s downloads; ``level`` is "paper" or
    "hard", see `tasks.level.Level`.
    """

    task: str
    objects: str
    seed: int
    assets: str = "code"
    level: str = "paper"

    def __post_init__(self) -> None:
        require_no_path(file_stem(self.task), self.objects, self.assets, self.level)

    def __str__(self) -> str:
        unusual = [value for value, usual in ((self.assets, "code"), (self.level, "paper")) if value != usual]
        return "-".join((file_stem(self.task), self.objects, str(self.seed), *unusual))
