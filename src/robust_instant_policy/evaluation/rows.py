"""Rows of one kind in a parquet file that grows cheaply, and that a kill at any moment leaves whole."""

from __future__ import annotations

import io
import json
import os
import time
from collections.abc import Hashable
from dataclasses import MISSING, asdict, fields, is_dataclass
from pathlib import Path
from typing import IO, Any, Generic, Protocol, TypeVar, get_type_hints

import pyarrow as pa
import pyarrow.parquet as pq

from robust_instant_policy.errors import DatasetError
from robust_instant_policy.files import write_whole

FOLD_SECONDS = 5.0  # between two rewritings of the parquet file; rows in between are in the journal

_TYPES = {
    str: pa.string(),
    int: pa.int64(),
    float: pa.float64(),
    bool: pa.bool_(),
    float | None: pa.float64(),
    int | None: pa.int64(),
    bool | None: pa.bool_(),
}


class Row(Protocol):
    """A dataclass whose fields, and those of dataclasses in it, are the columns; ``key`` tells rows apart."""

    @property
    def key(self) -> Hashable: ...


R = TypeVar("R", bound=Row)


class RowFile(Generic[R]):
    """The rows of ``path``, each added once.

    A row is on disk when `add` returns: in the parquet file itself, or in a journal beside it (one line of JSON a row)
    that is folded into it every few seconds, on `close`, and before the next process adds its first row. Who only
    reads ``rows`` and does not `close` changes nothing on disk, and may do so while another process writes. A column
    that a file lacks because it is older has the default of its field.
    """

    def __init__(self, kind: type[R], path: str | Path):
        self.path = Path(path)
        self._kind = kind
        self._schema = pa.schema(_columns(kind))
        self._journal_path = self.path.with_suffix(".journal")
        self._journal: IO[str] | None = None
        journalled = self._read_journal()  # first: what is folded in meanwhile is then seen twice, not never
        self._table = self._read()
        self.rows: list[R] = [self._row(values) for values in self._table.to_pylist()]
        self._keys = {row.key for row in self.rows}
        self._pending: list[R] = []
        self._folded_at = time.monotonic()
        for row in journalled:
            if row.key not in self._keys:
                self._take(row)

    def add(self, row: R) -> None:
        """Keep ``row``, on disk when this returns; one whose key is known already is not kept twice."""
        if row.key in self._keys:
            return
        if self._journal is None:
            self._fold()
        self._take(row)
        try:
            if self._journal is None:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self._journal = self._journal_path.open("a", encoding="utf-8")
                self._journal.truncate(0)  # the rest of a row of which half was written
            self._journal.write(json.dumps(_flat(row)) + "\n")
            self._journal.flush()
            os.fsync(self._journal.fileno())
        except OSError as error:
            raise DatasetError(f"cannot write {self._journal_path}: {error.strerror or error}") from None
        if time.monotonic() - self._folded_at > FOLD_SECONDS:
            self._fold()

    def close(self) -> None:
        """Bring every row into the parquet file."""
        self._fold()
        if self._journal is not None:
            self._journal.close()
            self._journal = None
        self._journal_path.unlink(missing_ok=True)

    def _take(self, row: R) -> None:
        self.rows.append(row)
        self._keys.add(row.key)
        self._pending.append(row)

    def _fold(self) -> None:
        if self._pending:
            new = pa.Table.from_pylist([_flat(row) for row in self._pending], schema=self._schema)
            table = pa.concat_tables([self._table, new]).combine_chunks()
            buffer = io.BytesIO()
            pq.write_table(table, buffer)
            write_whole(self.path, buffer.getvalue())
            # one statement: a row is never in both, wherever Ctrl-C or a full disk ends this
            self._table, self._pending = table, []
            if self._journal is not None:
                self._journal.truncate(0)
        self._folded_at = time.monotonic()

    def _read(self) -> pa.Table:
        if not self.path.exists():
            return self._schema.empty_table()
        try:
            table = pq.read_table(self.path)
        except (pa.ArrowException, OSError) as error:
            raise DatasetError(f"{self.path} cannot be read ({error}); move it away to start again") from None
        known = _defaults(self._kind)
        for name in set(self._schema.names) - set(table.schema.names):
            if name in known:  # a setting that came after the file was written
                column = pa.array([known[name]] * len(table), self._schema.field(name).type)
                table = table.append_column(name, column)
        if set(table.schema.names) != set(self._schema.names):
            raise DatasetError(
                f"{self.path} has other columns than this version writes; move it away and run again with --replay, "
                "which makes its rows anew from the stored samples"
            )
        return table.select(self._schema.names).cast(self._schema)

    def _read_journal(self) -> list[R]:
        """What a killed run left, or a running one has not folded in yet; the last line may be half a row."""
        rows: list[R] = []
        try:
            lines = self._journal_path.read_text(encoding="utf-8").splitlines()
        except FileNotFoundError:
            return rows
        known = _defaults(self._kind)
        for line in lines:
            try:
                rows.append(self._row(known | json.loads(line)))
            except (ValueError, KeyError, TypeError):
                break
        return rows

    def _row(self, values: dict[str, Any]) -> R:
        return _build(self._kind, values)


def _columns(kind: type) -> list[tuple[str, pa.DataType]]:
    hints = get_type_hints(kind)
    columns: list[tuple[str, pa.DataType]] = []
    for field in fields(kind):
        hint = hints[field.name]
        columns += _columns(hint) if is_dataclass(hint) else [(field.name, _TYPES[hint])]  # type: ignore[arg-type]
    return columns


def _defaults(kind: type) -> dict[str, Any]:
    """The columns that need not be there, with the value they then have."""
    hints = get_type_hints(kind)
    known: dict[str, Any] = {}
    for field in fields(kind):
        if is_dataclass(hints[field.name]):
            known |= _defaults(hints[field.name])
        elif field.default is not MISSING:
            known[field.name] = field.default
    return known


def _flat(row: Any) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in asdict(row).items():
        flat |= value if isinstance(value, dict) else {name: value}
    return flat


def _build(kind: Any, values: dict[str, Any]) -> Any:
    hints = get_type_hints(kind)
    return kind(
        **{
            field.name: _build(hints[field.name], values) if is_dataclass(hints[field.name]) else values[field.name]
            for field in fields(kind)
        }
    )
