"""What every method over keypoints starts from: the demonstrations' keypoints and their thinned trajectories."""

from __future__ import annotations

from collections.abc import Sequence

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import DatasetError, UsageError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.perception import KeypointExtractor, Located
from robust_instant_policy.policies.policy import Progress, Stage, Stopwatch, no_progress
from robust_instant_policy.trajectory import TARGET_STEPS, Trajectory, downsample


class KeypointContext:
    """The context [V, A] of the paper, before anybody writes it down (Oh et al. 2025, Sec. III-A).

    Several methods may share one: demonstrations, and observations, that were seen before are not looked at again.
    ``features`` names the image descriptors; ``downsampling`` is "masked" or "uniform", to ``num_steps`` steps.

    After `fit`: ``keypoints_ (I, K, 3)`` metres, world, and ``trajectories_``, one for each demonstration.
    """

    def __init__(
        self,
        *,
        num_keypoints: int = 10,
        features: str = "auto",
        downsampling: str = "masked",
        num_steps: int = TARGET_STEPS,
        workspace: FloatArray | None = None,
        seed: int = 0,
        progress: Progress = no_progress,
    ):
        self.downsampling, self.num_steps = downsampling, num_steps
        self.progress = progress
        self.extractor = KeypointExtractor(
            num_keypoints=num_keypoints, features=features, workspace=workspace, seed=seed
        )
        self._shown: tuple[Demonstration, ...] = ()
        self._seen: tuple[Observation, Located, Stage] | None = None

    @property
    def settings(self) -> str:
        """In words, what decides beside the demonstrations."""
        return (
            f"{self.extractor.num_keypoints} keypoints by {self.extractor.features}, "
            f"{self.downsampling} downsampling to {self.num_steps} steps"
        )

    def fit(self, demonstrations: Sequence[Demonstration]) -> KeypointContext:
        """Find the common keypoints of ``demonstrations``; returns itself.

        The very same demonstrations once more cost nothing.
        """
        if not demonstrations:
            raise DatasetError("no demonstrations; show the task at least once (rip record)")
        if self.fitted_to(demonstrations):
            return self
        self._shown, self._seen = (), None
        self.progress("keypoints", 0, 0)
        self.extractor.fit([demonstration.observation for demonstration in demonstrations])
        self.keypoints_ = self.extractor.keypoints_
        self.trajectories_: tuple[Trajectory, ...] = tuple(
            downsample(demonstration.trajectory, self.downsampling, self.num_steps) for demonstration in demonstrations
        )
        self._shown = tuple(demonstrations)
        return self

    def fitted_to(self, demonstrations: Sequence[Demonstration]) -> bool:
        """Whether the last `fit` was to these very objects."""
        return len(self._shown) == len(demonstrations) and all(
            own is given for own, given in zip(self._shown, demonstrations, strict=True)
        )

    def locate(self, observation: Observation, fitted: Sequence[Trajectory] | None = None) -> tuple[Located, Stage]:
        """Where the keypoints are in ``observation``, and what finding them cost.

        Asking again about the same observation object reuses the answer. Raises `KeypointError` where the scene
        cannot be recognised, and `UsageError` where ``fitted``, the `trajectories_` that a policy was fitted to, are
        not those of the last `fit`: policies may share a context only over the same demonstrations.
        """
        if not self._shown:
            raise UsageError("call fit(demonstrations) before asking for a plan")
        if fitted is not None and fitted is not self.trajectories_:
            raise UsageError("another policy has fitted the context to other demonstrations since; call fit again")
        if self._seen is None or self._seen[0] is not observation:
            watch = Stopwatch()
            self.progress("keypoints", 0, 0)
            with watch.stage("keypoints"):
                located = self.extractor.locate(observation)
            self._seen = observation, located, watch.stages[0]
        return self._seen[1:]

    def assume(self, observation: Observation, located: Located) -> None:
        """Have `locate` answer ``located`` for this observation object: the truth, when a failure is taken apart."""
        self._seen = observation, located, Stage("keypoints", 0.0)
