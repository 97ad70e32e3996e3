"""`rip eval`: suites on the screen, with their samples and rows on disk, then tables, figures and a page."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from robust_instant_policy.commands.console import StageConsole, TrainingScreen
from robust_instant_policy.commands.options import CHECKPOINTS, DATA, add_assets, add_method, positive, seed
from robust_instant_policy.evaluation import (
    STORE_FILE,
    Analysis,
    Choice,
    Episode,
    Progress,
    Setup,
    Suite,
    Variant,
    make_suites,
    run_suites,
)
from robust_instant_policy.evaluation.cluster import RayWorkers
from robust_instant_policy.evaluation.processes import LocalWorkers
from robust_instant_policy.evaluation.store import EPISODES_FILE
from robust_instant_policy.evaluation.work import Outcome, Workers
from robust_instant_policy.llm import model_name
from robust_instant_policy.policies.training import DEFAULT_STEPS
from robust_instant_policy.reporting.publication import PAGE_FILE, publish
from robust_instant_policy.reporting.training import keep_training_picture


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--suite", nargs="+", metavar="SUITE", help="analyses of the paper: table1 demos queries dof downsampling "
        "trajectories, or all (default: just --methods in --tasks)"
    )  # fmt: skip
    parser.add_argument("--tasks", nargs="+", metavar="TASK", help="default: push-cube, or those of the suite")
    parser.add_argument(
        "--methods",
        nargs="+",
        metavar="METHOD",
        help="of rip rip-gauss rip-adaptive kat dp kat-dp neighbours gp "
        "(default: rip rip-gauss kat, or those of the suite)",
    )
    parser.add_argument("--demos", type=positive, default=10, metavar="N")
    parser.add_argument("--episodes", type=positive, default=10, metavar="N", help="scenes (default: %(default)s)")
    parser.add_argument("--queries", type=positive, default=5, metavar="Q")
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--llm", default="embedded")
    parser.add_argument(
        "--objects", choices=("seen", "unseen"), default="seen", help="test with objects like those shown, or others"
    )
    add_assets(parser)
    parser.add_argument("--steps", type=positive, metavar="N", help="how long dp and kat-dp are trained")
    parser.add_argument(
        "--checkpoints", type=Path, default=CHECKPOINTS, metavar="DIR", help="where trained weights are"
    )
    parser.add_argument("--replay", action="store_true", help="answer from the stored samples only, without a model")
    parser.add_argument("--workers", type=positive, metavar="N", help="default: 1, or a Ray cluster's cores")
    parser.add_argument("--ray", metavar="ADDRESS", help="work on the Ray cluster at this address ('auto': this one)")
    parser.add_argument("--keep", action="store_true", help="do not run again what another version of the code has run")
    parser.add_argument("--no-videos", action="store_true", help="do not film failed episodes once more")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    add_method(parser)


def run(options: argparse.Namespace) -> int:
    base = Variant(
        "rip",
        demos=options.demos,
        queries=options.queries,
        downsampling=options.downsampling,
        frames=options.frames,
        layout=options.layout,
        features=options.features,
        model=model_name(options.llm),
    )
    steps = options.steps or DEFAULT_STEPS
    choice = Choice(
        base, options.tasks, options.methods, options.episodes, options.seed, options.objects, options.assets, steps
    )
    setup = Setup(
        llm=options.llm,
        replay=options.replay,
        store=options.out / STORE_FILE,
        data=DATA if options.assets == "code" else DATA / options.assets,
        deadline_s=float(options.deadline),
        films=not options.no_videos,
        checkpoints=options.checkpoints,
    )
    workers: Workers = (
        LocalWorkers(options.workers or 1) if options.ray is None else RayWorkers(options.ray, options.workers)
    )
    suites = make_suites(options.suite or ["chosen"], choice)
    evaluate(suites, setup, options.out, workers, ["rip", *options.arguments], options.keep)
    return 0


def evaluate(
    suites: Sequence[Suite], setup: Setup, out: Path, workers: Workers, arguments: Sequence[str], keep: bool
) -> None:
    """Run what is missing of ``suites`` in ``out``, on the screen; then tables, figures and page. See `run_suites`."""
    screen = StageConsole()

    def recording(task: str, there: int, count: int, thrown_away: int) -> None:
        screen.done_so_far(f"{task}: recording ({thrown_away} thrown away)", there, count)
        if there == count:
            screen.say(f"  {task}: {count} demonstrations recorded, {thrown_away} thrown away")

    def outcome(done: int, total: int, what: Outcome | None) -> None:
        if isinstance(what, Analysis):
            failure = what.failure
            screen.say(f"  {failure.scene} {failure.variant} #{failure.candidate}: failure due to {failure.stage}")
        elif isinstance(what, Episode):
            verdict = "success" if what.success else f"failed: {what.failure}"
            screen.say(f"  {what.scene} {what.variant} #{what.candidate}: {verdict}")
        screen.done_so_far("plans executed", done, total)

    progress = Progress(
        recording, outcome, TrainingScreen(screen), trained=partial(keep_training_picture, out), note=screen.say
    )
    with screen.stage("evaluation"):
        run_suites(suites, setup, out, workers, progress, arguments, keep)
    screen.say("")
    screen.say(publish(out))
    screen.say(f"rows: {out / EPISODES_FILE}; all of it: {out / PAGE_FILE}")
