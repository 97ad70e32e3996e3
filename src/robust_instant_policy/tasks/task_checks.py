"""Does a task of one's own keep the contract of `tasks.task.Task`? One finding for each thing that it does not."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.datasets.images import encode_depth
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.geometry import FloatArray, invert_pose, lift, transform_points
from robust_instant_policy.sanity import Finding, check_demonstrations
from robust_instant_policy.sanity.finding import Severity
from robust_instant_policy.tasks.scene_truth import SceneTruth
from robust_instant_policy.tasks.task import Attempt, Execution, Task, offers
from robust_instant_policy.trajectory import Trajectory, downsample

NUM_SCENES = 5
LEAST_DEPTH = 0.3  # share of the pixels with a reading
LEAST_PIXELS = 20  # of a part, to say where it is seen
MATERIAL_M = 0.01  # by which a part may move in its own frame between scenes, or
MATERIAL_SHARE = 0.5  # by as much of its visible size: another side of it may be seen


T = TypeVar("T")


class _Broken(Exception):
    """What the rest of the checks needs is missing; the findings tell why."""


def check_task(task: Task, num_scenes: int = NUM_SCENES) -> tuple[Finding, ...]:
    """Try ``task`` in the scenes of the seeds 0, 1, …; empty where it keeps its contract.

    Checked are types and shapes; that a seed decides the scene and its image; that camera, depth and ground truth
    agree; that demonstrations repeat themselves, agree with the images (`sanity.check_demonstrations`) and succeed when
    they are replayed, whole and thinned out as policies do it, each time from the scene as it was drawn; and that
    success depends on the trajectory. Checks of optional methods are made where the task has them.
    """
    checks = _Checks(task, list(range(num_scenes)))
    try:
        checks.attributes()
        checks.scenes()
        if offers(task, "scene_truth"):
            checks.truth()
        if offers(task, "demonstrate"):
            checks.demonstrations()
            if offers(task, "follow"):
                checks.follow()
    except _Broken:
        pass
    return tuple(checks.findings)


class _Checks:
    def __init__(self, task: Task, seeds: Sequence[int]):
        self.task, self.seeds = task, seeds
        self.findings: list[Finding] = []
        self.observations: list[Observation] = []
        self.shown: tuple[int, Demonstration] | None = None  # a seed with its successful demonstration

    def attributes(self) -> None:
        task = self.task
        for name in ("record_hz", "execute_hz", "video_hz"):
            value = getattr(task, name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < np.inf:
                self.wrong("attribute", f"{name} must be a positive number of Hz, got {value!r}")
        if not isinstance(task.end_effectors, tuple) or not all(isinstance(one, str) for one in task.end_effectors):
            self.wrong("attribute", f"end_effectors must be a tuple of names, got {task.end_effectors!r}")
        if task.workspace is not None:
            try:
                corners = np.asarray(task.workspace, dtype=np.float64)
            except (TypeError, ValueError):
                corners = np.zeros(0)
            if corners.shape != (2, 3) or not (corners[0] < corners[1]).all():
                self.stop(
                    "attribute", f"workspace must be (2, 3), lower and upper corner in metres, got {task.workspace!r}"
                )

    def scenes(self) -> None:
        self.observations = [self.called("reset", Observation, seed) for seed in self.seeds]
        first = self.observations[0]
        if not _same(first, self.called("reset", Observation, self.seeds[0])):
            self.wrong(
                "determinism",
                f"reset({self.seeds[0]}) gives another image the second time; draw everything from the seed",
            )
        if len(self.seeds) > 1 and all(_same(first, other) for other in self.observations[1:]):
            self.doubt("scenes", f"the scenes of {len(self.seeds)} seeds look the same; draw them from the seed")
        read = np.isfinite(first.depth) & (first.depth > 0)
        if read.mean() < LEAST_DEPTH:
            self.stop(
                "depth", f"only {read.mean():.0%} of the pixels have a depth; is it in metres along the optical axis?"
            )
        try:
            for scene in self.observations:
                encode_depth(scene.depth)
        except DatasetError as error:
            self.wrong("depth", f"it cannot be recorded: {error}")
        if self.task.workspace is not None:
            low, high = np.asarray(self.task.workspace)
            inside = ((points := _points(first, read)) >= low) & (points <= high)
            if not inside.all(axis=1).any():
                middle = ", ".join(f"{value:.2f}" for value in np.median(points, axis=0))
                self.wrong(
                    "camera",
                    f"no pixel shows the workspace; the image is about ({middle}) m: check camera_pose and units",
                )

    def truth(self) -> None:
        known = []
        for seed in self.seeds:
            self.called("reset", Observation, seed)
            known.append(self.called("scene_truth", SceneTruth))
        for seed, scene, truth in zip(self.seeds, self.observations, known, strict=True):
            if not isinstance(truth.parts, np.ndarray) or truth.parts.shape != scene.depth.shape:
                self.wrong(
                    "truth",
                    f"scene_truth().parts must be an array {scene.depth.shape} like the image, "
                    f"got {type(truth.parts).__name__} {np.shape(truth.parts)}",
                )
                return
            if np.shape(truth.poses) != (len(truth.names), 4, 4) or truth.parts.max() >= len(truth.names):
                self.wrong(
                    "truth",
                    f"scene_truth() of seed {seed} has {len(truth.names)} names, poses {np.shape(truth.poses)} "
                    f"and parts up to {truth.parts.max()}; poses must be (P, 4, 4) and parts index them",
                )
                return
            if not all(map(_is_pose, truth.poses)):
                self.wrong("truth", f"the poses of scene_truth() of seed {seed} are no rigid motions (4, 4)")
                return
        for name in dict.fromkeys(name for truth in known for name in truth.names):
            self._material(name, known)

    def _material(self, name: str, known: Sequence[SceneTruth]) -> None:
        """If camera, depth and pose are right, a rigid part is seen at the same place of its frame in every scene."""
        seen = []
        for scene, truth in zip(self.observations, known, strict=True):
            if name not in truth.names:
                continue
            shown = (truth.parts == truth.names.index(name)) & np.isfinite(scene.depth) & (scene.depth > 0)
            if shown.sum() >= LEAST_PIXELS:
                pose = truth.poses[truth.names.index(name)]
                seen.append(transform_points(invert_pose(pose), _points(scene, shown)))
        if len(seen) < 2:
            return
        middles = np.array([np.median(points, axis=0) for points in seen])
        size = max(float(np.linalg.norm(np.ptp(points, axis=0))) for points in seen)
        moved = float(np.linalg.norm(np.ptp(middles, axis=0)))
        if moved > max(MATERIAL_M, MATERIAL_SHARE * size):
            self.wrong(
                "camera",
                f"what the camera sees of {name!r} moves by {moved * 1e3:.0f} mm in its frame between scenes; check "
                "camera_pose (camera to world), intrinsics, depth (metres, along the optical axis) and the part's pose",
            )

    def demonstrations(self) -> None:
        shown = []
        for seed, scene in zip(self.seeds, self.observations, strict=True):
            attempt = self.called("demonstrate", Attempt, seed)
            if not attempt.success:
                self.doubt("demonstration", f"demonstrate({seed}) fails: {attempt.failure or 'no reason given'}")
                continue
            if not isinstance(attempt.demonstration, Demonstration):
                got = type(attempt.demonstration).__name__
                self.stop("demonstration", f"demonstrate({seed}) succeeds without a Demonstration, got {got}")
            shown.append((seed, attempt.demonstration))
            if not _same(attempt.demonstration.observation, scene):
                self.stop("demonstration", f"the observation of demonstrate({seed}) is not that of reset({seed})")
        if not shown:
            self.stop("demonstration", f"the demonstrator succeeds in none of {len(self.seeds)} scenes")
        seed, first = shown[0]
        if first.trajectory.num_arms != len(self.task.end_effectors):
            self.wrong(
                "demonstration",
                f"trajectories are of {first.trajectory.num_arms} arms, end_effectors {self.task.end_effectors}",
            )
        if first.rate_hz != self.task.record_hz:
            self.wrong(
                "demonstration", f"rate_hz of demonstrations is {first.rate_hz:g}, record_hz {self.task.record_hz:g}"
            )
        again = self.called("demonstrate", Attempt, seed).demonstration.trajectory
        if not np.array_equal(again.actions, first.trajectory.actions):
            self.wrong("determinism", f"demonstrate({seed}) gives another trajectory the second time")
        self.shown = shown[0]
        self._replays(shown)
        self.findings += check_demonstrations([demonstration for _, demonstration in shown]).findings

    def _replays(self, shown: Sequence[tuple[int, Demonstration]]) -> None:
        whole, thinned, repeated, idle = [], [], [], []
        for seed, demonstration in shown:
            trajectory = demonstration.trajectory
            self.called("reset", Observation, seed)
            whole.append(self.called("execute", Execution, trajectory))
            repeated.append(self.called("execute", Execution, trajectory))
            thinned.append(self.called("execute", Execution, downsample(trajectory)))
            resting = Trajectory.from_actions(np.repeat(trajectory.actions[:1], 2, axis=0))
            idle.append(self.called("execute", Execution, resting))
        advice = "does execution wait at gripper changes, and is the gripper state the measured one?"
        for what, results, words in (
            ("demonstrations", whole, advice),
            (f"demonstrations thinned out to {len(downsample(shown[0][1].trajectory))} steps", thinned, advice),
        ):
            if failed := [result for result in results if not result.success]:
                reason = failed[0].failure or "no reason given"
                told = self.wrong if len(failed) > len(results) / 2 else self.doubt
                told("replay", f"{len(failed)} of {len(results)} replayed {what} fail ({reason}); {words}")
                break
        if any(one.success != two.success for one, two in zip(whole, repeated, strict=True)):
            self.wrong(
                "determinism",
                "a second execute() of one trajectory ends otherwise; start from the scene as reset drew it",
            )
        if all(result.success for result in idle):
            self.wrong("success", "a gripper that stays where it is succeeds; success must depend on the trajectory")

    def follow(self) -> None:
        assert self.shown is not None
        seed, demonstration = self.shown
        self.called("reset", Observation, seed)
        replay = _Replay(demonstration)
        execution = self.called("follow", Execution, replay, 2 * demonstration.seconds + 10)
        if not replay.images:
            self.wrong("follow", "follow() ends without calling the controller's act(observation, action)")
        elif not execution.success:
            self.doubt("follow", f"a demonstration that is replayed in closed loop fails ({execution.failure})")

    def called(self, method: str, kind: type[T], *arguments: object) -> T:
        """The result of a method of the task, if it is a ``kind``."""
        call: Callable[..., object] = getattr(self.task, method)
        written = f"{method}({arguments[0] if method in ('reset', 'demonstrate') else '…' if arguments else ''})"
        try:
            result = call(*arguments)
        except Exception as error:  # whatever the code of the task raises
            self.stop(method, f"{written} raises {type(error).__name__}: {error}")
        if not isinstance(result, kind):
            self.stop(method, f"{written} must return {kind.__name__}, got {type(result).__name__}")
        return result

    def wrong(self, kind: str, message: str) -> None:
        self._tell(kind, "error", message)

    def stop(self, kind: str, message: str) -> NoReturn:
        """`wrong`, and an end of the checks: the others need what is missing."""
        self.wrong(kind, message)
        raise _Broken

    def doubt(self, kind: str, message: str) -> None:
        self._tell(kind, "warning", message)

    def _tell(self, kind: str, severity: Severity, message: str) -> None:
        self.findings.append(Finding(kind, severity, message))


@dataclass
class _Replay:
    """A controller that replays a demonstration, and counts the ``images`` it was shown."""

    demonstration: Demonstration
    images: int = 0

    @property
    def rate_hz(self) -> float:
        return self.demonstration.rate_hz

    def act(self, observation: Observation, action: FloatArray) -> FloatArray | None:
        self.images += 1
        return self.demonstration.trajectory.actions if self.images == 1 else None


def _same(one: Observation, other: Observation) -> bool:
    return one.rgb.shape == other.rgb.shape and all(
        np.array_equal(getattr(one, name), getattr(other, name), equal_nan=name == "depth")
        for name in ("rgb", "depth", "intrinsics", "camera_pose")
    )


def _is_pose(pose: FloatArray) -> bool:
    rotation = pose[:3, :3]
    return bool(
        np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
        and np.linalg.det(rotation) > 0
        and np.allclose(pose[3], [0, 0, 0, 1])
    )


def _points(scene: Observation, shown: NDArray[np.bool_]) -> FloatArray:
    """World points ``(N, 3)`` of the pixels in ``shown (H, W)``, metres."""
    return lift(np.argwhere(shown)[:, ::-1], scene.depth[shown], scene.intrinsics, scene.camera_pose)
