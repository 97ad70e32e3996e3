"""A row of the results: one execution."""

from dataclasses import dataclass

from robust_instant_policy.evaluation.variant import Scene, Variant

Trial = tuple[Scene, Variant]  # one plan in one scene, with all its executions
EpisodeKey = tuple[Scene, Variant, int]


@dataclass(frozen=True)
class Episode:
    """One execution of one trajectory that ``variant`` planned in ``scene``.

    ``candidate`` is the index of the execution among the ``candidates`` executions of its plan. ``seconds`` is the wall
    time of planning, ``physics_seconds`` that of the simulation, ``executed_seconds`` the time the robot moved.
    ``tokens`` were read and written; ``confidence`` is the plan's. ``failure`` is the reason, empty on success.
    """

    scene: Scene
    variant: Variant
    candidate: int
    candidates: int
    success: bool
    seconds: float
    physics_seconds: float
    executed_seconds: float
    tokens: int
    confidence: float | None
    failure: str

    @property
    def trial(self) -> Trial:
        return self.scene, self.variant

    @property
    def key(self) -> EpisodeKey:
        return self.scene, self.variant, self.candidate
