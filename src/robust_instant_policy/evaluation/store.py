"""``results.sqlite``: executions, failure analyses, suites and commands of a run's folder.

The key of a row holds everything that decides it. ``episodes.parquet``, ``failures.parquet`` and ``run.json`` are
exports; a folder that holds only exports can be read, too.
"""

import json
import os
import shlex
import sqlite3
import time
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import MISSING, asdict, dataclass, field, fields, is_dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints
from urllib.parse import quote

import pyarrow as pa
import pyarrow.parquet as pq

from robust_instant_policy.datasets.tables import parquet
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.evaluation.episodes import Episode
from robust_instant_policy.evaluation.failures import Failure
from robust_instant_policy.evaluation.manifest import MANIFEST_FILE, Invocation, Manifest, code_version, machine
from robust_instant_policy.evaluation.suites import Suite
from robust_instant_policy.evaluation.variant import Scene, Variant
from robust_instant_policy.files import make_folder, open_regular, read_regular, write_whole

RESULTS_FILE = "results.sqlite"
EPISODES_FILE, FAILURES_FILE = "episodes.parquet", "failures.parquet"
BUSY_TIMEOUT_S = 60.0  # how long a write waits for another process

SUITES = """CREATE TABLE IF NOT EXISTS suites (name TEXT, objects TEXT, assets TEXT, level TEXT, content TEXT NOT NULL,
PRIMARY KEY (name, objects, assets, level))"""

_SQL_TYPES = {str: "TEXT", int: "INTEGER", float: "REAL", bool: "INTEGER"}
_ARROW_TYPES = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}


@dataclass(frozen=True)
class Results:
    """Content of a run's folder: ``episodes`` and ``failures``, oldest first, and the manifest."""

    episodes: tuple[Episode, ...] = ()
    failures: tuple[Failure, ...] = ()
    manifest: Manifest = field(default_factory=Manifest)


def holds_results(folder: Path) -> bool:
    """Whether ``folder`` is a run's folder."""
    return any((folder / name).exists() for name in (RESULTS_FILE, EPISODES_FILE))


def read_results(folder: Path) -> Results:
    """The results in ``folder``, empty if there are none. Reads only; a run may be in progress.

    Raises `DatasetError` for damaged files.
    """
    path = folder / RESULTS_FILE
    if path.exists():
        with _explained(path), closing(_connect(path, "rw")) as database:
            if _EPISODES.columns(database):  # else its writer was killed before it had read the exports
                return _read(database)
    return _read_exports(folder)


def export_results(folder: Path) -> None:
    """Write the exports of ``folder`` again, if it holds ``results.sqlite``."""
    if (folder / RESULTS_FILE).exists():
        _write_exports(folder, read_results(folder))


class ResultsStore:
    """The results of ``folder``, for one writer; reading is possible at any time.

    A row is on disk when `add` returns; a kill, a power cut or a full disk never leaves a part of a row. The journal is
    SQLite's rollback journal, because a write-ahead log does not work on network file systems.
    Raises `DatasetError` if the file is damaged or cannot be written.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.path = folder / RESULTS_FILE
        make_folder(folder)
        with _explained(self.path):
            self._database = _connect(self.path, "rwc")
        with self._transaction():
            is_new = not _EPISODES.columns(self._database)
            for table in (_EPISODES, _FAILURES, _INVOCATIONS):
                table.create(self._database)
            self._database.execute(SUITES)
            if is_new:
                self._take(_read_exports(folder))

    def close(self) -> None:
        self._database.close()

    def results(self) -> Results:
        with _explained(self.path):
            return _read(self._database)

    def add(self, *rows: Episode | Failure) -> None:
        """Store ``rows``, all or none; a row whose key exists is ignored."""
        with self._transaction():
            for row in rows:
                (_EPISODES if isinstance(row, Episode) else _FAILURES).insert(self._database, row)

    def note(self, manifest: Manifest) -> None:
        """Add the suites and commands of ``manifest``; suites of the same name and objects are merged."""
        with self._transaction():
            self._take(Results(manifest=manifest))

    @contextmanager
    def invocation(self, suites: Iterable[Suite], arguments: Iterable[str], model: str) -> Iterator[None]:
        """Store ``suites`` and, at the end of the ``with`` block (also after an error), the command; then export."""
        self.note(Manifest(tuple(suites)))
        began, start = datetime.now(UTC), time.monotonic()
        try:
            yield
        finally:
            command = Invocation(
                command=shlex.join(arguments),
                began=began.isoformat(timespec="milliseconds"),
                hours=round((time.monotonic() - start) / 3600, 4),
                machine=machine(),
                code=code_version(),
                model=model,
            )
            self.note(Manifest(invocations=(command,)))
            self.export()

    def export(self) -> None:
        """Write ``episodes.parquet``, ``failures.parquet`` and ``run.json``."""
        _write_exports(self.folder, self.results())

    def _take(self, results: Results) -> None:
        for episode in results.episodes:
            _EPISODES.insert(self._database, episode)
        for failure in results.failures:
            _FAILURES.insert(self._database, failure)
        known = {suite.identity: suite for suite in _read_suites(self._database)}
        for suite in results.manifest.suites:
            identity = suite.identity
            known[identity] = known[identity].merged(suite) if identity in known else suite
            self._database.execute(
                "INSERT INTO suites VALUES (?, ?, ?, ?, ?) ON CONFLICT DO UPDATE SET content = excluded.content",
                (*identity, json.dumps(asdict(known[identity]))),
            )
        for command in results.manifest.invocations:
            _INVOCATIONS.insert(self._database, command)

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with _explained(self.path), self._database:  # commits or rolls back
            self._database.execute("BEGIN IMMEDIATE")
            yield


class _Column(NamedTuple):
    """``default`` is MISSING for a required column."""

    kind: type
    may_be_empty: bool
    default: Any


class _Table:
    """A table with a column for each field of ``kind`` and of the dataclasses in it, and the unique ``key``."""

    def __init__(self, name: str, kind: type, key: Iterable[str]):
        self._name, self._kind = name, kind
        self._columns = _columns_of(kind)
        self._defaults = {name: one.default for name, one in self._columns.items() if one.default is not MISSING}
        self._key = list(key)
        marks = ", ".join(f":{column}" for column in self._columns)
        self._insert = f"INSERT OR IGNORE INTO {name} ({', '.join(self._columns)}) VALUES ({marks})"

    def create(self, database: sqlite3.Connection) -> None:
        """Create the table, or add the columns that an older version did not have."""
        columns = {column: _SQL_TYPES[one.kind] for column, one in self._columns.items()}
        known = self.columns(database)
        if not known:
            database.execute(f"CREATE TABLE {self._name} ({', '.join(map(' '.join, columns.items()))})")
        elif known != set(columns):
            self._check(known)
            for column in columns.keys() - known:
                database.execute(f"ALTER TABLE {self._name} ADD COLUMN {column} {columns[column]}")
                database.execute(f"UPDATE {self._name} SET {column} = ?", (self._defaults[column],))
            database.execute(f"DROP INDEX IF EXISTS {self._name}_key")
        # NULL differs from NULL in a unique index
        key = ", ".join(
            f"IFNULL({column}, '')" if self._columns[column].may_be_empty else column for column in self._key
        )
        database.execute(f"CREATE UNIQUE INDEX IF NOT EXISTS {self._name}_key ON {self._name} ({key})")

    def columns(self, database: sqlite3.Connection) -> set[str]:
        """The columns in the file; empty if the table does not exist."""
        return {row[1] for row in database.execute(f"PRAGMA table_info({self._name})")}

    def insert(self, database: sqlite3.Connection, row: Any) -> None:
        database.execute(self._insert, _flat(row))

    def read(self, database: sqlite3.Connection) -> Iterator[Any]:
        known = sorted(self.columns(database))
        self._check(set(known))
        for values in database.execute(f"SELECT {', '.join(known)} FROM {self._name} ORDER BY rowid"):
            yield self._row(self._defaults | dict(zip(known, values, strict=True)))

    def arrow(self, rows: Iterable[Any]) -> pa.Table:
        schema = pa.schema([(column, _ARROW_TYPES[one.kind]) for column, one in self._columns.items()])
        return pa.Table.from_pylist([_flat(row) for row in rows], schema=schema)

    def read_parquet(self, path: Path) -> Iterator[Any]:
        """The rows of an export; columns that it does not have get the default of their field."""
        if not path.exists():
            return
        try:
            table = pq.read_table(pa.BufferReader(read_regular(path)))  # any name, whatever the locale
        except (pa.ArrowException, OSError) as error:
            raise DatasetError(f"{path} cannot be read ({error}); move it away to start again") from None
        self._check(set(table.schema.names), path)
        for values in table.to_pylist():
            yield self._row(self._defaults | values)

    def _check(self, known: set[str], where: Path | str = RESULTS_FILE) -> None:
        if known - self._columns.keys() or self._columns.keys() - known - self._defaults.keys():
            raise DatasetError(
                f"{where} has other columns than this version writes; move it away and run again with --replay, "
                "which makes its rows anew from the stored samples"
            )

    def _row(self, values: dict[str, Any]) -> Any:
        for column, one in self._columns.items():
            if one.kind is bool and values[column] is not None:
                values[column] = bool(values[column])
        return _build(self._kind, values)


def _columns_of(kind: type) -> dict[str, _Column]:
    """One for each field of ``kind`` and of the dataclasses in it."""
    hints = get_type_hints(kind)
    found: dict[str, _Column] = {}
    for one in fields(kind):
        hint = hints[one.name]
        if is_dataclass(hint):
            found |= _columns_of(hint)  # type: ignore[arg-type]
        else:
            plain = next(known for known in _SQL_TYPES if hint in (known, known | None))
            found[one.name] = _Column(plain, hint != plain, one.default)
    return found


def _flat(row: Any) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in asdict(row).items():
        flat |= value if isinstance(value, dict) else {name: value}
    return flat


def _build(kind: Any, values: dict[str, Any]) -> Any:
    return kind(
        **{
            name: _build(hint, values) if is_dataclass(hint) else values[name]
            for name, hint in get_type_hints(kind).items()
        }
    )


_KEY = (*_columns_of(Scene), *_columns_of(Variant), "candidate")
_EPISODES = _Table("episodes", Episode, _KEY)
_FAILURES = _Table("failures", Failure, _KEY)
_INVOCATIONS = _Table("invocations", Invocation, _columns_of(Invocation))


def _read(database: sqlite3.Connection) -> Results:
    invocations = sorted(_INVOCATIONS.read(database), key=lambda command: command.began)
    manifest = Manifest(_read_suites(database), tuple(invocations))
    return Results(tuple(_EPISODES.read(database)), tuple(_FAILURES.read(database)), manifest)


def _read_suites(database: sqlite3.Connection) -> tuple[Suite, ...]:
    contents = database.execute("SELECT content FROM suites ORDER BY rowid")
    return tuple(Suite.from_json(json.loads(content)) for (content,) in contents)


def _read_exports(folder: Path) -> Results:
    return Results(
        tuple(_EPISODES.read_parquet(folder / EPISODES_FILE)),
        tuple(_FAILURES.read_parquet(folder / FAILURES_FILE)),
        Manifest.read(folder / MANIFEST_FILE),
    )


def _write_exports(folder: Path, results: Results) -> None:
    for name, table, rows in (
        (EPISODES_FILE, _EPISODES, results.episodes),
        (FAILURES_FILE, _FAILURES, results.failures),
    ):
        write_whole(folder / name, parquet(table.arrow(rows)))
    results.manifest.write(folder / MANIFEST_FILE)


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    if path.exists():
        open_regular(path).close()  # SQLite would wait at a pipe
    address = f"file:{quote(os.fsencode(path.absolute()))}?mode={mode}"
    database = sqlite3.connect(address, uri=True, timeout=BUSY_TIMEOUT_S, isolation_level=None)
    database.execute("PRAGMA synchronous=FULL")
    return database


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Turn SQLite's errors into one line."""
    try:
        yield
    except sqlite3.OperationalError as error:
        raise DatasetError(
            f"cannot use {path}: {error}; finished work is kept: free space on the disk, or wait for the process "
            "that uses it, and run the same command again"
        ) from None
    except (sqlite3.DatabaseError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{path} is damaged ({error}); move it away to start again") from None
