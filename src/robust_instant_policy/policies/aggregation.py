"""From candidates to one plan."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from robust_instant_policy.context import FactorisedPrompt, Prompt
from robust_instant_policy.errors import InvalidValueError, PlanningError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.policies.confidence import (
    Evidence,
    distortion,
    doubts,
    novelty,
    plan_confidence,
    prediction,
)
from robust_instant_policy.policies.context import Context, LocatedScene
from robust_instant_policy.policies.policy import Plan, Stage, Stopwatch, Usage
from robust_instant_policy.policies.sampling import Proposal
from robust_instant_policy.policies.settings import Settings
from robust_instant_policy.regression import RobustTrajectory, robust_gripper_trajectory
from robust_instant_policy.sanity import Envelope, Finding, errors
from robust_instant_policy.trajectory import Trajectory

DISTANCES = {"envelope: position", "envelope: step length", "envelope: path length"}  # the limits that frames excuse
FARTHEST = 0.5  # of the longest side of the envelope's box: a plan farther outside of it is an error
STRAY_M = 0.05  # from the demonstrations carried over: a plan that strays farther does not do what they do
CARRIED_NOTE = "{}; the demonstrations carried over into this scene do the same"


def aggregate(context: Context, scene: LocatedScene, proposal: Proposal, settings: Settings) -> Plan:
    """The plan that follows what the candidates agree on (Oh et al. 2025, Eq. 4).

    Raises `PlanningError` where candidates are no trajectories of a gripper.
    """
    watch = Stopwatch()
    with watch.stage("regression"):
        prompt = context.prompt.for_scene(scene.keypoints)
        robust = agree(proposal, settings, prompt.curvature, prompt.variation)
    return make_plan(context, scene, proposal, robust, watch.stages, judged=True)


def take_first(context: Context, scene: LocatedScene, proposal: Proposal) -> Plan:
    """The plan that follows the first candidate and ignores the others; it has no confidence."""
    first, count = proposal.candidates[0], len(proposal.candidates)
    alone = RobustTrajectory(
        actions=first.actions,
        times=first.times,
        scale=np.zeros_like(first.actions),
        weights=np.repeat(np.eye(count)[:, :1], len(first), axis=1),
        scores=np.zeros(count),
        hallucinated=np.zeros(count, dtype=bool),
        onset=np.full(count, -1),
        dimensions=((),) * count,
        confidence=0.0,
    )
    return make_plan(context, scene, proposal, alone)


def agree(
    proposal: Proposal,
    settings: Settings,
    curvature: ArrayLike | None = None,
    variation: ArrayLike | None = None,
) -> RobustTrajectory:
    """What the candidates agree on; see `robust_gripper_trajectory`."""
    try:
        return robust_gripper_trajectory(
            [candidate.actions for candidate in proposal.candidates],
            times=[candidate.times for candidate in proposal.candidates],
            dof=settings.dof,
            estimator=settings.estimator,
            seed=settings.seed,
            curvature=curvature,
            variation=variation,
        )
    except InvalidValueError as error:
        raise PlanningError(f"the answers are no trajectories of a gripper: {error}") from None


def _outside(
    envelope: Envelope | None, prompt: Prompt, keypoints: FloatArray, trajectory: Trajectory
) -> tuple[Finding, ...]:
    """What of ``trajectory`` lies outside of what was demonstrated: an error, or a warning where frames explain it.

    They do where it follows the demonstrations, as their frames carry them over into the scene of ``keypoints (K, 3)``,
    at every step to `STRAY_M`, and these lie outside as well, because things are farther apart there. That excuses
    `DISTANCES` alone, and places outside by `FARTHEST` at most; never a low fingertip, a turn or another gripper
    change.
    """
    found = envelope.check(trajectory) if envelope is not None else ()
    if envelope is None or not found or not isinstance(prompt, FactorisedPrompt):
        return found
    carried = prompt.carried_over(keypoints, len(prompt.shown))
    if _strays(trajectory, carried):
        return found
    there = Envelope.of(carried, envelope.plane)
    unlike = {finding.kind for finding in there.check(trajectory)}
    farthest = FARTHEST * float((envelope.upper - envelope.lower).max())
    if any(one.kind == "envelope: position" and one.numbers["value"] > farthest for one in found):
        return found
    return tuple(
        replace(one, severity="warning", message=CARRIED_NOTE.format(one.message))
        if one.kind in DISTANCES and one.kind not in unlike
        else one
        for one in found
    )


def _strays(trajectory: Trajectory, carried: Sequence[Trajectory]) -> bool:
    """Whether a point of ``trajectory`` is farther than `STRAY_M` from those of the ``carried`` demonstrations at the
    same step, along an axis of the world."""
    if any(one.actions.shape != trajectory.actions.shape for one in carried):
        return True
    points, shown = trajectory.triplets, np.stack([one.triplets for one in carried])
    return bool(np.maximum(shown.min(axis=0) - points, points - shown.max(axis=0)).max() > STRAY_M)


def make_plan(
    context: Context,
    scene: LocatedScene,
    proposal: Proposal,
    chosen: RobustTrajectory,
    stages: Sequence[Stage] = (),
    judged: bool = False,
) -> Plan:
    """The whole `Plan` that follows ``chosen``; ``stages`` are those after the candidates were made.

    Its trajectory is compared with what was demonstrated. It has a confidence where it is ``judged``: where ``chosen``
    is what several candidates agree on.
    """
    trajectory = Trajectory(chosen.actions, chosen.times)
    prompt = context.prompt.for_scene(scene.keypoints)
    outside = _outside(context.report.envelope, prompt, scene.keypoints, trajectory)
    findings = (*context.report.findings, *scene.findings, *outside)
    frames = prompt.frames
    evidence = Evidence(
        agreement=chosen.confidence,
        vote=context.prompt.decide(scene.keypoints)[1],
        doubled=len(scene.located.doubled),
        carried=int(any(finding.severity == "warning" for finding in outside)),
        recognition=scene.recognition,
        distortion=distortion(context.keypoints, scene.keypoints),
        frames=frames.error,
        prediction=prediction(context.prediction_errors),
        novelty=novelty(context.keypoints, scene.keypoints),
        displacement=context.surroundings.displacement(scene.view, chosen.actions) if scene.view else float("nan"),
        precision=context.surroundings.precision,
        doubts=doubts(findings),
        errors=len(errors(findings)),
    )
    return Plan(
        trajectory=trajectory,
        candidates=proposal.candidates,
        weights=chosen.weights,
        scale=chosen.scale,
        hallucinated=chosen.hallucinated,
        onset=chosen.onset,
        scores=chosen.scores,
        confidence=plan_confidence(evidence) if judged else None,
        evidence={name: value for name, value in vars(evidence).items() if np.isfinite(value)} if judged else {},
        keypoints=scene.located.keypoints,
        pixels=scene.located.pixels,
        keypoint_confidence=scene.located.confidence,
        usage=Usage((scene.stage, *proposal.stages, *stages)),
        seconds=context.pace.seconds if context.pace else None,
        dwell=context.pace.dwell if context.pace else None,
        frames=frames.uses(scene.keypoints),
        notes=(
            *context.notes,
            *scene.notes,
            *context.prompt.scene_notes(scene.keypoints),
            *proposal.notes,
            *map(str, outside),
            *(evidence.notes if judged else ()),
        ),
    )
