"""Experiments: methods × tasks × scenes, resumable at any moment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from robust_instant_policy.datasets import DatasetWriter, load_demonstrations
from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.errors import NoDemonstrationsError
from robust_instant_policy.evaluation.episodes import Episode, EpisodeTable
from robust_instant_policy.evaluation.rollout import roll_out
from robust_instant_policy.evaluation.table import success_table
from robust_instant_policy.policies import InstantPolicy, make_policy
from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.record import record
from robust_instant_policy.tasks.task import Task

FIRST_TEST_SEED = 100_000  # demonstrations draw scenes from 0 on, tests from here on
SEEDS_A_RUN = 1_000  # apart, so that runs with different --seed share no scene


def scene_seed(seed: int, index: int) -> int:
    """Seed of the ``index``-th test scene of a run with ``--seed seed``."""
    return FIRST_TEST_SEED + seed * SEEDS_A_RUN + index


def obtain_demonstrations(
    task: Task, folder: Path, count: int, on_progress: Callable[[int, int, int], None] | None = None
) -> list[Demonstration]:
    """The first ``count`` demonstrations of ``task`` in ``folder``, recorded now where they are not there yet.

    ``on_progress`` receives (episodes there, episodes wanted, attempts thrown away).
    """
    try:
        there = len(load_demonstrations(folder, task=task.name))
    except NoDemonstrationsError:
        there = 0
    if there < count:
        with DatasetWriter(folder, task=task.name, description=task.description, rate_hz=task.record_hz) as writer:
            record(task, writer, count, on_progress=on_progress)
    return load_demonstrations(folder, task=task.name, limit=count)


@dataclass(frozen=True)
class Experiment:
    """What is compared: every method in ``num_episodes`` fresh scenes of every task."""

    tasks: Sequence[str]
    methods: Sequence[str]
    num_demonstrations: int = 10
    num_episodes: int = 10
    seed: int = 0
    num_queries: int = 5
    objects: str = "seen"

    @property
    def num_plans(self) -> int:
        return len(self.tasks) * len(self.methods) * self.num_episodes


def run_experiment(
    experiment: Experiment,
    out: Path,
    data: Path,
    make_instant: Callable[[Task], InstantPolicy],
    *,
    on_recording: Callable[[str, int, int, int], None],
    on_episodes: Callable[[int, int, list[Episode]], None],
) -> EpisodeTable:
    """Run what is missing of ``experiment`` in ``out/episodes.parquet`` and write ``out/table.md``.

    Demonstrations are kept in ``data/TASK`` and recorded where they are missing. All methods of a scene share
    the samples of one instant policy. ``on_episodes`` receives (plans done, plans in all, new rows).
    """
    table = EpisodeTable(out / "episodes.parquet")
    done = 0
    for task_name in experiment.tasks:
        scenes = table.scenes
        missing = {
            seed: methods
            for seed in (scene_seed(experiment.seed, index) for index in range(experiment.num_episodes))
            if (
                methods := [
                    method
                    for method in experiment.methods
                    if (task_name, experiment.objects, method, experiment.num_demonstrations, seed) not in scenes
                ]
            )
        }
        done += experiment.num_episodes * len(experiment.methods) - sum(map(len, missing.values()))
        on_episodes(done, experiment.num_plans, [])
        if not missing:
            continue
        task = make_task(task_name)
        try:
            demonstrations = obtain_demonstrations(
                task,
                data / task_name,
                experiment.num_demonstrations,
                partial(on_recording, task_name),
            )
            instant = make_instant(task)
            policies = {
                method: make_policy(method, instant, experiment.num_queries).fit(demonstrations)
                for method in dict.fromkeys(method for methods in missing.values() for method in methods)
            }
            if experiment.objects != "seen":
                task.close()
                task = make_task(task_name, experiment.objects)
            for seed, methods in missing.items():
                observation = task.reset(seed)
                for method in methods:
                    rows = roll_out(
                        task,
                        policies[method],
                        observation,
                        seed,
                        experiment.num_demonstrations,
                        experiment.objects,
                    )
                    table.add(rows)
                    (out / "table.md").write_text(success_table(table.rows))
                    done += 1
                    on_episodes(done, experiment.num_plans, rows)
        finally:
            task.close()
    return table
