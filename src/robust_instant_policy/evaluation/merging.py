"""Several runs as one: the parts of a job that was spread by hand, or methods that were run apart."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from robust_instant_policy.errors import DatasetError, UsageError
from robust_instant_policy.evaluation.episodes import Episode, open_episodes
from robust_instant_policy.evaluation.experiment import PLAN_FOLDER, TRAINING_FOLDER, one_writer
from robust_instant_policy.evaluation.failures import Failure, open_failures, video_file
from robust_instant_policy.evaluation.manifest import Manifest
from robust_instant_policy.evaluation.work import STORE_FILE
from robust_instant_policy.files import finished_files, make_folder, write_whole
from robust_instant_policy.llm import SampleStore


@dataclass(frozen=True)
class Share:
    """What came from one ``folder``: executions that are new, and those that were there already."""

    folder: Path
    new: int
    known: int


def merge(folders: Sequence[Path], out: Path, report: Callable[[Share], None] = lambda share: None) -> list[Share]:
    """Bring the rows, samples, films, plans and commands of the runs in ``folders`` into the run in ``out``.

    ``out`` is made where there is none. What two of them did counts once: as ``out`` has it, else the first of
    ``folders``. Nothing of theirs is changed, and one that is still being run may be read. What was merged once is
    known the next time, so that a merge that was stopped is made whole by the same again. Raises `DatasetError` for a
    folder without executions, or that cannot be read, before anything is written.
    """
    if out.resolve() in [folder.resolve() for folder in folders]:
        raise UsageError(f"{out} is itself one of the runs; leave it out of them, or give a new folder")
    runs = [_Run.read(folder) for folder in folders]
    make_folder(out)
    shares = []
    with one_writer(out), closing(open_episodes(out)) as episodes, closing(open_failures(out)) as failures:
        for run in runs:
            before = len(episodes.rows)
            known = {row.key: row for row in episodes.rows}
            # of an execution that out has from elsewhere, nothing is taken
            own = {row.key for row in run.episodes if known.get(row.key, row) == row}
            for failure in run.failures:
                if failure.key in own:
                    failures.add(failure)
            for name in (*run.pictures(), *(video_file(*key) for key in own)):
                if (run.folder / name).exists() and not (out / name).exists():
                    write_whole(out / name, (run.folder / name).read_bytes())
            if (run.folder / STORE_FILE).exists():
                with closing(SampleStore(out / STORE_FILE)) as store:
                    store.take(run.folder / STORE_FILE)
            for episode in run.episodes:  # last: a row says that all that belongs to it is there
                episodes.add(episode)
            Manifest.read(out).joined(run.manifest).write(out)
            new = len(episodes.rows) - before
            shares.append(Share(run.folder, new, len(run.episodes) - new))
            report(shares[-1])
    return shares


@dataclass(frozen=True, eq=False)
class _Run:
    folder: Path
    manifest: Manifest
    episodes: Sequence[Episode]
    failures: Sequence[Failure]

    @classmethod
    def read(cls, folder: Path) -> _Run:
        episodes = open_episodes(folder).rows
        if not episodes:
            raise DatasetError(f"{folder} holds no executions; give folders that rip eval --out wrote")
        return cls(folder, Manifest.read(folder), episodes, open_failures(folder).rows)

    def pictures(self) -> Iterator[str]:
        """Files of plans and trainings, from the folder on."""
        for name in (PLAN_FOLDER, TRAINING_FOLDER):
            for path in sorted(finished_files(self.folder / name)):
                yield str(path.relative_to(self.folder))
