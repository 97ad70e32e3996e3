"""`rip eval`: suites on the screen, with their samples and rows on disk, then tables, figures and a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from robust_instant_policy.console import StageConsole, TrainingScreen
from robust_instant_policy.evaluation import Analysis, Episode, Progress, Setup, Suite, run_suites
from robust_instant_policy.evaluation.cluster import Cluster
from robust_instant_policy.evaluation.episodes import EPISODES_FILE
from robust_instant_policy.evaluation.manifest import invocation
from robust_instant_policy.evaluation.processes import Processes
from robust_instant_policy.evaluation.publication import PAGE_FILE, publish
from robust_instant_policy.evaluation.work import Hands, Outcome
from robust_instant_policy.llm import model_name


def evaluate(
    suites: Sequence[Suite], setup: Setup, out: Path, workers: int | None, ray: str | None, arguments: Sequence[str]
) -> None:
    """Run what is missing of ``suites`` with ``workers`` processes (one), or on the Ray cluster at the address ``ray``.

    ``arguments`` are the words of the command, noted in the run's folder.
    """
    screen = StageConsole()

    def recording(task: str, there: int, count: int, thrown_away: int) -> None:
        screen.done_so_far(f"{task}: recording ({thrown_away} thrown away)", there, count)
        if there == count:
            screen.say(f"  {task}: {count} demonstrations recorded, {thrown_away} thrown away")

    def outcome(done: int, total: int, what: Outcome | None) -> None:
        if isinstance(what, Analysis):
            failure = what.failure
            screen.say(f"  {failure.scene} {failure.variant} #{failure.candidate}: lost by {failure.stage}")
        elif isinstance(what, Episode):
            verdict = "success" if what.success else f"failed: {what.failure}"
            screen.say(f"  {what.scene} {what.variant} #{what.candidate}: {verdict}")
        screen.done_so_far("plans executed", done, total)

    with invocation(out, suites, arguments, model_name(setup.llm)), screen.stage("evaluation"):
        run_suites(suites, setup, out, _hands(workers, ray), Progress(recording, outcome, TrainingScreen(screen)))
    screen.say("")
    screen.say(publish(out))
    screen.say(f"rows: {out / EPISODES_FILE}; all of it: {out / PAGE_FILE}")


def _hands(workers: int | None, ray: str | None) -> Hands:
    return Processes(workers or 1) if ray is None else Cluster(ray, workers)
