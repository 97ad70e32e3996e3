"""`rip eval`: an experiment on the screen, with its samples and rows on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from robust_instant_policy.console import StageConsole
from robust_instant_policy.errors import UnknownNameError
from robust_instant_policy.evaluation import Episode, Experiment, run_experiment, success_table
from robust_instant_policy.llm import RecordedModel, ReplayedModel, SampleStore, connect, model_name
from robust_instant_policy.policies import METHOD_NAMES, InstantPolicy
from robust_instant_policy.tasks import TASK_NAMES
from robust_instant_policy.tasks.task import Task

STORE_FILE = "samples.sqlite"


def evaluate(
    experiment: Experiment, llm_spec: str, replay: bool, out: Path, data: Path, options: dict[str, Any]
) -> None:
    """Run what is missing of ``experiment`` and print its table.

    Every answer of the model is kept in ``out/samples.sqlite``; with ``replay`` no model is asked at all.
    """
    for kind, names, known in (
        ("task", experiment.tasks, TASK_NAMES),
        ("method", experiment.methods, METHOD_NAMES),
    ):
        for name in names:
            if name not in known:
                raise UnknownNameError(kind, name, known)
    screen = StageConsole()
    out.mkdir(parents=True, exist_ok=True)
    store = SampleStore(out / STORE_FILE)
    model = ReplayedModel(store, model_name(llm_spec)) if replay else RecordedModel(connect(llm_spec), store)

    def make_instant(task: Task) -> InstantPolicy:
        return InstantPolicy(model, workspace=task.workspace, **options)

    def on_recording(task: str, there: int, count: int, thrown_away: int) -> None:
        screen.done_so_far(f"{task}: recording ({thrown_away} thrown away)", there, count)

    def on_episodes(done: int, total: int, rows: list[Episode]) -> None:
        for row in rows:
            verdict = "success" if row.success else f"failed: {row.failure}"
            screen.say(f"  {row.task} {row.method} scene {row.seed} #{row.candidate}: {verdict}")
        screen.done_so_far("plans executed", done, total)

    try:
        with screen.stage("evaluation"):
            table = run_experiment(
                experiment, out, data, make_instant, on_recording=on_recording, on_episodes=on_episodes
            )
    finally:
        model.close()
        store.close()
    screen.say("")
    screen.say(success_table(table.rows))
    screen.say(f"rows: {table.path}")
