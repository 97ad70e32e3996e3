"""The page: a session's cell in 3-D, and the panel with which a person demonstrates."""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import RipError, UsageError
from robust_instant_policy.evaluation.scenes import SPLITS, stored_demonstrations
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.studio import markup
from robust_instant_policy.studio.act_panel import ActPanel
from robust_instant_policy.studio.cell import Cell
from robust_instant_policy.studio.controls import Controls
from robust_instant_policy.studio.plan_panel import PlanPanel
from robust_instant_policy.studio.session import Session, Status
from robust_instant_policy.studio.stage import Stage, place, pose_of

NUDGE_M, NUDGE_RAD = 0.005, np.deg2rad(5)
UNDO_S = 1.0
NOTE_S = 6.0
KEY_REPEAT_S = 0.7  # a key that is held down comes again after less than that
MANY = 1000  # demonstrations that are read at most
BRAND = (46, 134, 171)
WAYS = {  # key: way in the view of the browser (right, away, up), and turn about the vertical
    "L": ((1, 0, 0), 0), "J": ((-1, 0, 0), 0), "I": ((0, 1, 0), 0), "K": ((0, -1, 0), 0),
    "U": ((0, 0, 1), 0), "O": ((0, 0, -1), 0), "N": ((0, 0, 0), 1), "M": ((0, 0, 0), -1),
}  # fmt: skip
GAMEPAD = Path(__file__).with_name("gamepad.js")
HOW_TO = """
1. **Drag the coloured handle** at the gripper: arrows shift, rings turn. Recording begins as you move.
2. **Space** closes and opens the gripper.
3. Once the task is done, **Enter** keeps the demonstration; the next scene comes.

**Z** goes back one second, **X** begins again. **I J K L** shift, **U O** up and down, **N M** turn.

The arm stops at the table, but not at the objects: a link may push one.
"""


class Page:
    """The page, a `session.Watcher`.

    ``folder_of`` names the folder of a task's demonstrations, ``make_cell`` makes the cell of a task that was
    demonstrated so far as it is told; ``llm`` is as in `llm.connect`.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        tasks: Sequence[str],
        folder_of: Callable[[str], Path],
        make_cell: Callable[[str, Sequence[Demonstration]], Cell],
        llm: str,
    ):
        self.session = Session(self)
        self.demonstrations: list[Demonstration] = []
        self._server, self._gui = server, server.gui
        self._folder_of, self._make_cell = folder_of, make_cell
        self._stage, self._controls = Stage(server), Controls(server)
        self._arm = 0  # moved by keys
        self._gripped_at = 0.0
        self._dragged: int | None = None
        self._targets = np.zeros((0, 4, 4))  # at which the handles were put
        self._phase = ""
        self._opened = tasks[0]
        self._grippers: tuple[str, ...] = ()
        server.on_client_disconnect(self._forget_drag)
        self._gui.configure_theme(
            brand_color=BRAND, show_logo=False, show_share_button=False, control_width="medium", dark_mode=False
        )
        self._gui.main_panel.dock_right()
        self._banner = self._gui.add_html("")
        self._told = ""
        self._task = self._gui.add_dropdown("Task", tuple(tasks))
        self._controls.input(self._task, lambda _: self.open(self._task.value))
        self.tabs = self._gui.add_tab_group()
        with self.tabs.add_tab("Show", viser.Icon.HAND_MOVE):
            self._build()
        with self.tabs.add_tab("Plan", viser.Icon.BULB):
            self.plans = PlanPanel(
                self._gui,
                self._stage,
                self.session,
                self._controls,
                llm,
                demonstrations=self._others,
                new_scene=self._new_scene,
                on_forget=lambda: self._acts.forget(),
            )
        with self.tabs.add_tab("Act", viser.Icon.PLAYER_PLAY):
            self._acts = ActPanel(self._gui, server.scene, self.session, self._controls, self.plans)
        self._bind_keys()
        self._gui.add_html(markup.script(GAMEPAD.read_text()))

    @property
    def folder(self) -> Path:
        return self._folder_of(self._opened)

    def open(self, task: str) -> None:
        """Replace the cell by that of ``task``."""
        self.session.post(lambda: self._open(task))

    def on_scene(self, cell: Cell, observation: Observation) -> None:
        self._stage.show_cell(cell)
        self.plans.show_scene(observation)
        self._phase = ""  # objects have other places
        names = tuple(arm.name for arm in cell.arms)
        if names != self._grippers:
            self._grippers, self._arm, self._dragged = names, 0, None
            self._count()
            self._stage.show_grippers(names)
            for index, gizmo in enumerate(self._stage.gizmos):
                self._follow(gizmo, index)
        self._targets = np.zeros((0, 4, 4))

    def on_frame(self, poses: Mapping[str, FloatArray], tools: FloatArray, targets: FloatArray, status: Status) -> None:
        self._stage.show_poses(poses)
        self._stage.show_way(tools, targets, bool(status.refusal))
        if status.phase != self._phase:
            self._phase = status.phase
            self._acts.show_movers()
        if self._targets.shape != targets.shape:
            self._targets = np.zeros_like(targets)
        for index, gizmo in enumerate(self._stage.gizmos):
            if index != self._dragged and not np.allclose(self._targets[index], targets[index]):
                place(gizmo, targets[index])
                self._targets[index] = targets[index]
        self._tell(*self._situation(status))
        self._server.flush()  # do not wait for more messages

    def on_kept(self, demonstration: Demonstration, folder: Path, count: int) -> None:
        self.demonstrations.append(demonstration)
        self._count()
        self.on_message(f"Kept: demonstration {count} in {folder}", is_error=False)

    def on_message(self, text: str, is_error: bool = True) -> None:
        for client in self._server.get_clients().values():
            client.add_notification(
                "Not done" if is_error else "Done",
                text,
                auto_close_seconds=NOTE_S,
                color="red" if is_error else "green",
            )

    def say_stopped(self) -> None:
        """Tell every browser that the server stops."""
        self._tell(markup.RED, "The studio was stopped. What you kept is on the disk; start it again with: rip studio")
        self._server.flush()

    def _build(self) -> None:
        gui, session = self._gui, self.session
        how_to = gui.add_markdown(HOW_TO)
        self._kept = gui.add_markdown("")
        button, icons = partial(self._controls.button, gui), viser.Icon
        keep = button("Keep (Enter)", self._keep, icon=icons.CHECK, color="green")
        grip = button(
            "Close / open gripper (Space)",
            lambda _: session.post(partial(session.grip, self._arm)),
            icon=icons.ARROWS_HORIZONTAL,
        )
        undo = button("Undo (Z)", self._undo, icon=icons.ARROW_BACK_UP)
        self._back = gui.add_slider("Undo by, s", min=0.5, max=10.0, step=0.5, initial_value=UNDO_S)
        discard = button("Discard, begin again (X)", self._discard, icon=icons.TRASH, color="gray")
        button("Another scene", lambda _: session.post(self._new_scene), icon=icons.DICE, color="gray")
        self._with_arms = (how_to, keep, grip, undo, self._back, discard)

    def _bind_keys(self) -> None:
        held = self._controls.held
        actions: dict[str, tuple[str, Callable[[Any], None]]] = {
            "space": ("Close or open the gripper", self._grip),
            "enter": ("Keep the demonstration", self._keep),
            "Z": ("Undo", self._undo),
            "X": ("Discard and begin again", self._discard),
            "C": ("Keys move the other arm", lambda _: self._choose_arm()),
        }
        for key, (way, turn) in WAYS.items():
            actions[key] = "Turn the gripper" if turn else "Shift the gripper", partial(self._nudge, way, turn)
        for key, (name, action) in actions.items():
            self._gui.add_command(f"{name} ({key})", hotkey=key).on_trigger(held(action))

    def _open(self, task: str) -> None:
        try:
            self.session.require_no_recording()
        except UsageError:
            self._task.value = self._opened
            raise
        self._task.value = self._opened = task
        self._tell(markup.GREY, f"Opening {task} …")
        self.session.close()
        try:
            folder = self.folder
            self.demonstrations = stored_demonstrations(folder, task, MANY) if folder.exists() else []
            self._count()
            cell = self._make_cell(task, self.demonstrations)
            for control in (*self._with_arms, *self._acts.with_arms):
                control.visible = bool(cell.arms)
            self.session.open(cell)
            self._new_scene()
        except Exception as error:
            told = str(error) if isinstance(error, RipError) else "see the terminal"
            self._tell(markup.RED, f"{task} cannot be opened: {told}")
            raise

    def _others(self) -> list[Demonstration]:
        """The demonstrations, less the one whose scene is shown, where there is no simulator."""
        return [one for one in self.demonstrations if one.observation is not self.session.observation]

    def _new_scene(self) -> None:
        """Draw the scene after the present one and all demonstrated ones; the scenes of evaluations stay unseen."""
        cell, now = self.session.cell, self.session.seed
        seeds = [now] if cell is not None and not cell.arms else [now, *(one.seed for one in self.demonstrations)]
        drawn = [seed for seed in seeds if seed is not None and seed < min(SPLITS.values())]
        self.session.new_scene(max(drawn, default=-1) + 1)

    def _count(self) -> None:
        kept = len(self.demonstrations)
        words = f"**{kept} demonstration{'' if kept == 1 else 's'} kept** in `{self.folder}`"
        if self._grippers:
            words += " (aim: ten)"
        if len(self._grippers) > 1:
            words += f"\n\nKeys move the **{self._grippers[self._arm]}** gripper; **C** changes to the other."
        self._kept.content = words

    def _follow(self, gizmo: viser.TransformControlsHandle, arm: int) -> None:
        """Let the arm follow its handle."""

        def aim(event: viser.TransformControlsEvent) -> None:
            pose = pose_of(gizmo)
            self._dragged = None if event.phase == "end" else arm
            self.session.post(lambda: self.session.aim(arm, pose))
            if event.phase == "end":
                self._targets[arm] = 0.0
                self.session.post(self.session.release)

        callback = self._controls.held(aim)

        async def dragged(event: viser.TransformControlsEvent) -> None:
            await callback(event)
            if self._dragged is None and arm < len(self._targets):  # an onlooker's drag: put the handle back
                self._targets[arm] = 0.0

        gizmo.on_update(dragged)

    async def _forget_drag(self, client: viser.ClientHandle) -> None:
        self._dragged = None

    def _keep(self, event: Any) -> None:
        def keep() -> None:
            self.session.keep(self.folder)
            self._new_scene()

        self.session.post(keep)

    def _undo(self, event: Any) -> None:
        self.session.post(lambda: self.session.undo(self._back.value))

    def _discard(self, event: Any) -> None:
        self.session.post(self.session.discard)

    def _grip(self, event: Any) -> None:
        now, before = time.monotonic(), self._gripped_at
        self._gripped_at = now
        if now - before > KEY_REPEAT_S:
            self.session.post(partial(self.session.grip, self._arm))

    def _choose_arm(self) -> None:
        self._arm = (self._arm + 1) % max(len(self._grippers), 1)
        self._count()

    def _nudge(self, way: tuple[int, int, int], turn: int, event: Any) -> None:
        """Shift or turn the gripper by one step, in the directions that the browser sees."""
        look = np.asarray(event.client.camera.look_at) - np.asarray(event.client.camera.position)
        yaw = np.round(np.arctan2(look[1], look[0]) / (np.pi / 2)) * np.pi / 2 - np.pi / 2
        shift = Rotation.from_euler("z", yaw).as_matrix() @ np.array(way) * NUDGE_M
        rotation = Rotation.from_euler("z", turn * NUDGE_RAD).as_matrix()
        self.session.post(partial(self.session.nudge, self._arm, shift, rotation))

    def _situation(self, status: Status) -> tuple[str, str]:
        """Colour and words for what goes on."""
        cell = self.session.cell
        task, goal = (cell.description, cell.goal) if cell else ("", "")
        if status.refusal:
            return markup.ORANGE, f"Out of reach: {status.refusal}"
        if cell is not None and not cell.arms:
            return markup.BLUE, f"{task}. Choose a scene and press Plan."
        if status.phase == "ready":
            what_next = "Move the gripper to record" + (", or press Plan." if self.demonstrations else ".")
            return markup.BLUE, f"Your turn: {task}. {what_next}"
        if status.phase == "recording":
            if status.is_full:
                return markup.ORANGE, "The longest recording is reached: keep it (Enter), undo (Z), or discard it (X)."
            seconds = f"● Recording, {np.floor(status.seconds * 2) / 2:.1f} s. "
            if status.failure == "":
                return markup.GREEN, f"{seconds}Done: {goal}. Press Enter to keep it."
            return markup.GREY, f"{seconds}Not done yet{': ' + status.failure if status.failure else ''}"
        if status.phase == "playing":
            return markup.BLUE, "The arm executes the plan."
        return markup.GREY, "The plan has ended; nothing is recorded now. Begin again (X), or choose another scene."

    def _tell(self, colour: str, text: str) -> None:
        told = markup.box(colour, text, "studio-banner")
        if told != self._told:
            self._told = self._banner.content = told
