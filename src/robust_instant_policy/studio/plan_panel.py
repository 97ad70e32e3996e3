"""The tab "Plan": what was seen, the candidates, and what they agree on."""

import threading
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import viser

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import RipError, UsageError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.policies import CONFIGS, Plan, Settings
from robust_instant_policy.studio import markup
from robust_instant_policy.studio.controls import Controls
from robust_instant_policy.studio.drawing import FOLLOWED
from robust_instant_policy.studio.plan_view import DEMONSTRATION, GAUSSIAN, ROBUST, PlanView
from robust_instant_policy.studio.planner import PAPER_ESTIMATOR, Choices, Draft, Planner
from robust_instant_policy.studio.session import Session
from robust_instant_policy.studio.stage import Stage
from robust_instant_policy.trajectory import Trajectory

MOST_QUERIES = 10
MOST_NOISE_MM = 40
ESTIMATORS = ("em", PAPER_ESTIMATOR, "median", "mean")  # those that take milliseconds
LAYERS = {"Demonstrations": True, "Candidates": True, "Spread": True, "Frames": False}  # name: shown at first
NOTHING = markup.line("No plan yet.")
LEGEND = markup.legend(
    ("robust trajectory", ROBUST, "with its spread"),
    ("Gaussian mean", GAUSSIAN, ""),
    ("demonstrations", DEMONSTRATION, ""),
    ("candidates", FOLLOWED, "the paler, the less they count; dashed where hallucinated"),
)


class PlanPanel:
    """Builds its controls into the tab that is open in ``gui``. A plan is made from ``demonstrations``; what "New
    scene" does is ``new_scene``, and ``on_forget`` is called when a plan no longer holds."""

    def __init__(
        self,
        gui: viser.GuiApi,
        stage: Stage,
        session: Session,
        controls: Controls,
        llm: str,
        demonstrations: Callable[[], Sequence[Demonstration]],
        new_scene: Callable[[], None],
        on_forget: Callable[[], None],
    ):
        self._stage, self._session = stage, session
        self._demonstrations, self._on_forget = demonstrations, on_forget
        self._view = PlanView(stage.scene, controls.held, self._drag)
        self.planner = Planner(llm, self._show_progress, self._take_draft, self._end)
        self._draft: Draft | None = None
        self._plan: Plan | None = None
        self._observation: Observation | None = None
        self._dragged: dict[int, tuple[float, FloatArray]] = {}
        self._lock = threading.RLock()  # of all that is drawn: events of the page and the planner's thread change it
        self._config = gui.add_dropdown("Configuration", tuple(CONFIGS))
        controls.input(self._config, lambda _: self._configure())
        button = partial(controls.button, gui)
        button("New scene", lambda _: session.post(new_scene), icon=viser.Icon.DICE, color="gray")
        button("Plan", lambda _: session.post(self._start), icon=viser.Icon.BULB)
        self._bar = gui.add_progress_bar(0.0, visible=False, animated=True)
        self._doing = gui.add_html("")
        self._cancel = button("Cancel", lambda _: self._give_up(), color="gray", visible=False)
        self._trust = gui.add_html(NOTHING)
        self._queries = gui.add_slider("Candidates Q", min=1, max=MOST_QUERIES, step=1, initial_value=5)
        self._dof = gui.add_slider("ν of the t", min=0.5, max=10.0, step=0.5, initial_value=1.5)
        self._estimator = gui.add_dropdown("Estimator", ESTIMATORS)
        self._noise = gui.add_slider("Noise, mm", min=0, max=MOST_NOISE_MM, step=1, initial_value=0)
        self._draggable = gui.add_checkbox("Drag candidates", False, hint="a handle on each candidate; pull one away")
        self._picture = gui.add_html("")
        self._layers = {name: gui.add_checkbox(name, shown) for name, shown in LAYERS.items()}
        for handle in (self._queries, self._dof, self._estimator, self._noise, self._draggable, *self._layers.values()):
            controls.input(handle, lambda _: self._draw())
        self._points = gui.add_checkbox("Points", False)
        controls.input(self._points, lambda _: self._show_points())
        with gui.add_folder("Prompt", expand_by_default=False):
            self._prompt = gui.add_html("")

    @property
    def trajectory(self) -> Trajectory:
        """The robust trajectory of the present plan."""
        if self._plan is None:
            raise UsageError("there is no plan; press Plan first")
        return self._plan.trajectory

    def compared(self) -> dict[str, Trajectory]:
        """The trajectory of each method of `Draft.compared` from the present candidates."""
        if self._draft is None:
            raise UsageError("there is no plan; press Plan first")
        return {method: plan.trajectory for method, plan in self._draft.compared(self._choices()).items()}

    def show_compared(self, trajectories: dict[str, Trajectory]) -> None:
        """Draw the trajectories of several methods beside the plan, until it is drawn again."""
        with self._lock:
            self._view.compare(trajectories)

    def show_scene(self, observation: Observation) -> None:
        """There is a scene; the plan of another one is forgotten."""
        with self._lock:
            before = self._observation
            if before is not None and np.array_equal(before.rgb, observation.rgb):
                return  # the same scene again
            self._observation = observation
            self.planner.cancel()
            self._forget()
            self._picture.content = markup.keypoint_picture(observation.rgb)
        self._show_points()

    def _show_points(self) -> None:
        """Show the point cloud if it is wanted, or if there is nothing else to show."""
        cell = self._session.cell
        wanted = self._points.value or (cell is not None and not cell.arms)
        self._stage.show_points(self._observation if wanted else None)

    def _configure(self) -> None:
        self._estimator.value = "em" if self._config.value == "adaptive" else PAPER_ESTIMATOR
        self._draw()

    def _choices(self) -> Choices:
        with self._lock:
            dragged = dict(self._dragged)
        noise = self._noise.value / 1000
        return Choices(int(self._queries.value), self._dof.value, self._estimator.value, noise, dragged)

    def _start(self) -> None:
        session = self._session
        session.require_no_recording()
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
        self._doing.content = markup.line(f"{stage} …")
        self._bar.value = 100.0 if share is None else 100.0 * share

    def _take_draft(self, draft: Draft) -> None:
        with self._lock:
            first, self._draft = self._draft is None, draft
            if first and self._observation is not None:
                self._prompt.content = markup.prompt(draft.prompt)
                self._picture.content = markup.keypoint_picture(self._observation.rgb, draft.context, draft.scene)
        self._draw()

    def _give_up(self) -> None:
        self.planner.cancel()
        self._doing.content = markup.line("Planning was cancelled.")

    def _end(self, reason: str) -> None:
        self._cancel.visible = self._bar.visible = False
        self._doing.content = ""
        self._draw()
        if reason:
            self._session.watcher.on_message(f"no plan: {reason}")

    def _forget(self) -> None:
        self._draft = self._plan = None
        self._dragged.clear()
        self._view.clear()
        self._trust.content, self._prompt.content = NOTHING, ""
        self._on_forget()

    def _draw(self) -> None:
        """Regression on the candidates that are there, and what it gives drawn; takes milliseconds."""
        with self._lock:
            if self._draft is None:
                return
            choices = self._choices()
            try:
                plan, gaussian = self._draft.plan(choices), self._draft.gaussian(choices)
            except RipError as error:
                self._session.watcher.on_message(str(error))
                return
            self._plan = plan
            layers = [name for name, box in self._layers.items() if box.value]
            self._view.show(plan, gaussian, self._demonstrations(), layers, self._draggable.value)
            complete = not self._cancel.visible
            self._trust.content = markup.trust(plan, len(self._draft.proposal.candidates), complete) + LEGEND

    def _drag(self, index: int, at: float, way: FloatArray) -> None:
        with self._lock:
            self._dragged[index] = at, way
            self._draw()
