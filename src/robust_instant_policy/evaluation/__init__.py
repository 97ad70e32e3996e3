"""Evaluation: suites of rollouts done by workers, one store of results, statistics and failure analysis."""

from robust_instant_policy.evaluation.episodes import Episode
from robust_instant_policy.evaluation.experiment import Progress, run_suites
from robust_instant_policy.evaluation.failures import Failure
from robust_instant_policy.evaluation.merging import merge
from robust_instant_policy.evaluation.scenes import obtain_demonstrations, scene_seed
from robust_instant_policy.evaluation.statistics import wilson_interval
from robust_instant_policy.evaluation.store import Results, ResultsStore, export_results, holds_results, read_results
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
    "Results",
    "ResultsStore",
    "Scene",
    "Setup",
    "Suite",
    "Variant",
    "export_results",
    "holds_results",
    "make_suites",
    "merge",
    "obtain_demonstrations",
    "read_results",
    "run_suites",
    "scene_seed",
    "wilson_interval",
]
