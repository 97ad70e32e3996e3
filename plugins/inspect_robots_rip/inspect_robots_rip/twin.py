"""The simulated tasks of this package as an embodiment."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from queue import SimpleQueue

import numpy as np
from inspect_robots.embodiment import (
    PRIVILEGED_SUCCESS,
    RENDERABLE,
    RESETTABLE,
    SEEDABLE,
    EmbodimentBase,
    EmbodimentInfo,
)
from inspect_robots.scene import Scene
from inspect_robots.spaces import CameraSpec, ObservationSpace, StateField, StateSpec
from inspect_robots.task import TaskEnvelope
from inspect_robots.types import Action, Observation, StepResult

import robust_instant_policy as rip
from inspect_robots_rip.actions import action_space, to_actions, to_waypoint
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.task import Execution
from robust_instant_policy.trajectory import Trajectory

MAX_SECONDS = 120.0  # of one episode, simulated
Seen = tuple[np.ndarray, FloatArray]  # image, and the grippers as in `Trajectory`


class Puppet:
    """A controller whose waypoints come from another thread, one at a time; None ends the episode."""

    def __init__(self, rate_hz: float):
        self.rate_hz = rate_hz
        self.waypoints: SimpleQueue[FloatArray | None] = SimpleQueue()
        self.seen: SimpleQueue[Seen | None] = SimpleQueue()

    def act(self, observation: rip.Observation, action: FloatArray) -> FloatArray | None:
        self.seen.put((observation.rgb, action))
        return self.waypoints.get()


class RipTwin(EmbodimentBase):
    """The task called ``task`` (see ``rip record``), with the camera ``top``.

    ``Observation.extra`` holds its depth and calibration. A trial ends after an action whose ``meta`` has ``is_last``,
    or with the last step of the evaluation's task; then the simulator says whether the task was done. The scene is
    that of ``Scene.init_seed``, where there is one.
    """

    def __init__(self, task: str):
        # The simulator, its renderer included, belongs to one thread.
        self._thread = ThreadPoolExecutor(1)
        self._task = self._thread.submit(make_task, task).result()
        seen = self._thread.submit(self._task.reset, 0).result()
        demonstration = self._thread.submit(self._task.demonstrate, 0).result().demonstration
        self._triangle = rip.GripperTriangle.from_triplets(demonstration.trajectory.triplets)
        self._max_steps: int | None = None
        self._puppet: Puppet | None = None
        self._episode: Future[Execution] | None = None
        self._scene, self._steps = seen, 0
        space = action_space(demonstration.trajectory.num_arms)
        height, width = seen.depth.shape
        self.info = EmbodimentInfo(
            name=f"rip-twin {task}",
            action_space=space,
            observation_space=ObservationSpace(
                (CameraSpec("top", height, width),), state=StateSpec((StateField("tool", space.shape, "m+rot6d"),))
            ),
            control_hz=self._task.execute_hz,
            is_simulated=True,
            capabilities=frozenset({SEEDABLE, RESETTABLE, PRIVILEGED_SUCCESS, RENDERABLE}),
            docs=f"{self._task.description}. Poses are absolute, in the world, in metres; gripper 1 open, 0 closed.",
        )

    def bind_task(self, envelope: TaskEnvelope) -> None:
        self._max_steps = envelope.max_steps

    def reset(self, scene: Scene, *, seed: int | None = None) -> Observation:
        self._end()
        chosen = scene.init_seed if scene.init_seed is not None else seed or 0
        self._scene = self._thread.submit(self._task.reset, chosen).result()
        puppet = Puppet(self._task.execute_hz)
        self._puppet, self._steps = puppet, 0
        self._episode = self._thread.submit(self._task.follow, puppet, MAX_SECONDS)
        self._episode.add_done_callback(lambda _: puppet.seen.put(None))
        return self._observe(self._look(), scene.instruction)

    def step(self, action: Action) -> StepResult:
        """Move to the waypoint ``action``. Raises what the simulator raises, such as `UnreachableError`."""
        if self._puppet is None:
            raise RuntimeError("call reset(scene) first")
        self._steps += 1
        self._puppet.waypoints.put(to_waypoint(action.data, self._triangle))
        seen = self._look()
        if action.meta.get("is_last") or self._steps == self._max_steps or seen is None:
            outcome = self._end()
            reason = "success" if outcome.success else outcome.failure
            info = {"success": outcome.success, "tracking_error_m": outcome.tracking_error}
            return StepResult(self._observe(seen), terminated=True, termination_reason=reason, info=info)
        return StepResult(self._observe(seen))

    def close(self) -> None:
        self._end()
        self._thread.submit(self._task.close).result()
        self._thread.shutdown()

    def _look(self) -> Seen | None:
        """What is seen now; None where the episode has ended."""
        assert self._puppet is not None
        return self._puppet.seen.get()

    def _end(self) -> Execution:
        """End the episode under way, if there is one; what the simulator says of it."""
        if self._puppet is None or self._episode is None:
            return Execution(False, "no episode", 0.0, 0.0)
        puppet, self._puppet = self._puppet, None  # also where the episode has failed
        puppet.waypoints.put(None)
        return self._episode.result()

    def _observe(self, seen: Seen | None, instruction: str | None = None) -> Observation:
        image, state = seen if seen is not None else (self._scene.rgb, None)
        images = {"top": np.asarray(image)}
        extra = {
            "depth": self._scene.depth,
            "intrinsics": self._scene.intrinsics,
            "camera_pose": self._scene.camera_pose,
        }
        tool = np.zeros(self.info.action_space.shape) if state is None else self._tool(state)
        # Depth is that of the start of the episode: the policy plans once, from there.
        return Observation(images, {"tool": tool}, instruction, extra=extra if self._steps == 0 else {})

    def _tool(self, state: FloatArray) -> FloatArray:
        return to_actions(Trajectory.from_actions(state[None]), self._triangle)[0]
