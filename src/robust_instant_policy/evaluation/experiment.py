"""Experiments: suites of variants in scenes, done by workers, kept row by row, resumable at any moment."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robust_instant_policy.datasets import layout
from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.evaluation.episodes import Episode, EpisodeKey, Trial
from robust_instant_policy.evaluation.failures import Failure, video_file
from robust_instant_policy.evaluation.manifest import code_digest
from robust_instant_policy.evaluation.scenes import (
    demonstration_digests,
    demonstrations_folder,
    obtain_demonstrations,
    stored_demonstrations,
)
from robust_instant_policy.evaluation.store import ResultsStore
from robust_instant_policy.evaluation.suites import Suite
from robust_instant_policy.evaluation.variant import Scene, Variant
from robust_instant_policy.evaluation.work import Outcome, Planned, SceneWork, Setup, Workers
from robust_instant_policy.evaluation.workbench import Workbench
from robust_instant_policy.files import lock_folder, make_folder, write_whole
from robust_instant_policy.llm import model_name
from robust_instant_policy.perception.network import resolve_features
from robust_instant_policy.policies import IMAGE_METHODS, TRAINED_METHODS
from robust_instant_policy.policies.training import TrainingReport, no_report
from robust_instant_policy.tasks import make_task

if TYPE_CHECKING:  # it needs the extra "train"
    from robust_instant_policy.policies.diffusion.training import TrainedPolicy

PLAN_FOLDER, TRAINING_FOLDER = "plans", "training"


def ignore(*_: object) -> None:
    """The default callback."""


@dataclass(frozen=True)
class Progress:
    """Called as the run goes on: ``recording(task, there, wanted, thrown away)``, ``outcome(trials done, trials wanted,
    what has just come, or None at the start)``, ``training`` while a method is trained, ``trained(task, variant,
    policy)`` when that is done, and ``note`` with a line that the user should read.
    """

    recording: Callable[[str, int, int, int], None] = ignore
    outcome: Callable[[int, int, Outcome | None], None] = ignore
    training: TrainingReport = no_report
    trained: Callable[[str, Variant, TrainedPolicy], None] = ignore
    note: Callable[[str], None] = ignore


def run_suites(
    suites: Sequence[Suite],
    setup: Setup,
    out: Path,
    workers: Workers,
    progress: Progress = Progress(),
    arguments: Sequence[str] = ("(called from Python)",),
    keep: bool = False,
) -> None:
    """Run what is missing of ``suites`` in ``out``: executions, and the analysis of those that failed.

    Demonstrations are kept in ``setup.data/TASK`` and recorded where they are missing. What several suites ask for is
    done once, and everything in one scene together, so that its samples are asked for once. Rows of another version of
    the code are not counted as done unless ``keep``; rows with other demonstrations never are. ``arguments`` are the
    words of the command, noted in the manifest.
    """
    suites = [identified(suite, setup) for suite in suites]
    make_folder(out)
    with (
        one_writer(out),
        closing(ResultsStore(out)) as store,
        store.invocation(suites, arguments, model_name(setup.llm)),
    ):
        episodes = store.results().episodes
        trials = _with_demonstrations(wanted_trials(suites), episodes, setup, progress, keep)
        left = executions_left(episodes)
        if keep:
            complete = {_of_any_code(trial) for trial, count in left.items() if count == 0}
            trials = [trial for trial in trials if trial in left or _of_any_code(trial) not in complete]
        if repeated := _superseded(trials, episodes):
            progress.note(
                f"{repeated} plans were executed with other code, demonstrations, features or deadline; these rows "
                "stay apart, and the plans are executed again (--keep leaves out what only the code tells apart)"
            )
        done = sum(left.get(trial) == 0 for trial in trials)
        progress.outcome(done, len(trials), None)
        drawn = set(wanted_trials(suite for suite in suites if suite.keeps_plans))
        kept = [trial for trial in trials if _of_any_demonstrations(trial) in drawn]
        works = missing_work(trials, kept, episodes, store.results().failures, out, setup.films)
        if not works:
            return
        _train_missing(works, setup, progress)
        for outcome in workers(setup, works):
            if isinstance(outcome, Episode):
                store.add(outcome)
                left[outcome.trial] = left.get(outcome.trial, outcome.candidates) - 1
                done += left[outcome.trial] == 0
            elif isinstance(outcome, Planned):
                path = out / plan_file(outcome.scene, outcome.variant)
                path.parent.mkdir(exist_ok=True)
                outcome.plan.save(path)
            else:
                failure = outcome.failure
                if outcome.video:
                    write_whole(out / video_file(failure.scene, failure.variant, failure.candidate), outcome.video)
                store.add(failure)
            progress.outcome(done, len(trials), outcome)


@contextmanager
def one_writer(out: Path) -> Iterator[None]:
    """Keep other processes from writing into the run's folder ``out``; `DatasetError` when one does, and for a folder
    of demonstrations."""
    if (out / layout.RIP_PATH).exists() or (out / layout.INFO_PATH).exists():
        raise DatasetError(f"{out} holds demonstrations; give a folder of its own for the results")
    descriptor = lock_folder(out)
    try:
        yield
    finally:
        os.close(descriptor)


def identified(suite: Suite, setup: Setup) -> Suite:
    """``suite`` with all that decides its rows but the demonstrations: network, code, deadline."""
    decided = partial(replace, code=code_digest(), deadline_s=setup.deadline_s)
    variants = (decided(variant, features=resolve_features(variant.features)) for variant in suite.variants)
    return replace(suite, variants=tuple(variants))


def wanted_trials(suites: Iterable[Suite]) -> list[Trial]:
    """Every plan that ``suites`` ask for, once, those of one scene together."""
    by_scene: dict[Scene, dict[Variant, None]] = {}
    for suite in suites:
        for scene in suite.scenes:
            by_scene.setdefault(scene, {}).update(dict.fromkeys(suite.variants))
    return [(scene, variant) for scene, variants in by_scene.items() for variant in variants]


def executions_left(rows: Iterable[Episode]) -> dict[Trial, int]:
    """How many executions the plans that were begun still lack."""
    left: dict[Trial, int] = {}
    for row in rows:
        left[row.trial] = left.get(row.trial, row.candidates) - 1
    return left


def plan_file(scene: Scene, variant: Variant) -> str:
    """Where, in a run's folder, a plan is kept that is to be drawn."""
    return f"{PLAN_FOLDER}/{scene}-{variant.file_name}.json"


def training_file(task: str, variant: Variant) -> str:
    """Where, in a run's folder, a picture is kept of how a method learned ``task``."""
    return f"{TRAINING_FOLDER}/{task}-{variant.file_name}.svg"


def missing_work(
    wanted: Sequence[Trial],
    kept: Sequence[Trial],
    rows: Sequence[Episode],
    failures: Sequence[Failure],
    out: Path,
    films: bool,
) -> list[SceneWork]:
    """What is still to be done for the ``wanted`` plans, of which those ``kept`` go into files, scene by scene."""
    left = executions_left(rows)
    examined = {row.key for row in failures}
    todo: defaultdict[Scene, list[Variant]] = defaultdict(list)
    plans: defaultdict[Scene, list[Variant]] = defaultdict(list)
    done: defaultdict[Scene, set[EpisodeKey]] = defaultdict(set)
    failed: defaultdict[Scene, list[Episode]] = defaultdict(list)
    for scene, variant in wanted:
        if left.get((scene, variant)) != 0:
            todo[scene].append(variant)
    among = set(wanted)
    for row in rows:
        if row.trial in among:
            done[row.scene].add(row.key)
            filmed = not films or row.executed_seconds == 0 or (out / video_file(*row.key)).exists()
            if not row.success and not (row.key in examined and filmed):
                failed[row.scene].append(row)
    for scene, variant in kept:
        if not (out / plan_file(scene, variant)).exists():
            plans[scene].append(variant)
    return [
        SceneWork(scene, tuple(todo[scene]), frozenset(done[scene]), tuple(failed[scene]), tuple(plans[scene]))
        for scene in dict.fromkeys(scene for scene, _ in wanted)
        if todo[scene] or failed[scene] or plans[scene]
    ]


def _of_any_code(trial: Trial) -> Trial:
    scene, variant = trial
    return scene, replace(variant, code="")


def _of_any_demonstrations(trial: Trial) -> Trial:
    scene, variant = trial
    return scene, replace(variant, demonstrations="")


def _superseded(trials: Sequence[Trial], rows: Sequence[Episode]) -> int:
    """How many of ``trials`` lack executions, but have some that differ only in settings that no user chose."""

    def chosen(trial: Trial) -> Trial:
        scene, variant = trial
        return scene, replace(variant, code="", demonstrations="", features="", deadline_s=None)

    own = {row.trial for row in rows}
    begun = {chosen(trial) for trial in own}
    return sum(trial not in own and chosen(trial) in begun for trial in trials)


def _with_demonstrations(
    trials: Sequence[Trial], rows: Sequence[Episode], setup: Setup, progress: Progress, keep: bool
) -> list[Trial]:
    """``trials`` with the digest of the demonstrations that they are shown, which are recorded where they are missing.

    Where a task's demonstrations are not at hand, and nothing that is wanted of it lacks executions, those that the
    rows tell of are taken.
    """

    def plain(trial: Trial) -> Trial:
        return _of_any_demonstrations(_of_any_code(trial) if keep else trial)

    done = {plain(trial): trial[1].demonstrations for trial, left in executions_left(rows).items() if left == 0}
    most: dict[tuple[str, bool], int] = {}
    for scene, variant in trials:
        for with_images in {False, variant.method in IMAGE_METHODS}:
            most[scene.task, with_images] = max(variant.demos, most.get((scene.task, with_images), 0))
    digests: dict[tuple[str, bool], list[str]] = {}
    for (task, with_images), count in most.items():
        folder = demonstrations_folder(setup.data, task, with_images)
        shown = stored_demonstrations(folder, task, count)
        of_task = [trial for trial in trials if trial[0].task == task]
        if len(shown) < count and not all(plain(trial) in done for trial in of_task):
            shown = _record(of_task[0][0], setup.demo_set, folder, count, with_images, progress)
        digests[task, with_images] = demonstration_digests(shown)

    def digest(trial: Trial) -> str:
        scene, variant = trial
        known = digests[scene.task, variant.method in IMAGE_METHODS]
        return known[variant.demos] if variant.demos < len(known) else done[plain(trial)]

    return [(trial[0], replace(trial[1], demonstrations=digest(trial))) for trial in trials]


def _record(
    scene: Scene, demo_set: int, folder: Path, count: int, with_images: bool, progress: Progress
) -> list[Demonstration]:
    task = make_task(scene.task, assets=scene.assets, level=scene.level)
    report = partial(progress.recording, scene.task)
    try:
        return obtain_demonstrations(task, folder, count, report, with_images, demo_set)
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
