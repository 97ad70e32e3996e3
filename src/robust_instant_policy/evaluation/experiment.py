"""Experiments: suites of variants in scenes, done by workers, kept row by row, resumable at any moment."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from robust_instant_policy.evaluation.episodes import Episode, open_episodes
from robust_instant_policy.evaluation.failures import Failure, open_failures, video_file
from robust_instant_policy.evaluation.scenes import count_demonstrations, demonstrations_folder, obtain_demonstrations
from robust_instant_policy.evaluation.suites import Suite
from robust_instant_policy.evaluation.variant import Scene, Variant
from robust_instant_policy.evaluation.work import Hands, Outcome, Planned, SceneWork, Setup
from robust_instant_policy.evaluation.workbench import Workbench
from robust_instant_policy.files import lock_folder, make_folder, write_whole
from robust_instant_policy.policies import IMAGE_METHODS, TRAINED_METHODS
from robust_instant_policy.policies.training import TrainingReport, no_report
from robust_instant_policy.tasks import make_task

if TYPE_CHECKING:  # it needs the extra "train"
    from robust_instant_policy.policies.diffusion.training import TrainedPolicy

PLAN_FOLDER, TRAINING_FOLDER = "plans", "training"

Plan = tuple[Scene, Variant]


@dataclass(frozen=True)
class Progress:
    """Called as the run goes on: ``recording(task, there, wanted, thrown away)``, ``outcome(plans done, plans wanted,
    what has just come, or None at the start)``, ``training`` while a method is trained, and ``trained(task, variant,
    policy)`` when that is done.
    """

    recording: Callable[[str, int, int, int], None]
    outcome: Callable[[int, int, Outcome | None], None]
    training: TrainingReport = no_report
    trained: Callable[[str, Variant, TrainedPolicy], None] = lambda task, variant, policy: None


def run_suites(suites: Sequence[Suite], setup: Setup, out: Path, hands: Hands, progress: Progress) -> None:
    """Run what is missing of ``suites`` in ``out``: episodes, and the analysis of those that failed.

    Demonstrations are kept in ``setup.data/TASK`` and recorded where they are missing. What several suites ask for is
    done once, and everything in one scene together, so that its samples are asked for once.
    """
    make_folder(out)
    with one_writer(out), closing(open_episodes(out)) as episodes, closing(open_failures(out)) as failures:
        wanted = wanted_plans(suites)
        left = executions_left(episodes.rows)
        done = sum(left.get(plan) == 0 for plan in wanted)
        progress.outcome(done, len(wanted), None)
        kept = wanted_plans(suite for suite in suites if suite.keeps_plans)
        works = missing_work(wanted, kept, episodes.rows, failures.rows, out, setup.films)
        if not works:
            return
        _record_missing(works, setup, progress)
        _train_missing(works, setup, progress)
        for outcome in hands(setup, works):
            if isinstance(outcome, Episode):
                episodes.add(outcome)
                plan = outcome.scene, outcome.variant
                left[plan] = left.get(plan, outcome.candidates) - 1
                done += left[plan] == 0
            elif isinstance(outcome, Planned):
                path = out / plan_file(outcome.scene, outcome.variant)
                path.parent.mkdir(exist_ok=True)
                outcome.plan.save(path)
            else:
                failure = outcome.failure
                if outcome.video:
                    write_whole(out / video_file(failure.scene, failure.variant, failure.candidate), outcome.video)
                failures.add(failure)
            progress.outcome(done, len(wanted), outcome)


@contextmanager
def one_writer(out: Path) -> Iterator[None]:
    """Keep other processes from writing into the run's folder ``out``; `DatasetError` when one does."""
    descriptor = lock_folder(out)
    try:
        yield
    finally:
        os.close(descriptor)


def wanted_plans(suites: Iterable[Suite]) -> list[Plan]:
    """Every plan that ``suites`` ask for, once, those of one scene together."""
    by_scene: dict[Scene, dict[Variant, None]] = {}
    for suite in suites:
        for scene in suite.scenes:
            by_scene.setdefault(scene, {}).update(dict.fromkeys(suite.variants))
    return [(scene, variant) for scene, variants in by_scene.items() for variant in variants]


def executions_left(rows: Iterable[Episode]) -> dict[Plan, int]:
    """How many executions the plans that were begun still lack."""
    left: dict[Plan, int] = {}
    for row in rows:
        plan = row.scene, row.variant
        left[plan] = left.get(plan, row.candidates) - 1
    return left


def plan_file(scene: Scene, variant: Variant) -> str:
    """Where, in a run's folder, a plan is kept that is to be drawn."""
    return f"{PLAN_FOLDER}/{scene}-{variant.file_name}.json"


def training_file(task: str, variant: Variant) -> str:
    """Where, in a run's folder, a picture is kept of how a method learned ``task``."""
    return f"{TRAINING_FOLDER}/{task}-{variant.file_name}.svg"


def missing_work(
    wanted: Sequence[Plan],
    kept: Sequence[Plan],
    rows: Sequence[Episode],
    failures: Sequence[Failure],
    out: Path,
    films: bool,
) -> list[SceneWork]:
    """What is still to be done for the ``wanted`` plans, of which those ``kept`` go into files, scene by scene."""
    left = executions_left(rows)
    among = set(wanted)
    examined = {row.key for row in failures}
    variants: dict[Scene, list[Variant]] = {scene: [] for scene, _ in wanted}
    for scene, variant in wanted:
        if left.get((scene, variant)) != 0:
            variants[scene].append(variant)
    done: dict[Scene, set] = {scene: set() for scene in variants}
    failed: dict[Scene, list[Episode]] = {scene: [] for scene in variants}
    for row in rows:
        if (row.scene, row.variant) in among:
            done[row.scene].add(row.key)
            filmed = not films or row.executed_seconds == 0 or (out / video_file(*row.key)).exists()
            if not row.success and not (row.key in examined and filmed):
                failed[row.scene].append(row)
    plans: dict[Scene, list[Variant]] = {scene: [] for scene in variants}
    for scene, variant in kept:
        if not (out / plan_file(scene, variant)).exists():
            plans[scene].append(variant)
    return [
        SceneWork(scene, tuple(todo), frozenset(done[scene]), tuple(failed[scene]), tuple(plans[scene]))
        for scene, todo in variants.items()
        if todo or failed[scene] or plans[scene]
    ]


def _record_missing(works: Sequence[SceneWork], setup: Setup, progress: Progress) -> None:
    assets = works[0].scene.assets
    most: dict[tuple[str, bool], int] = {}
    for work in works:
        needs = {(work.scene.task, False): work.demos}
        for variant in work.concerned:
            if variant.method in IMAGE_METHODS:
                needs[work.scene.task, True] = max(needs.get((work.scene.task, True), 0), variant.demos)
        most |= {key: max(count, most.get(key, 0)) for key, count in needs.items()}
    for (name, with_images), count in most.items():
        folder = demonstrations_folder(setup.data, name, with_images)
        if count_demonstrations(folder, name) >= count:
            continue
        task = make_task(name, assets=assets)
        try:
            obtain_demonstrations(
                task, folder, count, lambda *so_far, name=name: progress.recording(name, *so_far), with_images
            )
        finally:
            task.close()


def _train_missing(works: Sequence[SceneWork], setup: Setup, progress: Progress) -> None:
    """Have checkpoints of everything that is trained, before workers would all train it at once."""
    trained: dict[tuple[str, Variant], SceneWork] = {}
    for work in works:
        for variant in work.concerned:
            if variant.method in TRAINED_METHODS:
                trained.setdefault((work.scene.task, variant), work)
    if not trained:
        return
    with closing(Workbench(setup, report=progress.training)) as bench:
        for (task, variant), work in trained.items():
            progress.trained(task, variant, bench.train(work, variant))
