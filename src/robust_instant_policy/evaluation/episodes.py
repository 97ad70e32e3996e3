"""One row an execution, kept in a parquet file that a kill at any moment leaves whole."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from robust_instant_policy.errors import DatasetError

_TYPES = {
    "str": pa.string(),
    "int": pa.int64(),
    "float": pa.float64(),
    "bool": pa.bool_(),
    "float | None": pa.float64(),
}

Scene = tuple[str, str, str, int, int]  # task, objects, method, number of demonstrations, seed


@dataclass(frozen=True)
class Episode:
    """One execution of one trajectory.

    ``objects`` are "seen" in the demonstrations or "unseen"; ``candidate`` numbers the executions of one plan
    (0 where there is one); ``seconds`` is the wall time of planning; ``executed_seconds`` the time the robot
    moved; ``failure`` says in words what went wrong and is empty on success; ``tokens`` counts those read and
    written; ``confidence`` is the plan's.
    """

    task: str
    objects: str
    method: str
    demos: int
    seed: int
    candidate: int
    success: bool
    seconds: float
    executed_seconds: float
    tokens: int
    confidence: float | None
    failure: str

    @property
    def scene(self) -> Scene:
        """What identifies the plan this execution belongs to."""
        return self.task, self.objects, self.method, self.demos, self.seed


_SCHEMA = pa.schema([(field.name, _TYPES[str(field.type)]) for field in fields(Episode)])


class EpisodeTable:
    """``episodes.parquet``: read when opened, rewritten atomically whenever a scene is finished."""

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.rows: list[Episode] = []
        if self.path.exists():
            try:
                table = pq.read_table(self.path, schema=_SCHEMA)
            except (pa.ArrowException, OSError) as error:
                raise DatasetError(f"{self.path} cannot be read ({error}); move it away to start again") from None
            self.rows = [Episode(**row) for row in table.to_pylist()]

    @property
    def scenes(self) -> set[Scene]:
        """The plans whose executions are all there."""
        return {row.scene for row in self.rows}

    def add(self, rows: list[Episode]) -> None:
        """Add all executions of one plan; on disk when this returns."""
        self.rows.extend(rows)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        partial = self.path.with_suffix(".partial")
        try:
            pq.write_table(pa.Table.from_pylist([asdict(row) for row in self.rows], schema=_SCHEMA), partial)
            with open(partial, "rb") as file:
                os.fsync(file.fileno())
            os.replace(partial, self.path)
        except OSError as error:
            raise DatasetError(f"cannot write {self.path}: {error.strerror or error}") from None
