"""The tab "Act": preview, execution and comparison of plans, and objects that are moved by hand."""

import threading
from functools import partial

import viser

from robust_instant_policy.errors import RipError, UsageError
from robust_instant_policy.geometry import FloatArray, invert_pose
from robust_instant_policy.motion.arm import Motion
from robust_instant_policy.motion.waypoints import plan_waypoints
from robust_instant_policy.studio import markup
from robust_instant_policy.studio.cell import Cell
from robust_instant_policy.studio.controls import Controls
from robust_instant_policy.studio.plan_panel import PlanPanel
from robust_instant_policy.studio.plan_view import METHOD_COLOURS
from robust_instant_policy.studio.preview import Preview
from robust_instant_policy.studio.session import Session
from robust_instant_policy.studio.stage import pose_of
from robust_instant_policy.trajectory import Trajectory


class ActPanel:
    """Builds its controls into the tab that is open in ``gui``; executes the plan of ``plans``."""

    def __init__(
        self, gui: viser.GuiApi, scene: viser.SceneApi, session: Session, controls: Controls, plans: PlanPanel
    ):
        self._scene, self._session, self._controls, self._plans = scene, session, controls, plans
        self._movers: list[viser.TransformControlsHandle] = []
        self._preview = Preview(scene)
        self._stopped = threading.Event()  # asks a comparison to end
        how_to = gui.add_markdown("Plan first. Then let a ghost show the plan, and the arm execute it.")
        self._outcome = gui.add_html("")

        def show(_: object) -> None:
            session.post(lambda: self._preview.start(plans.trajectory, session.cell))

        button, icons = partial(controls.button, gui), viser.Icon
        button("Preview", show, icon=icons.GHOST, color="gray")
        execute = button("Execute", lambda _: session.post(self._execute), icon=icons.PLAYER_PLAY, color="green")
        button("Stop", lambda _: self._stop(), icon=icons.PLAYER_STOP, color="red")
        again = button("Same scene again", lambda _: session.post(self._begin_again), icon=icons.REFRESH, color="gray")
        self._move = gui.add_checkbox("Move objects", False, hint="before the arm moves")
        controls.input(self._move, lambda _: session.post(self.show_movers))
        compare = button(
            "Compare methods in this scene", lambda _: session.post(self._compare), icon=icons.SCALE, color="gray"
        )
        self._table = gui.add_html("")
        self.with_arms = (how_to, execute, again, self._move, compare)  # controls that need an arm

    def forget(self) -> None:
        """The plan no longer holds."""
        self._preview.stop()
        self._outcome.content = self._table.content = ""

    def show_movers(self) -> None:
        """A handle on each body that can be moved, in a scene in which nothing moved so far."""
        for mover in self._movers:
            mover.remove()
        self._movers.clear()
        cell = self._session.cell
        if not self._move.value or cell is None or self._session.status.phase != "ready":
            return
        poses = cell.poses()
        for body in cell.movable:
            mover = self._scene.add_transform_controls(
                f"/mover/{body}", scale=0.15, active_axes=(True, True, False), depth_test=False
            )
            mover.position = poses[body][:3, 3]
            self._movers.append(mover)
            self._let_move(mover, body, pose_of(mover), poses[body])

    def _let_move(self, mover: viser.TransformControlsHandle, body: str, start: FloatArray, pose: FloatArray) -> None:
        def move(event: viser.TransformControlsEvent) -> None:
            if event.phase == "end":
                moved = pose_of(mover) @ invert_pose(start) @ pose
                self._session.post(lambda: self._session.move(body, moved))

        mover.on_update(self._controls.held(move))

    def _begin_again(self) -> None:
        self._session.discard()
        self._outcome.content = ""

    def _cell(self) -> Cell:
        cell = self._session.cell
        if cell is None or not cell.arms:
            raise UsageError("this scene has no arm that could execute a plan")
        return cell

    def _motion(self, trajectory: Trajectory) -> Motion:
        cell = self._cell()
        return plan_waypoints(trajectory, cell.arms, cell.execute_hz, cell.control_hz)

    def _execute(self) -> None:
        motion = self._motion(self._plans.trajectory)
        goal = self._cell().goal

        def tell(failure: str | None) -> None:
            colour, words = (markup.RED, f"Failed: {failure}.") if failure else (markup.GREEN, f"Success: {goal}.")
            self._outcome.content = markup.box(colour, words)

        self._session.play(motion, tell)
        self._outcome.content = ""

    def _stop(self) -> None:
        self._preview.stop()
        self._stopped.set()
        self._session.post(self._abort)

    def _abort(self) -> None:
        if self._session.abort():
            self._outcome.content = markup.box(markup.ORANGE, "Stopped. The arm stays where it is.")

    def _compare(self) -> None:
        """Execute the plan of each method in this scene, faster than in real time."""
        self._session.require_no_recording()
        self._cell()
        self._stopped.clear()
        self._outcome.content = ""
        rows: list[tuple[str, tuple[int, int, int], str]] = []
        trajectories = self._plans.compared()
        self._plans.show_compared(trajectories)
        for method, trajectory in trajectories.items():
            colour = METHOD_COLOURS[method]
            self._table.content = markup.comparison([*rows, (method, colour, "being executed …")])
            try:
                failure = self._session.rehearse(self._motion(trajectory), self._stopped.is_set)
            except RipError as error:
                outcome = f"refused: {error}"
            else:
                outcome = f"failed: {failure}" if failure else "success"
            if self._stopped.is_set():
                outcome = "stopped"
            rows.append((method, colour, outcome))
            self._table.content = markup.comparison(rows)
            if self._stopped.is_set():
                break
        self._session.discard()
