"""The panels of a plan: what was seen, the candidates and what they agree on, and its execution."""

from __future__ import annotations

import html
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import viser

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import RipError, UsageError
from robust_instant_policy.evaluation.scenes import scene_seed
from robust_instant_policy.geometry import FloatArray, invert_pose
from robust_instant_policy.motion.arm import Motion
from robust_instant_policy.motion.waypoints import plan_waypoints
from robust_instant_policy.policies import CONFIGS, Plan, Settings
from robust_instant_policy.studio import drawing
from robust_instant_policy.studio.cell import Cell
from robust_instant_policy.studio.controls import Controls
from robust_instant_policy.studio.planner import PAPER_ESTIMATOR, Choices, Draft, Planner
from robust_instant_policy.studio.session import Session
from robust_instant_policy.studio.stage import Stage, place, pose_of
from robust_instant_policy.trajectory import Trajectory

ROBUST, GAUSSIAN, DEMONSTRATION = (20, 20, 20), (214, 40, 57), (110, 140, 170)
METHOD_COLOURS = {
    "rip": ROBUST, "rip-gauss": GAUSSIAN, "mean": (224, 159, 62), "kat": (46, 134, 171), "neighbours": (120, 80, 160)
}  # fmt: skip
GOOD, FAIR = 0.9, 0.5  # confidence from which a plan is shown in green, and in yellow
MOST_QUERIES = 10
MOST_NOISE_MM = 40
ESTIMATORS = ("em", PAPER_ESTIMATOR, "median", "mean")  # those that take milliseconds
PREVIEW_S, PREVIEW_HZ = 5.0, 25.0
MAX_DEMONSTRATIONS = 20  # whose paths are drawn
AXIS_M = 0.05
NOTHING = '<div style="padding:0 0.8em">No plan yet.</div>'


class PlanPanel:
    """Builds the tabs "Plan" and "Act" into ``tabs``; ``demonstrations`` are what a plan is made from."""

    def __init__(
        self,
        gui: viser.GuiApi,
        stage: Stage,
        tabs: viser.GuiTabGroupHandle,
        session: Session,
        controls: Controls,
        demonstrations: Callable[[], list[Demonstration]],
        message: Callable[..., None],
        llm: str,
    ):
        self._gui, self._stage, self._scene = gui, stage, stage.scene
        self._session, self._controls = session, controls
        self._demonstrations, self._message = demonstrations, message
        self.planner = Planner(llm, self._show_progress, self._take_draft, self._end)
        self._draft: Draft | None = None
        self._plan: Plan | None = None
        self._observation: Observation | None = None
        self._dragged: dict[int, tuple[float, FloatArray]] = {}
        self._nodes: list[Any] = []
        self._handles: dict[int, viser.TransformControlsHandle] = {}
        self._movers: list[viser.TransformControlsHandle] = []
        self._lock = threading.RLock()  # of what is drawn
        self._preview = threading.Event()
        self._scenes = 0
        with tabs.add_tab("Plan", viser.Icon.BULB):
            self._build_plan()
        with tabs.add_tab("Act", viser.Icon.PLAYER_PLAY):
            self._build_act()

    def show_scene(self, observation: Observation) -> None:
        """There is a scene; the plan of another one is forgotten."""
        with self._lock:
            before = self._observation
            if before is not None and np.array_equal(before.rgb, observation.rgb):
                return  # the same scene again
            self._observation = observation
            self.planner.cancel("")
            self._forget()
            self._picture.content = drawing.keypoint_picture(observation.rgb)
            self._outcome.content = ""
        self._show_points()
        self._show_movers()

    def _show_points(self) -> None:
        """What the camera saw, where it is asked for, or where there is nothing else to see."""
        cell = self._session.cell
        wanted = self._layers["Points"].value or (cell is not None and not cell.arms)
        self._stage.show_points(self._observation if wanted else None)

    def _build_plan(self) -> None:
        gui, held = self._gui, self._controls.held
        self._config = gui.add_dropdown("Configuration", tuple(CONFIGS))
        self._controls.input(self._config, lambda _: self._configure())
        gui.add_button("New scene", icon=viser.Icon.DICE, color="gray").on_click(held(lambda _: self._new_scene()))
        gui.add_button("Plan", icon=viser.Icon.BULB).on_click(held(lambda _: self._session.post(self._start)))
        self._bar = gui.add_progress_bar(0.0, visible=False, animated=True)
        self._doing = gui.add_html("")
        self._cancel = gui.add_button("Cancel", color="gray", visible=False)
        self._cancel.on_click(held(lambda _: self.planner.cancel()))
        self._trust = gui.add_html(NOTHING)
        self._picture = gui.add_html("")
        self._queries = gui.add_slider("Candidates Q", min=1, max=MOST_QUERIES, step=1, initial_value=5)
        self._dof = gui.add_slider("ν of the t", min=0.5, max=10.0, step=0.5, initial_value=1.5)
        self._estimator = gui.add_dropdown("Estimator", ESTIMATORS)
        self._noise = gui.add_slider("Noise, mm", min=0, max=MOST_NOISE_MM, step=1, initial_value=0)
        self._drag = gui.add_checkbox("Drag candidates", False, hint="a handle on each candidate; pull one away")
        self._layers = {
            name: gui.add_checkbox(name, on)
            for name, on in (
                ("Demonstrations", True),
                ("Candidates", True),
                ("Spread", True),
                ("Frames", False),
                ("Points", False),
            )
        }
        for handle in (
            self._queries,
            self._dof,
            self._estimator,
            self._noise,
            self._drag,
            *list(self._layers.values())[:-1],
        ):
            self._controls.input(handle, lambda _: self._draw())
        self._controls.input(self._layers["Points"], lambda _: self._show_points())
        with gui.add_folder("Prompt", expand_by_default=False):
            self._prompt = gui.add_html("")

    def _build_act(self) -> None:
        gui, held, session = self._gui, self._controls.held, self._session
        gui.add_markdown("Plan first. Then let a ghost show the plan, and the arm execute it.")
        self._outcome = gui.add_html("")
        preview = gui.add_button("Preview", icon=viser.Icon.GHOST, color="gray")
        preview.on_click(held(lambda _: session.post(self._start_preview)))
        execute = gui.add_button("Execute", icon=viser.Icon.PLAYER_PLAY, color="green")
        execute.on_click(held(lambda _: session.post(self._execute)))
        stop = gui.add_button("Stop", icon=viser.Icon.PLAYER_STOP, color="red")
        stop.on_click(held(lambda _: self._stop()))
        again = gui.add_button("Same scene again", icon=viser.Icon.REFRESH, color="gray")
        again.on_click(held(lambda _: session.post(session.discard)))
        self._move = gui.add_checkbox("Move objects", False, hint="before the arm moves")
        self._controls.input(self._move, lambda _: self._session.post(self._show_movers))
        compare = gui.add_button("Compare methods in this scene", icon=viser.Icon.SCALE, color="gray")
        compare.on_click(held(lambda _: session.post(self._compare)))
        self._table = gui.add_html("")

    def _show_movers(self) -> None:
        """A handle on each body that can be moved, in a scene in which nothing moved so far."""
        for mover in self._movers:
            mover.remove()
        self._movers.clear()
        cell, ready = self._session.cell, self._session.status.phase == "ready"
        if not self._move.value or cell is None or not ready:
            return
        poses = cell.poses()
        for body in cell.movable:
            mover = self._scene.add_transform_controls(
                f"/mover/{body}", scale=0.15, active_axes=(True, True, False), depth_test=False
            )
            mover.position = poses[body][:3, 3]
            self._movers.append(mover)
            self._let_move(mover, body, pose_of(mover), poses[body])

    def _let_move(self, mover: Any, body: str, start: FloatArray, pose: FloatArray) -> None:
        def move(event: Any) -> None:
            if event.phase == "end":
                moved = pose_of(mover) @ invert_pose(start) @ pose
                self._session.post(lambda: self._session.move(body, moved))

        mover.on_update(self._controls.held(move))

    def _configure(self) -> None:
        self._estimator.value = "em" if self._config.value == "adaptive" else PAPER_ESTIMATOR
        self._draw()

    def _choices(self) -> Choices:
        return Choices(
            int(self._queries.value),
            self._dof.value,
            self._estimator.value,
            self._noise.value / 1000,
            dict(self._dragged),
        )

    def _new_scene(self) -> None:
        self._scenes += 1
        seed = scene_seed(0, self._scenes)
        self._session.post(lambda: self._session.new_scene(seed))

    def _start(self) -> None:
        session = self._session
        if session.cell is None or session.observation is None:
            raise UsageError("there is no scene yet")
        if session.status.phase != "ready":
            session.discard()  # the image was taken before the arm moved; plan for that scene
        settings = Settings.of(self._config.value)
        if session.cell.workspace is not None:
            settings = settings.changed(workspace=session.cell.workspace)
        with self._lock:
            self._forget()
        self._cancel.visible = self._bar.visible = True
        self.planner.start(self._demonstrations(), session.observation, settings, int(self._queries.value))

    def _show_progress(self, stage: str, share: float | None) -> None:
        self._doing.content = f'<div style="padding:0 0.8em">{html.escape(stage)} …</div>'
        self._bar.value = 100.0 if share is None else 100.0 * share

    def _take_draft(self, draft: Draft) -> None:
        with self._lock:
            first, self._draft = self._draft is None, draft
            if first:
                self._prompt.content = (
                    '<pre style="max-height:20em;overflow:auto;font-size:0.75em;padding:0 0.8em">'
                    f"{html.escape(draft.prompt)}</pre>"
                )
                self._picture.content = drawing.keypoint_picture(
                    self._observation.rgb if self._observation else np.zeros((1, 1, 3), np.uint8),
                    draft.context,
                    draft.scene,
                )
        self._draw()

    def _end(self, reason: str) -> None:
        self._cancel.visible = self._bar.visible = False
        self._doing.content = ""
        if reason:
            self._message(f"no plan: {reason}")

    def _forget(self) -> None:
        self._draft = self._plan = None
        self._dragged.clear()
        self._preview.set()
        self._clear()
        self._trust.content, self._table.content, self._prompt.content = NOTHING, "", ""

    def _clear(self) -> None:
        for node in (*self._nodes, *self._handles.values()):
            node.remove()
        self._nodes.clear()
        self._handles.clear()

    def _draw(self) -> None:
        """Regression on the candidates that are there, and what it gives drawn; takes milliseconds."""
        with self._lock:
            if self._draft is None:
                return
            choices = self._choices()
            try:
                plan, gaussian = self._draft.plan(choices), self._draft.plan(choices, dof=np.inf)
            except RipError as error:
                self._message(str(error))
                return
            self._plan = plan
            handles = self._handles if self._drag.value else {}
            for node in self._nodes:
                node.remove()
            self._nodes.clear()
            for arm in range(plan.trajectory.num_arms):
                self._draw_arm(plan, gaussian, arm)
            if not handles:
                for handle in self._handles.values():
                    handle.remove()
                self._handles.clear()
            if self._drag.value and not self._handles:
                self._add_handles(plan)
            self._trust.content = trust(plan, len(self._draft.proposal.candidates))

    def _draw_arm(self, plan: Plan, gaussian: Plan, arm: int) -> None:
        show = {name: box.value for name, box in self._layers.items()}
        if show["Demonstrations"]:
            for index, shown in enumerate(self._demonstrations()[:MAX_DEMONSTRATIONS]):
                if shown.trajectory.num_arms > arm:
                    path = drawing.tool_path(shown.trajectory, arm)
                    self._line(f"shown/{arm}/{index}", drawing.polyline(path), DEMONSTRATION, 1.5)
        if show["Candidates"]:
            for index in range(len(plan.candidates)):
                segments, colours = drawing.weighed(plan, index, arm)
                self._line(f"candidate/{arm}/{index}", segments, colours, 3.0)
        path = drawing.tool_path(plan.trajectory, arm)
        self._line(f"gaussian/{arm}", drawing.polyline(drawing.tool_path(gaussian.trajectory, arm)), GAUSSIAN, 3.0)
        self._line(f"robust/{arm}", drawing.polyline(path), ROBUST, 6.0)
        if show["Spread"]:
            vertices, faces = drawing.tube(path, drawing.spread(plan, arm))
            self._nodes.append(
                self._scene.add_mesh_simple(
                    f"/plan/tube/{arm}", vertices, faces, color=(46, 134, 171), opacity=0.35, side="double"
                )
            )
        if show["Frames"]:
            for index, use in enumerate(frame for frame in plan.frames if frame.arm == arm):
                node = self._scene.add_frame(f"/plan/frame/{arm}/{index}", axes_length=AXIS_M, axes_radius=0.003)
                place(node, use.pose)
                words = f"steps {use.first} to {use.last}: {use.words}"
                self._nodes += [node, self._scene.add_label(f"/plan/frame/{arm}/{index}/label", words)]

    def _line(self, name: str, segments: FloatArray, colours: Any, thickness: float) -> None:
        if len(segments):
            self._nodes.append(
                self._scene.add_line_segments(
                    f"/plan/{name}",
                    segments,
                    np.asarray(colours, np.uint8),
                    thickness=thickness,
                    thickness_units="screen",
                )
            )

    def _add_handles(self, plan: Plan) -> None:
        """A handle in the middle of each candidate of the first arm."""
        for index, candidate in enumerate(plan.candidates):
            step = len(candidate) // 2
            handle = self._scene.add_transform_controls(
                f"/plan/drag/{index}", scale=0.08, disable_rotations=True, depth_test=False, line_width=3.0
            )
            handle.position = start = drawing.tool_path(candidate, 0)[step]
            self._handles[index] = handle
            self._follow(handle, index, float(candidate.times[step]), start)

    def _follow(self, handle: Any, index: int, at: float, start: FloatArray) -> None:
        def drag(event: Any) -> None:
            self._dragged[index] = at, np.asarray(handle.position) - start
            self._draw()

        handle.on_update(self._controls.held(drag))

    def _motion(self, trajectory: Trajectory) -> Motion:
        cell = self._cell()
        return plan_waypoints(trajectory, cell.arms, cell.execute_hz, cell.control_hz)

    def _cell(self) -> Cell:
        cell = self._session.cell
        if cell is None or not cell.arms:
            raise UsageError("this scene has no arm that could execute a plan")
        return cell

    def _chosen(self) -> Trajectory:
        if self._plan is None:
            raise UsageError("there is no plan; press Plan first")
        return self._plan.trajectory

    def _start_preview(self) -> None:
        """Let a ghost of the arms, or of the gripper's three points where there are none, go along the plan."""
        trajectory, cell = self._chosen(), self._session.cell
        self._preview.set()
        self._preview = stopped = threading.Event()
        if cell is None or not cell.arms:
            sweep = partial(self._sweep_triangle, trajectory, stopped)
        else:  # poses are computed here: the kinematics belong to the session's thread
            joints = self._motion(trajectory).joints
            shown = joints[np.linspace(0, len(joints) - 1, round(PREVIEW_S * PREVIEW_HZ)).astype(int)]
            poses = [
                {
                    name: pose
                    for arm, own in zip(cell.arms, step, strict=True)
                    for name, pose in arm.kinematics.body_poses(own).items()
                }
                for step in shown
            ]
            sweep = partial(self._sweep, self._ghost(cell, poses[0]), poses, stopped)
        threading.Thread(target=sweep, daemon=True).start()

    def _sweep_triangle(self, trajectory: Trajectory, stopped: threading.Event) -> None:
        node = self._scene.add_line_segments(
            "/ghost/triangle", np.zeros((1, 2, 3)), DEMONSTRATION, thickness=6.0, thickness_units="screen"
        )
        for at in np.linspace(0, 1, round(PREVIEW_S * PREVIEW_HZ)):
            if stopped.is_set():
                break
            points = trajectory.resampled([at]).triplets[0]
            node.points = np.concatenate([points[:, [0, 1]], points[:, [0, 2]]]).astype(np.float32)
            time.sleep(1 / PREVIEW_HZ)
        node.remove()

    def _sweep(self, ghost: dict[str, Any], path: list[dict[str, FloatArray]], stopped: threading.Event) -> None:
        for poses in path:
            if stopped.is_set():
                break
            for name, node in ghost.items():
                place(node, poses[name])
            time.sleep(1 / PREVIEW_HZ)
        for node in ghost.values():
            node.remove()

    def _ghost(self, cell: Cell, poses: dict[str, FloatArray]) -> dict[str, Any]:
        ghost = {}
        for name in poses:
            parts = [surface for surface in cell.surfaces() if surface.body == name]
            if parts:
                starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
                ghost[name] = self._scene.add_mesh_simple(
                    f"/ghost/{name.replace('/', '.')}",
                    np.concatenate([part.vertices for part in parts]),
                    np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]),
                    color=(46, 134, 171),
                    opacity=0.35,
                )
        return ghost

    def _execute(self) -> None:
        motion = self._motion(self._chosen())
        goal = self._cell().goal

        def tell(failure: str | None) -> None:
            words = f"Success: {goal}." if not failure else f"Failed: {failure}."
            self._outcome.content = box("#2a7d3f" if not failure else "#b3262e", words)

        self._outcome.content = ""
        self._session.play(motion, tell)

    def _stop(self) -> None:
        self._preview.set()
        self._session.post(self._session.abort)

    def _compare(self) -> None:
        """Execute the plan of each method in this scene, faster than in real time."""
        if self._draft is None:
            raise UsageError("there is no plan; press Plan first")
        rows = []
        for method, plan in self._draft.compared(self._choices()).items():
            try:
                failure = self._session.rehearse(self._motion(plan.trajectory))
            except RipError as error:
                failure = f"refused: {error}"
            colour = "#{:02x}{:02x}{:02x}".format(*METHOD_COLOURS[method])
            told = "success" if not failure else f"failed: {failure}"
            rows.append(
                f'<tr><td style="color:{colour};font-weight:bold;padding-right:1em">{method}</td>'
                f"<td>{html.escape(told)}</td></tr>"
            )
            with self._lock:
                for arm in range(plan.trajectory.num_arms):
                    path = drawing.polyline(drawing.tool_path(plan.trajectory, arm))
                    self._line(f"compared/{arm}/{method}", path, METHOD_COLOURS[method], 5.0)
            self._table.content = f'<table style="margin:0.5em 0.8em">{"".join(rows)}</table>'
        self._session.discard()


def box(colour: str, text: str) -> str:
    """HTML of ``text`` on ``colour``."""
    return (
        f'<div class="studio-box" style="background:{colour};color:#fff;line-height:1.35;padding:0.6em 0.8em;'
        f'margin:0.3em 0.5em;border-radius:6px">{html.escape(text)}</div>'
    )


def trust(plan: Plan, available: int) -> str:
    """HTML of the confidence of a plan and its reasons; ``available`` candidates are there."""
    ignored = [f"{index + 1} from step {plan.onset[index]}" for index in np.flatnonzero(plan.hallucinated)]
    confidence = plan.confidence or 0.0
    colour = "#2a7d3f" if confidence >= GOOD else "#b35c00" if confidence >= FAIR else "#b3262e"
    words = f"Confidence {confidence:.2f}: {len(plan.candidates)} of {available} candidates"
    words += f", hallucinated: {', '.join(ignored)}" if ignored else ", none hallucinated"
    evidence = "".join(
        f"<tr><td style='padding-right:1em'>{html.escape(name)}</td><td>{value:.3g}</td></tr>"
        for name, value in plan.evidence.items()
    )
    notes = "".join(f"<li>{html.escape(note)}</li>" for note in plan.notes)
    return (
        f"{box(colour, words)}<details style='padding:0 0.8em'><summary>Reasons</summary>"
        f"<table>{evidence}</table><ul style='padding-left:1.2em'>{notes}</ul></details>"
    )
