"""Arguments that several commands share."""

import argparse
from collections.abc import Callable
from pathlib import Path

from robust_instant_policy.perception import CORRESPONDENCES
from robust_instant_policy.perception.network import require_features, require_weights
from robust_instant_policy.plugins import load_class
from robust_instant_policy.policies.settings import CONFIGS, WORDS, Settings
from robust_instant_policy.tasks.level import LEVELS, PAPER
from robust_instant_policy.tasks.task import bounded_seed

DATA = Path("data")  # demonstrations, one folder per task
RUNS = Path("runs")
CHECKPOINTS = Path("checkpoints")


def natural(text: str) -> int:
    """A whole number, 0 or more."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"must be a whole number, not {text!r}")
    return int(text)


def seed(text: str) -> int:
    """A whole number, 0 or more; one that is too large for simulators and tables is mapped to a smaller one."""
    return bounded_seed(natural(text))


def positive(text: str) -> int:
    """A whole number, 1 or more."""
    if natural(text) == 0:
        raise argparse.ArgumentTypeError("must be at least 1")
    return int(text)


def share(least: float) -> Callable[[str], float]:
    """The type of a number from ``least`` to 1."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = -1.0
        if not least <= value <= 1:
            raise argparse.ArgumentTypeError(f"must be a number from {least:g} to 1, not {text!r}")
        return value

    return parse


def add_demos(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--demos", type=Path, required=True, metavar="DIR", help="folder of demonstrations")


def add_assets(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--assets",
        choices=("code", "maniskill"),
        default="code",
        help="objects: built in code, or downloaded for it",
    )


def add_level(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--level",
        choices=tuple(LEVELS),
        default=PAPER.name,
        help="difficulty of the scenes: as in the paper, or with camera noise, rotated objects, distractors, "
        "other tables and light, hidden parts and start poses",
    )


def data_folder(assets: str, level: str, demo_set: int = 0) -> Path:
    """Where demonstrations with these objects at this level are kept, those of one set apart from those of others."""
    unusual = [value for value, usual in ((assets, "code"), (level, PAPER.name)) if value != usual]
    return DATA.joinpath(*unusual, *([f"set-{demo_set}"] if demo_set else []))


def add_rerun(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--rerun",
        metavar="FILE",
        help="also log for Rerun: a file that ends in .rrd, live (a viewer is started), or a viewer's address",
    )


def add_llm(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--llm", default="embedded", help="language model: embedded, gguf:PATH, openai:MODEL or http://…#MODEL"
    )


def add_method(parser: argparse.ArgumentParser) -> None:
    """Add the language model and the settings of the method, which `planning.fitted_policy` reads."""
    add_llm(parser)
    parser.add_argument("--queries", type=positive, default=5, metavar="Q", help="samples per plan")
    parser.add_argument(
        "--config",
        choices=tuple(CONFIGS),
        default="adaptive",
        help="paper, paper-real: as in the paper, with a column of its Table II; the settings below change parts of it",
    )
    add_keypoints(parser, "auto, or dino with --config paper", "registration, or nearest with --config paper")
    for name, words in (
        ("frames", "frames of the prompt"),
        ("layout", "layout of the prompt"),
        ("downsampling", "masked keeps gripper changes"),
        ("estimator", "regression; em-number: the model of the paper's networks, fitted exactly"),
    ):
        parser.add_argument(f"--{name}", choices=WORDS[name], help=f"{words} (default: that of --config)")
    parser.add_argument(
        "--deadline", type=positive, default=300, metavar="SECONDS", help="limit for the answers of one plan"
    )


def add_keypoints(parser: argparse.ArgumentParser, features: str, correspondence: str) -> None:
    """Add the settings of the keypoints; their defaults in words."""
    parser.add_argument("--features", help=f"image descriptors (default: {features})")
    parser.add_argument(
        "--keypoints",
        help="registration of objects, nearest descriptors as in the paper, or module:Class for a source of your own "
        f"(default: {correspondence})",
    )


def method_settings(options: argparse.Namespace) -> Settings:
    """Those of ``--config``, and what was given beside it. Raises `ModelError` for unknown ``--features``."""
    if options.features is not None:
        require_features(options.features)
    names = ("features", "keypoints", "frames", "layout", "downsampling", "estimator")
    given = {name: getattr(options, name) for name in names}
    return Settings.of(options.config).changed(**{name: value for name, value in given.items() if value is not None})


def require_keypoints(settings: Settings) -> None:
    """Raises `ModelError` where the keypoints of ``settings`` need weights that cannot be had, `UsageError` for a
    source that does not exist; to call before long work."""
    if settings.keypoints in CORRESPONDENCES:
        require_weights(settings.features)
    elif isinstance(settings.keypoints, str):
        load_class("keypoints", settings.keypoints)


def beside(folder: Path, ending: str) -> Path:
    """Path of a page beside ``folder``, with its name."""
    named = folder if folder.name and folder.name != ".." else folder.resolve()
    return named.parent / (named.name + ending)  # "/" has no name
