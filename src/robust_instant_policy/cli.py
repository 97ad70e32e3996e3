"""The command ``rip``. Exit 0: the work was done; 1: something broke; 2: wrong usage."""

from __future__ import annotations

import argparse
import errno
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from robust_instant_policy import __version__
from robust_instant_policy.errors import RipError, UsageError

Command = Callable[[argparse.Namespace], int]
DEFAULT_DATA = Path("data")
DEFAULT_RUNS = Path("runs")
DEFAULT_CHECKPOINTS = Path("checkpoints")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line and return its exit status; errors become one line on standard error."""
    options = _parser().parse_args(arguments)
    try:
        return options.run(options)
    except KeyboardInterrupt:
        print("rip: stopped; what was finished is kept, run the same command again to go on", file=sys.stderr)
        return 1
    except RipError as error:
        if options.debug:
            raise
        print(f"rip: {error}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:  # the reader, such as head, has seen enough
        sys.stderr.close()
        return 0
    except OSError as error:
        if options.debug:
            raise
        print(f"rip: {_words_for(error)}", file=sys.stderr)
        return 1
    except Exception as error:
        if options.debug:
            raise
        print(f"rip: unexpected {type(error).__name__}: {error} (--debug shows where)", file=sys.stderr)
        return 1


def _words_for(error: OSError) -> str:
    where = f" at {error.filename}" if error.filename else ""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"no space left{where}; free some and run the same command again to go on"
    return f"{error.strerror or error}{where}"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="rip", description="Robust Instant Policy: show a robot a task a few times; it does it at once."
    )
    parser.add_argument("--version", action="version", version=f"rip {__version__}")
    parser.add_argument("--debug", action="store_true", help="show a traceback when something breaks")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def command(name: str, run: Command, summary: str) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=summary, description=summary)
        added.set_defaults(run=run)
        added.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help=argparse.SUPPRESS)
        return added

    demo = command("demo", _demo, "record demonstrations, plan in a new scene, execute, explain")
    demo.add_argument("--task", default="push-cube", help="task to show (default: %(default)s)")
    demo.add_argument("--llm", default="embedded", help="language model (default: %(default)s)")
    demo.add_argument("--seed", type=_natural, default=0, help="which new scene (default: %(default)s)")
    demo.add_argument("--demos", default="10", metavar="N|DIR", help="how many demonstrations, or a folder of them")
    demo.add_argument("--out", type=Path, help="run folder (default: runs/TASK-SEED)")
    _method_options(demo)

    record = command("record", _record, "record demonstrations into a dataset folder")
    record.add_argument("--task", required=True)
    record.add_argument("--episodes", type=_positive, default=10)
    record.add_argument("--seed", type=_natural, default=0, help="where a new folder starts drawing scenes")
    record.add_argument("--images", action="store_true", help="keep the camera's images along the way")
    record.add_argument(
        "--every", type=_positive, default=1, metavar="N", help="keep every N-th step only: 5 of 55 Hz leaves 11 Hz"
    )
    _assets_option(record)
    record.add_argument("--out", type=Path, required=True, metavar="DIR")

    plan = command("plan", _plan, "plan for one observation and write plan.json; nothing moves")
    plan.add_argument("--demos", required=True, metavar="DIR")
    plan.add_argument(
        "--observation", required=True, metavar="FILE", help=".npz with rgb, depth, intrinsics, camera_pose"
    )
    plan.add_argument("--llm", default="embedded")
    plan.add_argument("--queries", type=_positive, default=5, metavar="Q")
    plan.add_argument("--out", type=Path, default=Path("plan.json"), metavar="FILE")
    _method_options(plan)

    evaluate = command("eval", _eval, "the paper's evaluation, or a part of it; goes on where it stopped")
    evaluate.add_argument(
        "--suite", nargs="+", metavar="SUITE", help="analyses of the paper: table1 demos queries dof downsampling "
        "trajectories, or all (default: just --methods in --tasks)"
    )  # fmt: skip
    evaluate.add_argument("--tasks", nargs="+", metavar="TASK", help="default: push-cube, or those of the suite")
    evaluate.add_argument(
        "--methods",
        nargs="+",
        metavar="METHOD",
        help="of rip rip-gauss rip-adaptive kat dp kat-dp neighbours gp "
        "(default: rip rip-gauss kat, or those of the suite)",
    )
    evaluate.add_argument("--demos", type=_positive, default=10, metavar="N")
    evaluate.add_argument("--episodes", type=_positive, default=10, metavar="N", help="scenes (default: %(default)s)")
    evaluate.add_argument("--queries", type=_positive, default=5, metavar="Q")
    evaluate.add_argument("--seed", type=_natural, default=0)
    evaluate.add_argument("--llm", default="embedded")
    evaluate.add_argument(
        "--objects", choices=("seen", "unseen"), default="seen", help="test with objects like those shown, or others"
    )
    _assets_option(evaluate)
    evaluate.add_argument("--steps", type=_positive, metavar="N", help="how long dp and kat-dp are trained")
    evaluate.add_argument(
        "--checkpoints", type=Path, default=DEFAULT_CHECKPOINTS, metavar="DIR", help="where trained weights are"
    )
    evaluate.add_argument("--replay", action="store_true", help="answer from the stored samples only, without a model")
    evaluate.add_argument("--workers", type=_positive, metavar="N", help="default: 1, or a Ray cluster's cores")
    evaluate.add_argument("--ray", metavar="ADDRESS", help="work on the Ray cluster at this address ('auto': this one)")
    evaluate.add_argument("--no-videos", action="store_true", help="do not film failed episodes once more")
    evaluate.add_argument("--out", type=Path, required=True, metavar="DIR")
    _method_options(evaluate)

    train = command("train", _train, "train dp or kat-dp on demonstrations; goes on where it stopped")
    train.add_argument("--task", required=True)
    train.add_argument("--method", required=True, metavar="METHOD", help="dp or kat-dp")
    train.add_argument("--demos", type=Path, required=True, metavar="DIR", help="dp needs images along the way")
    train.add_argument("--limit", type=_positive, metavar="N", help="show it the first N of them only")
    train.add_argument("--steps", type=_positive, metavar="N", help="of gradient descent")
    train.add_argument("--seed", type=_natural, default=0)
    train.add_argument("--device", choices=("cpu", "cuda"), help="default: cuda where there is one")
    train.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="rip eval --checkpoints DIR finds it there"
    )

    report = command("report", _report, "write the report of a run, or of an evaluation, again")
    report.add_argument("folder", type=Path, metavar="DIR")

    merge = command("merge", _merge, "bring several evaluations together in one folder")
    merge.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folders that rip eval --out wrote")
    merge.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder, or one to be added to")

    view = command("view", _view, "a page that shows every demonstration of a folder")
    view.add_argument("--demos", type=Path, required=True, metavar="DIR")
    view.add_argument("--out", type=Path, metavar="FILE", help="the page (default: DIR.html)")

    keypoints = command("keypoints", _keypoints, "a page with the keypoints of demonstrations and new scenes, measured")
    keypoints.add_argument("--demos", type=Path, required=True, metavar="DIR")
    keypoints.add_argument(
        "--scenes", type=_positive, default=20, metavar="N", help="new scenes (default: %(default)s)"
    )
    keypoints.add_argument("--seed", type=_natural, default=0)
    keypoints.add_argument("--features", default="auto", help="image descriptors (default: %(default)s)")
    keypoints.add_argument("--noise", action="store_true", help="with the noise of a stereo depth camera")
    keypoints.add_argument("--out", type=Path, metavar="FILE", help="the page (default: DIR-keypoints.html)")

    samples = command("samples", _samples, "what a file of stored answers holds; export it")
    samples.add_argument("file", type=Path, metavar="FILE", help="samples.sqlite of an evaluation")
    samples.add_argument("--export", choices=("jsonl", "csv"), help="write all answers to standard output")

    command("doctor", _doctor, "what works on this machine, and what to do about what does not")
    return parser


def _assets_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--assets", choices=("code", "maniskill"), default="code", help="objects made in code, or ManiSkill's downloads"
    )


def _method_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--frames", choices=("adaptive", "world"), default="adaptive")
    parser.add_argument("--layout", choices=("factorised", "sequence"), default="factorised")
    parser.add_argument("--features", default="auto", help="image descriptors (default: %(default)s)")
    parser.add_argument("--downsampling", choices=("masked", "uniform"), default="masked")
    parser.add_argument(
        "--deadline", type=_positive, default=300, metavar="SECONDS", help="for the answers of one plan (default: 300)"
    )


def _method_settings(options: argparse.Namespace) -> dict[str, Any]:
    settings = {name: getattr(options, name) for name in ("frames", "layout", "features", "downsampling")}
    return {**settings, "deadline_s": float(options.deadline)}


def _natural(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"must be a whole number, not {text!r}")
    return int(text)


def _positive(text: str) -> int:
    if _natural(text) == 0:
        raise argparse.ArgumentTypeError("must be at least 1")
    return int(text)


def _demo(options: argparse.Namespace) -> int:
    if options.demos.isdecimal() and int(options.demos) == 0:
        raise UsageError("--demos 0: show the task at least once")
    from robust_instant_policy.demo import run_demo

    out = options.out or DEFAULT_RUNS / f"{options.task}-{options.seed}"
    run_demo(options.task, options.llm, options.seed, options.demos, out, DEFAULT_DATA, _method_settings(options))
    return 0


def _record(options: argparse.Namespace) -> int:
    from robust_instant_policy.console import StageConsole
    from robust_instant_policy.datasets import DatasetWriter
    from robust_instant_policy.tasks import make_task
    from robust_instant_policy.tasks.record import record

    screen = StageConsole()
    task = make_task(options.task, assets=options.assets)
    try:
        with (
            screen.stage(f"{options.episodes} demonstrations"),
            DatasetWriter(
                options.out, task=task.name, description=task.description, rate_hz=task.record_hz / options.every
            ) as writer,
        ):
            thrown_away = record(
                task,
                writer,
                options.episodes,
                seed=options.seed,
                with_images=options.images,
                every=options.every,
                on_progress=lambda there, count, _: screen.done_so_far("recording", there, count),
            )
    finally:
        task.close()
    screen.say(
        f"{options.out}: {options.episodes} demonstrations of {task.name}, {thrown_away} failed attempts thrown away"
    )
    return 0


def _plan(options: argparse.Namespace) -> int:
    from robust_instant_policy.console import StageConsole
    from robust_instant_policy.datasets import load_demonstrations
    from robust_instant_policy.demonstration import Observation
    from robust_instant_policy.llm import connect
    from robust_instant_policy.policies import RobustInstantPolicy

    screen = StageConsole()
    observation = Observation.load(options.observation)
    demonstrations = load_demonstrations(options.demos)
    with screen.stage(f"language model ({options.llm})"):
        model = connect(options.llm)
    try:
        policy = RobustInstantPolicy(
            model, num_queries=options.queries, progress=screen.done_so_far, **_method_settings(options)
        )
        with screen.stage("keypoints of the demonstrations"):
            policy.fit(demonstrations)
        with screen.stage("plan"):
            plan = policy.plan(observation)
    finally:
        model.close()
    plan.save(options.out)
    screen.say(f"{options.out}: {len(plan.trajectory)} steps, confidence {plan.confidence:.2f}")
    return 0


def _eval(options: argparse.Namespace) -> int:
    from robust_instant_policy.evaluate import evaluate
    from robust_instant_policy.evaluation import STORE_FILE, Choice, Setup, Variant, make_suites
    from robust_instant_policy.llm import model_name
    from robust_instant_policy.policies.training import DEFAULT_STEPS

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
        data=DEFAULT_DATA if options.assets == "code" else DEFAULT_DATA / options.assets,
        deadline_s=float(options.deadline),
        films=not options.no_videos,
        checkpoints=options.checkpoints,
    )
    evaluate(
        make_suites(options.suite or ["chosen"], choice),
        setup,
        options.out,
        options.workers,
        options.ray,
        ["rip", *sys.argv[1:]],
    )
    return 0


def _train(options: argparse.Namespace) -> int:
    from robust_instant_policy.policies.training import DEFAULT_STEPS, Training
    from robust_instant_policy.train import train

    training = Training(options.out, options.steps or DEFAULT_STEPS, options.device, options.seed)
    train(options.task, options.method, options.demos, options.limit, training)
    return 0


def _report(options: argparse.Namespace) -> int:
    from robust_instant_policy.evaluation.episodes import holds_episodes

    if holds_episodes(options.folder):
        from robust_instant_policy.evaluation.publication import PAGE_FILE, publish

        publish(options.folder)
        print(options.folder / PAGE_FILE)
        return 0
    from robust_instant_policy.report import write_report

    print(write_report(options.folder))
    return 0


def _merge(options: argparse.Namespace) -> int:
    from robust_instant_policy.evaluation.merging import Share, merge
    from robust_instant_policy.evaluation.publication import PAGE_FILE, publish

    def report(share: Share) -> None:
        print(f"{share.folder}: {share.new} executions, {share.known} more known already", flush=True)

    merge(options.runs, options.out, report)
    publish(options.out)
    print(options.out / PAGE_FILE)
    return 0


def _view(options: argparse.Namespace) -> int:
    from robust_instant_policy.datasets.page import write_page

    print(write_page(options.demos, options.out or _beside(options.demos, ".html")))
    return 0


def _keypoints(options: argparse.Namespace) -> int:
    from robust_instant_policy.keypoints import show_keypoints

    out = options.out or _beside(options.demos, "-keypoints.html")
    show_keypoints(options.demos, options.features, options.scenes, options.noise, options.seed, out)
    return 0


def _beside(folder: Path, ending: str) -> Path:
    named = folder if folder.name and folder.name != ".." else folder.resolve()
    return named.with_name(named.name + ending)


def _samples(options: argparse.Namespace) -> int:
    from robust_instant_policy.llm import SampleStore

    if not options.file.exists():
        raise UsageError(f"no stored answers at {options.file}; rip eval --out DIR keeps them in DIR/samples.sqlite")
    store = SampleStore(options.file)
    try:
        if options.export:
            store.export(sys.stdout, options.export)
            return 0
        print(f"{'model':<40}{'prompts':>10}{'answers':>10}{'tokens given':>15}{'tokens written':>16}")
        for held in store.models():
            print(
                f"{held.model:<40}{held.queries:>10,}{held.answers:>10,}"
                f"{held.prompt_tokens:>15,}{held.completion_tokens:>16,}"
            )
    finally:
        store.close()
    return 0


def _doctor(options: argparse.Namespace) -> int:
    from robust_instant_policy.doctor import examine

    healthy = True
    for finding in examine(Path.cwd()):
        healthy &= finding.works
        mark = "ok  " if finding.works else "FAIL"
        advice = "" if finding.works or not finding.remedy else f"\n      → {finding.remedy}"
        print(f"{mark}  {finding.name:<20}{finding.detail}{advice}", flush=True)
    return 0 if healthy else 1


if __name__ == "__main__":
    sys.exit(main())
