"""`rip train`: train a method with progress output, and write a figure of the loss and of samples."""

import argparse
from contextlib import closing
from pathlib import Path

from robust_instant_policy.commands.console import StageConsole, TrainingScreen
from robust_instant_policy.commands.options import add_demos, positive, seed
from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.errors import UnknownNameError
from robust_instant_policy.files import write_whole
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.perception.network import resolve_features
from robust_instant_policy.plugins import is_own
from robust_instant_policy.policies import TRAINED_METHODS, Settings, make_trained_policy
from robust_instant_policy.policies.training import DEFAULT_STEPS, Training
from robust_instant_policy.reporting.training import training_picture
from robust_instant_policy.tasks import is_installed, make_task


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--task", required=True, help="name of the task")
    parser.add_argument("--method", required=True, metavar="METHOD", help="dp (needs images of all steps) or kat-dp")
    add_demos(parser)
    parser.add_argument("--limit", type=positive, metavar="N", help="use the first N demonstrations only")
    parser.add_argument("--steps", type=positive, metavar="N", help="training steps (default: 1000)")
    parser.add_argument("--seed", type=seed, default=0, help="seed of the training")
    parser.add_argument("--device", choices=("cpu", "cuda"), help="default: cuda if available")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder of checkpoints, for rip eval --checkpoints"
    )


def run(options: argparse.Namespace) -> int:
    """Write the checkpoint, and beside it a figure of the loss and of samples."""
    if options.method not in TRAINED_METHODS:
        raise UnknownNameError("trained method", options.method, TRAINED_METHODS)
    screen = StageConsole()
    steps = options.steps or DEFAULT_STEPS
    training = Training(options.out, steps, options.device, options.seed, report=TrainingScreen(screen))
    demonstrations = load_demonstrations(options.demos, task=options.task, limit=options.limit)
    # The resolved network, as `rip eval` does: it is part of the name of the checkpoint.
    settings = Settings(features=resolve_features("auto")).changed(workspace=_workspace(options.task))
    policy = make_trained_policy(options.method, settings, training)
    with screen.stage(f"{options.method} on {len(demonstrations)} demonstrations"):
        policy.fit(demonstrations)
    trained = policy.trained_
    picture = trained.path.with_suffix(".svg")
    write_whole(picture, training_picture(policy))
    screen.say(f"{trained.path}: {len(trained.losses)} steps in {trained.seconds:.0f} s")
    screen.say(f"{picture}: the loss, and samples beside demonstrations")
    return 0


def _workspace(task: str) -> FloatArray | None:
    """Workspace of the task, so that keypoints are those of the evaluation; None for one without a simulator."""
    if not (is_installed(task) or is_own(task)):
        return None
    with closing(make_task(task)) as simulated:
        return simulated.workspace
