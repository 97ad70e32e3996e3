"""Evaluation: suites of rollouts done by workers, rows, statistics, failure analysis."""

from robust_instant_policy.evaluation.episodes import Episode, open_episodes
from robust_instant_policy.evaluation.experiment import Progress, run_suites
from robust_instant_policy.evaluation.failures import Failure, open_failures
from robust_instant_policy.evaluation.merging import merge
from robust_instant_policy.evaluation.rows import RowFile
from robust_instant_policy.evaluation.scenes import obtain_demonstrations, scene_seed
from robust_instant_policy.evaluation.statistics import wilson_interval
from robust_instant_policy.evaluation.suites import SUITE_NAMES, Choice, Suite, make_suites
from robust_instant_policy.evaluation.variant import Scene, Variant
from robust_instant_policy.evaluation.work import STORE_FILE, Analysis, Setup

__all__ = [
    "STORE_FILE",
    "SUITE_NAMES",
    "Analysis",
    "Choice",
    "Episode",
    "Failure",
    "Progress",
    "RowFile",
    "Scene",
    "Setup",
    "Suite",
    "Variant",
    "make_suites",
    "merge",
    "obtain_demonstrations",
    "open_episodes",
    "open_failures",
    "run_suites",
    "scene_seed",
    "wilson_interval",
]
