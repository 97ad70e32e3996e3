"""`rip eval`: run suites, store samples and rows, then write tables, figures and a page."""

import argparse
from functools import partial
from pathlib import Path

from robust_instant_policy.commands.console import StageConsole, TrainingScreen
from robust_instant_policy.commands.options import (
    CHECKPOINTS,
    add_assets,
    add_level,
    add_method,
    data_folder,
    method_settings,
    natural,
    positive,
    require_keypoints,
    seed,
)
from robust_instant_policy.evaluation import (
    STORE_FILE,
    Analysis,
    Choice,
    Episode,
    Progress,
    Setup,
    Variant,
    make_suites,
    run_suites,
)
from robust_instant_policy.evaluation.processes import LocalWorkers
from robust_instant_policy.evaluation.scenes import SPLITS, first_demonstration_seed
from robust_instant_policy.evaluation.store import EPISODES_FILE
from robust_instant_policy.evaluation.work import Outcome, Workers
from robust_instant_policy.llm import check_server, model_name
from robust_instant_policy.policies import ASKING_METHODS
from robust_instant_policy.policies.training import DEFAULT_STEPS
from robust_instant_policy.reporting.publication import PAGE_FILE, publish
from robust_instant_policy.reporting.training import keep_training_picture


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--suite", nargs="+", metavar="SUITE", help="analyses of the paper: table1 demos queries dof downsampling "
        "trajectories, or all; metaworld, maniskill (default: --methods in --tasks, no suite)"
    )  # fmt: skip
    parser.add_argument("--tasks", nargs="+", metavar="TASK", help="default: push-cube, or those of the suite")
    parser.add_argument(
        "--methods", nargs="+", metavar="METHOD", help="rip rip-gauss mean rip-adaptive kat dp kat-dp neighbours gp, "
        "or replay, the demonstrator's own motion (default: rip rip-gauss mean kat, or those of the suite)"
    )  # fmt: skip
    parser.add_argument("--demos", type=positive, default=10, metavar="N", help="demonstrations per task")
    parser.add_argument("--episodes", type=positive, default=10, metavar="N", help="scenes per task")
    parser.add_argument("--seed", type=seed, default=0, help="seed of the first scene")
    parser.add_argument(
        "--objects", choices=("seen", "unseen"), help="as demonstrated, or others (default: those of the level)"
    )
    add_assets(parser)
    add_level(parser)
    parser.add_argument(
        "--sets", type=positive, default=1, metavar="N", help="sets of demonstrations, each of other scenes"
    )
    parser.add_argument("--first-set", type=natural, default=0, metavar="N", help="number of the first of these sets")
    parser.add_argument(
        "--split", choices=tuple(SPLITS), default="test", help="scenes for reported tests, or those for tuning"
    )
    parser.add_argument(
        "--replan", type=natural, default=0, metavar="N", help="plan again after N waypoints; 0: plan once"
    )
    parser.add_argument("--steps", type=positive, metavar="N", help="training steps of dp and kat-dp (default: 1000)")
    parser.add_argument(
        "--checkpoints", type=Path, default=CHECKPOINTS, metavar="DIR", help="folder of trained weights"
    )
    parser.add_argument("--replay", action="store_true", help="use stored samples only, without a model")
    parser.add_argument(
        "--workers", type=positive, metavar="N", help="processes (default: 1, or the cores of the Ray cluster)"
    )
    parser.add_argument("--ray", metavar="ADDRESS", help="use the Ray cluster at this address ('auto': the local one)")
    parser.add_argument(
        "--keep", action="store_true", help="do not repeat what another version of the code has executed"
    )
    parser.add_argument("--no-videos", action="store_true", help="no videos of failed episodes")
    parser.add_argument("--no-analysis", action="store_true", help="no causes and videos of failed episodes")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder, or one to continue")
    add_method(parser)


def run(options: argparse.Namespace) -> int:
    sets = range(options.first_set, options.first_set + options.sets)
    first_demonstration_seed(sets[-1])  # refuses more sets than there are before anything is recorded
    settings = method_settings(options)
    base = Variant.of(
        settings,
        demos=options.demos,
        queries=options.queries,
        model=model_name(options.llm),
        replan=options.replan,
    )
    choice = Choice(
        base,
        options.tasks,
        options.methods,
        options.episodes,
        options.seed,
        options.objects,
        options.assets,
        options.level,
        options.split,
        options.steps or DEFAULT_STEPS,
    )
    setups = [
        Setup(
            llm=options.llm,
            replay=options.replay,
            store=options.out / STORE_FILE,
            data=data_folder(options.assets, options.level, demo_set),
            deadline_s=float(options.deadline),
            films=not options.no_videos,
            checkpoints=options.checkpoints,
            demo_set=demo_set,
            analyses=not options.no_analysis,
        )
        for demo_set in sets
    ]
    workers: Workers = LocalWorkers(options.workers or 1)
    if options.ray is not None:
        from robust_instant_policy.evaluation.cluster import RayWorkers  # needs an extra

        workers = RayWorkers(options.ray, options.workers)
    suites = make_suites(options.suite or ["chosen"], choice)
    asks = any(variant.method in ASKING_METHODS for suite in suites for variant in suite.variants)
    if asks and not options.replay and not (options.out / STORE_FILE).exists():  # which may hold all the answers
        check_server(options.llm)
        require_keypoints(settings)
    screen = StageConsole()
    progress = _progress(screen, options.out)
    with screen.stage("evaluation"):
        for setup in setups:
            shown = [suite.with_demonstrations(setup.demo_set) for suite in suites]
            arguments = ["rip", *options.arguments]
            run_suites(shown, setup, options.out, workers, progress, arguments, options.keep, options.workers or 1)
    screen.say("")
    screen.say(publish(options.out))
    screen.say(f"rows: {options.out / EPISODES_FILE}; page: {options.out / PAGE_FILE}")
    return 0


def _progress(screen: StageConsole, out: Path) -> Progress:
    """Progress on the terminal, and figures about trained methods in the folder ``out``."""

    def recording(task: str, there: int, count: int, thrown_away: int) -> None:
        screen.done_so_far(f"{task}: recording ({thrown_away} discarded)", there, count)
        if there == count:
            screen.say(f"  {task}: {count} demonstrations recorded, {thrown_away} failed attempts discarded")

    def outcome(done: int, total: int, what: Outcome | None) -> None:
        if isinstance(what, Analysis):
            failure = what.failure
            screen.say(f"  {failure.scene} {failure.variant} #{failure.candidate}: failure due to {failure.stage}")
        elif isinstance(what, Episode):
            verdict = "success" if what.success else f"failed: {what.failure}"
            screen.say(f"  {what.scene} {what.variant} #{what.candidate}: {verdict}")
        screen.done_so_far("plans executed", done, total)

    return Progress(
        recording, outcome, TrainingScreen(screen), trained=partial(keep_training_picture, out), note=screen.say
    )
