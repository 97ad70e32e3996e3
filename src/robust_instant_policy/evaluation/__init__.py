"""Evaluation: rollouts, resumable experiments, statistics, tables."""

from robust_instant_policy.evaluation.episodes import Episode, EpisodeTable
from robust_instant_policy.evaluation.experiment import (
    Experiment,
    obtain_demonstrations,
    run_experiment,
    scene_seed,
)
from robust_instant_policy.evaluation.rollout import roll_out
from robust_instant_policy.evaluation.statistics import wilson_interval
from robust_instant_policy.evaluation.table import success_table

__all__ = [
    "Episode",
    "EpisodeTable",
    "Experiment",
    "obtain_demonstrations",
    "roll_out",
    "run_experiment",
    "scene_seed",
    "success_table",
    "wilson_interval",
]
