"""Merge runs: parts of a job that ran on several machines, or methods that were run separately."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from robust_instant_policy.errors import DatasetError, UsageError
from robust_instant_policy.evaluation.experiment import PLAN_FOLDER, TRAINING_FOLDER, one_writer
from robust_instant_policy.evaluation.failures import video_file
from robust_instant_policy.evaluation.store import ResultsStore, read_results
from robust_instant_policy.evaluation.work import STORE_FILE
from robust_instant_policy.files import finished_files, make_folder, read_regular, write_whole
from robust_instant_policy.llm import SampleStore


@dataclass(frozen=True)
class Share:
    """Number of executions of one ``folder`` that were ``new`` in the merged run, and that were ``known``."""

    folder: Path
    new: int
    known: int


def merge(folders: Sequence[Path], out: Path) -> list[Share]:
    """Copy rows, samples, videos, plans and commands of the runs in ``folders`` into the run in ``out``.

    ``out`` is created if it is missing. An execution that occurs several times counts once: that of ``out``, else that
    of the first folder. The folders are not changed; a run that is still in progress can be read. After an interruption
    the same call completes the merge. Raises `DatasetError`, before anything is written, for a folder that has no
    executions or cannot be read.
    """
    if out.resolve() in [folder.resolve() for folder in folders]:
        raise UsageError(f"{out} is itself one of the runs; leave it out of them, or give a new folder")
    runs = [(folder, read_results(folder)) for folder in folders]
    for folder, run in runs:
        if not run.episodes:
            raise DatasetError(f"{folder} holds no executions; give folders that rip eval --out wrote")
    make_folder(out)
    shares = []
    with one_writer(out), closing(ResultsStore(out)) as store:
        for folder, run in runs:
            known = {row.key: row for row in store.results().episodes}
            # a row of out wins, with its video and failure analysis
            own = {row.key for row in run.episodes if known.get(row.key, row) == row}
            pictures = (file for name in (PLAN_FOLDER, TRAINING_FOLDER) for file in finished_files(folder / name))
            for name in (*(str(file.relative_to(folder)) for file in pictures), *(video_file(*key) for key in own)):
                if (folder / name).exists() and not (out / name).exists():
                    write_whole(out / name, read_regular(folder / name))
            if (folder / STORE_FILE).exists():
                with closing(SampleStore(out / STORE_FILE)) as samples:
                    samples.take(folder / STORE_FILE)
            store.note(run.manifest)
            # last: a row implies that its files are complete
            store.add(*(failure for failure in run.failures if failure.key in own), *run.episodes)
            new = len({row.key for row in run.episodes} - known.keys())
            shares.append(Share(folder, new, len(run.episodes) - new))
        store.export()
    return shares
