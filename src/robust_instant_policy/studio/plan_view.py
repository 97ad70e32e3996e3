"""Draws a plan in the 3-D scene."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np
import viser

from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.policies import Plan
from robust_instant_policy.studio import drawing
from robust_instant_policy.studio.stage import place
from robust_instant_policy.trajectory import Trajectory

ROBUST, GAUSSIAN, DEMONSTRATION = (20, 20, 20), (214, 40, 57), (110, 140, 170)
TUBE = (46, 134, 171)
METHOD_COLOURS = {
    "rip": ROBUST, "rip-gauss": GAUSSIAN, "mean": (224, 159, 62), "kat": (46, 134, 171), "neighbours": (120, 80, 160)
}  # fmt: skip
MAX_DEMONSTRATIONS = 20  # whose paths are drawn
AXIS_M = 0.05

Dragged = Callable[[int, float, FloatArray], None]


class PlanView:
    """Draws plans into ``scene``; a candidate that is dragged is told to ``on_drag``: its index, the time in [0, 1]
    of its handle, and the handle's shift ``(3,)`` in metres. ``held`` wraps callbacks, see `Controls.held`."""

    def __init__(self, scene: viser.SceneApi, held: Callable[[Callable[[Any], None]], Any], on_drag: Dragged):
        self._scene, self._held, self._on_drag = scene, held, on_drag
        self._nodes: list[Any] = []
        self._handles: list[viser.TransformControlsHandle] = []

    def clear(self) -> None:
        self._remove(self._nodes)
        self._remove(self._handles)

    def show(
        self,
        plan: Plan,
        gaussian: Trajectory,
        demonstrations: Sequence[Demonstration],
        layers: Collection[str],
        drag: bool,
    ) -> None:
        """Draw ``plan``, the ``gaussian`` mean of the same candidates, and the ``layers`` that are asked for.

        With ``drag`` each candidate of the first arm has a handle.
        """
        self._remove(self._nodes)
        for arm in range(plan.trajectory.num_arms):
            if "Demonstrations" in layers:
                for index, shown in enumerate(demonstrations[:MAX_DEMONSTRATIONS]):
                    if shown.trajectory.num_arms > arm:
                        self._path(f"shown/{arm}/{index}", shown.trajectory, arm, DEMONSTRATION, 1.5)
            if "Candidates" in layers:
                for index in range(len(plan.candidates)):
                    self._line(f"candidate/{arm}/{index}", *drawing.weighed(plan, index, arm), 3.0)
            self._path(f"gaussian/{arm}", gaussian, arm, GAUSSIAN, 3.0)
            self._path(f"robust/{arm}", plan.trajectory, arm, ROBUST, 6.0)
            if "Spread" in layers:
                vertices, faces = drawing.tube(plan.trajectory.tool_points[:, arm], drawing.spread(plan, arm))
                tube = self._scene.add_mesh_simple(
                    f"/plan/tube/{arm}", vertices, faces, color=TUBE, opacity=0.35, side="double"
                )
                self._nodes.append(tube)
        if "Frames" in layers:
            self._show_frames(plan)
        if not drag:
            self._remove(self._handles)
        elif not self._handles:
            self._add_handles(plan)

    def compare(self, trajectories: Mapping[str, Trajectory]) -> None:
        """Draw the trajectory of each method beside the plan."""
        for method, trajectory in trajectories.items():
            for arm in range(trajectory.num_arms):
                self._path(f"compared/{arm}/{method}", trajectory, arm, METHOD_COLOURS[method], 5.0)

    def _show_frames(self, plan: Plan) -> None:
        """The frames in which steps were written, with labels."""
        for index, use in enumerate(plan.frames):
            name = f"/plan/frame/{index}"
            node = self._scene.add_frame(name, axes_length=AXIS_M, axes_radius=0.003)
            place(node, use.pose)
            self._scene.add_label(f"{name}/label", f"steps {use.first} to {use.last}: {use.words}")
            self._nodes.append(node)  # with its label

    def _path(
        self, name: str, trajectory: Trajectory, arm: int, colour: tuple[int, int, int], thickness: float
    ) -> None:
        self._line(name, drawing.polyline(trajectory.tool_points[:, arm]), np.array(colour), thickness)

    def _line(self, name: str, segments: FloatArray, colours: np.ndarray, thickness: float) -> None:
        if len(segments):
            line = self._scene.add_line_segments(
                f"/plan/{name}", segments, colours.astype(np.uint8), thickness=thickness, thickness_units="screen"
            )
            self._nodes.append(line)

    def _add_handles(self, plan: Plan) -> None:
        """A handle in the middle of each candidate of the first arm."""
        for index, candidate in enumerate(plan.candidates):
            step = len(candidate) // 2
            handle = self._scene.add_transform_controls(
                f"/plan/drag/{index}", scale=0.08, disable_rotations=True, depth_test=False, line_width=3.0
            )
            handle.position = start = candidate.tool_points[step, 0]
            self._handles.append(handle)
            self._follow(handle, index, float(candidate.times[step]), start)

    def _follow(self, handle: viser.TransformControlsHandle, index: int, at: float, start: FloatArray) -> None:
        handle.on_update(self._held(lambda _: self._on_drag(index, at, np.asarray(handle.position) - start)))

    @staticmethod
    def _remove(nodes: list[Any]) -> None:
        for node in nodes:
            node.remove()
        nodes.clear()
