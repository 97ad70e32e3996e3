"""Run suites of variants in scenes with a pool of workers; rows are stored one by one, so a run can be resumed."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robust_instant_policy.datasets.folder import holds_demonstrations
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.evaluation.episodes import Episode, Trial
from robust_instant_policy.evaluation.failures import Failure, video_file
from robust_instant_policy.evaluation.manifest import code_digest
from robust_instant_policy.evaluation.recording import Recording, record_all
from robust_instant_policy.evaluation.scenes import demonstration_digests, demonstrations_folder, stored_demonstrations
from robust_instant_policy.evaluation.store import ResultsStore
from robust_instant_policy.evaluation.suites import Suite
from robust_instant_policy.evaluation.variant import Scene, Variant
from robust_instant_policy.evaluation.work import Outcome, Planned, SceneWork, Setup, Workers
from robust_instant_policy.evaluation.workbench import Workbench
from robust_instant_policy.files import file_stem, lock_folder, make_folder, write_whole
from robust_instant_policy.llm import model_name
from robust_instant_policy.perception.network import resolve_features
from robust_instant_policy.policies import IMAGE_METHODS, TRAINED_METHODS
from robust_instant_policy.policies.training import TrainingReport, no_report

if TYPE_CHECKING:  # it needs the extra "train"
    from robust_instant_policy.policies.diffusion.training import TrainedPolicy

PLAN_FOLDER, TRAINING_FOLDER = "plans", "training"


def ignore(*_: object) -> None:
    """The default callback."""


@dataclass(frozen=True)
class Progress:
    """Callbacks: ``recording(task, episodes stored, episodes wanted, attempts discarded)``, ``outcome(plans done, plans
    wanted, the new outcome, or None at the start)``, ``training`` while a method is trained, ``trained(task, variant,
    policy)`` after that, and ``note`` with a line for the user.
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
    recorders: int = 1,
) -> None:
    """Run what is missing of ``suites`` in ``out``: executions, and the analysis of failed ones.

    Missing demonstrations are recorded in ``setup.data/TASK``, of ``recorders`` tasks at a time. Plans that several
    suites contain are made once, and all plans of a scene together, so that they share samples. Rows of another version
    of the code do not count as done unless ``keep``; rows with other demonstrations never do. The manifest stores
    ``arguments``, the command line.
    """
    suites = [identified(suite, setup) for suite in suites]
    make_folder(out)
    with (
        one_writer(out),
        closing(ResultsStore(out)) as store,
        store.invocation(suites, arguments, model_name(setup.llm)),
    ):
        results = store.results()
        executed = by_trial(results.episodes)
        trials = _with_demonstrations(wanted_trials(suites), executed, setup, progress, keep, recorders)
        if keep:
            complete = {_apart_from("code", trial) for trial, rows in executed.items() if is_complete(rows)}
            trials = [trial for trial in trials if trial in executed or _apart_from("code", trial) not in complete]
        if repeated := _superseded(trials, executed):
            progress.note(
                f"{repeated} plans were executed with other code, demonstrations, features or deadline; these rows "
                "stay apart, and the plans are executed again (--keep leaves out what only the code tells apart)"
            )
        done = sum(is_complete(executed.get(trial, ())) for trial in trials)
        progress.outcome(done, len(trials), None)
        chosen = partial(_apart_from, "demonstrations")
        drawn = set(map(chosen, wanted_trials(suite for suite in suites if suite.keeps_plans)))
        kept = {trial for trial in trials if chosen(trial) in drawn}
        works = missing_work(trials, kept, executed, results.failures, out, setup.films, setup.analyses)
        if not works:
            return
        _train_missing(works, setup, progress)
        for outcome in workers(setup, works):
            if isinstance(outcome, Episode):
                store.add(outcome)
                rows = executed.setdefault(outcome.trial, [])
                rows.append(outcome)
                done += is_complete(rows)
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
    """Lock the run's folder ``out``. Raises `DatasetError` if another process writes to it, or if it holds
    demonstrations."""
    if holds_demonstrations(out):
        raise DatasetError(f"{out} holds demonstrations; give a folder of its own for the results")
    descriptor = lock_folder(out)
    try:
        yield
    finally:
        os.close(descriptor)


def identified(suite: Suite, setup: Setup) -> Suite:
    """``suite`` with the keys of its rows filled in, except the demonstrations: network, code, deadline."""
    decided = partial(replace, code=code_digest(), deadline_s=setup.deadline_s)
    variants = (decided(variant, features=resolve_features(variant.features)) for variant in suite.variants)
    return replace(suite, variants=tuple(variants))


def wanted_trials(suites: Iterable[Suite]) -> list[Trial]:
    """The plans of all ``suites``, each once, ordered by scene."""
    by_scene: dict[Scene, dict[Variant, None]] = {}
    for suite in suites:
        for scene in suite.scenes:
            by_scene.setdefault(scene, {}).update(dict.fromkeys(suite.variants))
    return [(scene, variant) for scene, variants in by_scene.items() for variant in variants]


def by_trial(rows: Iterable[Episode]) -> dict[Trial, list[Episode]]:
    """The executions of each plan."""
    executed: dict[Trial, list[Episode]] = {}
    for row in rows:
        executed.setdefault(row.trial, []).append(row)
    return executed


def is_complete(rows: Sequence[Episode]) -> bool:
    """Whether ``rows`` are all executions of their plan."""
    return bool(rows) and len(rows) == rows[0].candidates


def plan_file(scene: Scene, variant: Variant) -> str:
    """Path in a run's folder of a plan that is stored for a figure."""
    return f"{PLAN_FOLDER}/{scene}-{variant.file_name}.json"


def training_file(task: str, variant: Variant) -> str:
    """Path in a run's folder of the figure about the training of ``variant`` on ``task``."""
    return f"{TRAINING_FOLDER}/{file_stem(task)}-{variant.file_name}.svg"


def missing_work(
    trials: Iterable[Trial],
    kept: Collection[Trial],
    executed: Mapping[Trial, Sequence[Episode]],
    failures: Iterable[Failure],
    out: Path,
    films: bool,
    analyses: bool = True,
) -> list[SceneWork]:
    """The missing work for ``trials``, one value a scene. The plans of the trials in ``kept`` are stored in files."""
    examined = {failure.key for failure in failures}

    def is_analysed(row: Episode) -> bool:
        filmed = not films or row.executed_seconds == 0 or (out / video_file(*row.key)).exists()
        return row.key in examined and filmed

    works: dict[Scene, SceneWork] = {}
    for scene, variant in trials:
        rows = executed.get((scene, variant), ())
        planned = (scene, variant) not in kept or (out / plan_file(scene, variant)).exists()
        work = works.get(scene, SceneWork(scene))
        works[scene] = SceneWork(
            scene,
            work.variants if is_complete(rows) else (*work.variants, variant),
            work.done.union(row.key for row in rows),
            (*work.failed, *(row for row in rows if analyses and not row.success and not is_analysed(row))),
            work.plans if planned else (*work.plans, variant),
        )
    return [work for work in works.values() if work.concerned]


def _apart_from(settings: str, trial: Trial) -> Trial:
    """``trial`` without the ``settings`` of its variant (names separated by spaces)."""
    scene, variant = trial
    empty: dict[str, Any] = dict.fromkeys(settings.split())
    return scene, replace(variant, **empty)


def _superseded(trials: Iterable[Trial], executed: Collection[Trial]) -> int:
    """Number of ``trials`` without executions for which there are executions with other code, demonstrations, …"""
    chosen = partial(_apart_from, "code demonstrations features deadline_s")
    begun = set(map(chosen, executed))
    return sum(trial not in executed and chosen(trial) in begun for trial in trials)


def _with_demonstrations(
    trials: Sequence[Trial],
    executed: Mapping[Trial, Sequence[Episode]],
    setup: Setup,
    progress: Progress,
    keep: bool,
    recorders: int,
) -> list[Trial]:
    """``trials`` with the digest of their demonstrations. Missing demonstrations are recorded.

    If demonstrations of a task are missing but all its executions are there, the digests of these rows are used.
    """
    plain = partial(_apart_from, "code demonstrations" if keep else "demonstrations")
    done = {plain(trial): trial[1].demonstrations for trial, rows in executed.items() if is_complete(rows)}
    most: dict[tuple[str, bool], int] = {}
    for scene, variant in trials:
        for with_images in {False, variant.method in IMAGE_METHODS}:
            most[scene.task, with_images] = max(variant.demos, most.get((scene.task, with_images), 0))
    lacking = []
    for (task, with_images), count in most.items():
        of_task = [trial for trial in trials if trial[0].task == task]
        folder = demonstrations_folder(setup.data, task, with_images)
        complete = len(stored_demonstrations(folder, task, count)) == count
        if not complete and not all(plain(trial) in done for trial in of_task):
            lacking.append(Recording(of_task[0][0], folder, count, with_images, setup.demo_set))
    record_all(lacking, recorders, progress.recording)
    digests = {}
    for (task, with_images), count in most.items():
        shown = stored_demonstrations(demonstrations_folder(setup.data, task, with_images), task, count)
        digests[task, with_images] = demonstration_digests(shown)

    def digest(trial: Trial) -> str:
        scene, variant = trial
        known = digests[scene.task, variant.method in IMAGE_METHODS]
        return known[variant.demos] if variant.demos < len(known) else done[plain(trial)]

    return [(trial[0], replace(trial[1], demonstrations=digest(trial))) for trial in trials]


def _train_missing(works: Sequence[SceneWork], setup: Setup, progress: Progress) -> None:
    """Train all methods that need it, before the workers start: each of them would train."""
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
