"""The sample store: all answers of all language models in one SQLite file, to record and to replay."""

import csv
import functools
import hashlib
import json
import sqlite3
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

from robust_instant_policy.errors import DatasetError, ModelError, UsageError
from robust_instant_policy.files import open_regular
from robust_instant_policy.llm.model import MAX_ROUNDS, NOBODY, LanguageModel, Listener, Sampling, estimate_tokens
from robust_instant_policy.query import Answer, Query

BUSY_TIMEOUT_S = 60.0  # how long a write waits for another process

_TABLES = """
CREATE TABLE IF NOT EXISTS queries (
  digest TEXT PRIMARY KEY, text TEXT NOT NULL, instruction TEXT, grammar TEXT, pattern TEXT, stop TEXT NOT NULL,
  max_tokens INTEGER NOT NULL
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS answers (
  model TEXT NOT NULL, query TEXT NOT NULL REFERENCES queries(digest), settings TEXT NOT NULL,
  sample INTEGER NOT NULL, attempt INTEGER NOT NULL,
  text TEXT, prompt_tokens INTEGER NOT NULL DEFAULT 0, cached_tokens INTEGER NOT NULL DEFAULT 0,
  completion_tokens INTEGER NOT NULL DEFAULT 0, seconds REAL NOT NULL DEFAULT 0,
  PRIMARY KEY (model, query, settings, sample, attempt)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS failures (
  model TEXT NOT NULL, request TEXT NOT NULL, message TEXT NOT NULL, PRIMARY KEY (model, request)
) WITHOUT ROWID;
"""
# Attempt number of a row without text: the sample was requested, but no acceptable answer came in time. It is missing
# in a replay, too; a model is asked again.
_NO_ANSWER = 1_000_000


@dataclass(frozen=True)
class StoredCount:
    """Numbers of queries, answers and tokens of one model in a store."""

    model: str
    queries: int
    answers: int
    prompt_tokens: int
    completion_tokens: int


class SampleStore:
    """The SQLite file at ``path``, created if missing.

    Each answer is written when it arrives, in its own transaction: a killed process loses only answers that have not
    arrived, and several processes may share a file.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.path.exists():
            open_regular(self.path).close()  # SQLite would write a journal beside a device, and wait at a pipe
        try:
            self._db = sqlite3.connect(self.path, timeout=BUSY_TIMEOUT_S, check_same_thread=False, isolation_level=None)
            tables = {name for (name,) in self._db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            if tables and not tables & {"queries", "answers", "failures"}:
                raise UsageError(f"{self.path} is the database of another program; give another file")
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=NORMAL")
            self._db.executescript(_TABLES)
        except sqlite3.DatabaseError as error:
            raise UsageError(f"{self.path} is not a sample store ({error}); give another file") from None
        self._lock = threading.Lock()

    def close(self) -> None:
        self._db.close()

    def models(self) -> list[StoredCount]:
        """The numbers for each model."""
        rows = self._select(
            "SELECT model, COUNT(DISTINCT query), COUNT(text), SUM(prompt_tokens), SUM(completion_tokens) "
            "FROM answers GROUP BY model ORDER BY model"
        )
        return [StoredCount(*row) for row in rows]

    def names(self) -> list[str]:
        """The models that were asked, also those that never answered."""
        return [name for (name,) in self._select("SELECT model FROM answers UNION SELECT model FROM failures")]

    def export(self, file: IO[str], form: str = "jsonl") -> int:
        """Write all answers with their prompts as JSON lines or CSV; returns how many."""
        names = (
            "model", "settings", "sample", "attempt", "prompt", "instruction", "answer",
            "prompt_tokens", "cached_tokens", "completion_tokens", "seconds",
        )  # fmt: skip
        rows = self._select(
            "SELECT a.model, a.settings, a.sample, a.attempt, q.text, q.instruction, a.text, "
            "a.prompt_tokens, a.cached_tokens, a.completion_tokens, a.seconds "
            "FROM answers a JOIN queries q ON q.digest = a.query WHERE a.text IS NOT NULL "
            "ORDER BY a.model, a.query, a.settings, a.sample, a.attempt"
        )
        if form == "jsonl":
            for row in rows:
                file.write(json.dumps(dict(zip(names, row, strict=True)), ensure_ascii=False) + "\n")
        elif form == "csv":
            writer = csv.writer(file)
            writer.writerow(names)
            writer.writerows(rows)
        else:
            raise UsageError(f"samples can be exported as jsonl or csv, not as {form!r}")
        return len(rows)

    def write(self, model: str, query: Query, settings: str, sample: int, attempt: int, answer: Answer | None) -> None:
        """Store one answer, or None if no acceptable one came.

        Stored answers stay: a different answer with the same attempt number gets the next free number.
        """
        digest = _digest(query)
        cost = (0, 0, 0, 0.0)
        if answer is not None:
            cost = (answer.prompt_tokens, answer.cached_tokens, answer.completion_tokens, answer.seconds)
        text = None if answer is None else answer.text
        key = (model, digest, settings, sample)
        where = "WHERE model = ? AND query = ? AND settings = ? AND sample = ?"
        asked = (query.text, query.instruction, query.grammar, query.pattern, json.dumps(query.stop), query.max_tokens)
        with self._locked(), self._db:  # commits, or takes back
            self._db.execute("BEGIN IMMEDIATE")
            self._db.execute("INSERT OR IGNORE INTO queries VALUES (?, ?, ?, ?, ?, ?, ?)", (digest, *asked))
            taken = self._db.execute(f"SELECT text FROM answers {where} AND attempt = ?", (*key, attempt)).fetchone()
            if taken is not None and taken != (text,):
                last = f"SELECT MAX(attempt) + 1 FROM answers {where} AND text IS NOT NULL"
                attempt = self._db.execute(last, key).fetchone()[0]
            self._db.execute(
                "INSERT OR IGNORE INTO answers VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", (*key, attempt, text, *cost)
            )

    def take(self, other: str | Path) -> None:
        """Copy what is only in the store at ``other``, all or nothing. Raises `UsageError` if it is not a store."""
        if not Path(other).is_file():
            raise UsageError(f"no sample store at {other}")
        with self._lock:
            try:
                self._db.execute("ATTACH ? AS other", (str(other),))
                try:
                    with self._db:
                        self._db.execute("BEGIN IMMEDIATE")
                        for table in ("queries", "answers", "failures"):
                            self._db.execute(f"INSERT OR IGNORE INTO {table} SELECT * FROM other.{table}")
                finally:
                    self._db.execute("DETACH other")
            except sqlite3.DatabaseError as error:
                raise UsageError(f"the samples of {other} cannot be copied to {self.path} ({error})") from None

    def read(self, model: str, query: Query, settings: str, sample: int) -> list[Answer | None]:
        """All attempts at one sample, in order, and None last if no acceptable one came. Empty: never requested."""
        rows = self._select(
            "SELECT text, prompt_tokens, cached_tokens, completion_tokens, seconds FROM answers "
            "WHERE model = ? AND query = ? AND settings = ? AND sample = ? ORDER BY attempt",
            (model, _digest(query), settings, sample),
        )
        return [None if row[0] is None else replace(Answer(*row), replayed=True) for row in rows]

    def write_failure(self, model: str, queries: Sequence[Query], sampling: Sampling, message: str) -> None:
        """Store the message with which a model failed; a replay fails with the same message."""
        row = (model, _request_digest(queries, sampling), message)
        with self._locked():
            self._db.execute("INSERT OR REPLACE INTO failures VALUES (?, ?, ?)", row)

    def read_failure(self, model: str, queries: Sequence[Query], sampling: Sampling) -> str | None:
        """The message of the last failure of this request, None if there was none."""
        rows = self._select(
            "SELECT message FROM failures WHERE model = ? AND request = ?", (model, _request_digest(queries, sampling))
        )
        return rows[0][0] if rows else None

    def _select(self, sql: str, values: Sequence[object] = ()) -> list[tuple]:
        with self._locked():
            return self._db.execute(sql, values).fetchall()

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Lock the database, and convert its errors to one line."""
        try:
            with self._lock:
                yield
        except sqlite3.DatabaseError as error:
            raise DatasetError(
                f"cannot use {self.path}: {error}; what it holds is kept: free space on the disk, or give another file"
            ) from None


class RecordedModel:
    """A language model whose answers are stored and not requested twice."""

    def __init__(self, model: LanguageModel, store: SampleStore):
        self._model, self._store = model, store
        self.name = model.name

    @property
    def context_length(self) -> int | None:
        return self._model.context_length

    def count_tokens(self, text: str) -> int:
        return self._model.count_tokens(text)

    def sample(self, queries: Sequence[Query], sampling: Sampling, listener: Listener = NOBODY) -> list[list[Answer]]:
        """See `LanguageModel.sample`; asks the model only for queries with a missing sample.

        A sample that missed an earlier deadline is requested again, one that was refused `MAX_ROUNDS` times is not.
        """
        accept = None if listener.accept is None else functools.cache(listener.accept)  # parses each answer once
        found, unasked = _look_up(self._store, self.name, queries, sampling, replace(listener, accept=accept))
        if not unasked:
            return found
        asked, settings = [queries[index] for index in unasked], _settings(sampling)

        def keep(position: int, sample: int, attempt: int, answer: Answer, accepted: bool) -> None:
            if answer.text or not answer.fault:  # a withheld answer is not replayed
                self._store.write(self.name, asked[position], settings, sample, attempt, answer)
            if listener.on_answer is not None:
                listener.on_answer(unasked[position], sample, attempt, answer, accepted)

        to_model = Listener(
            None if accept is None else lambda position, text: accept(unasked[position], text),
            listener.on_progress,
            keep,
        )
        try:
            fresh = self._model.sample(asked, sampling, to_model)
        except ModelError as error:
            self._store.write_failure(self.name, queries, sampling, str(error))
            raise
        for query, answers in zip(asked, fresh, strict=True):
            if len(answers) < sampling.n:
                for sample in sampling.indices:
                    self._store.write(self.name, query, settings, sample, _NO_ANSWER, None)
        # From the store, because a sample that was stored before stays as it was.
        kept, _ = _look_up(self._store, self.name, queries, sampling, Listener(accept))
        for index in unasked:
            found[index] = [replace(answer, replayed=False) for answer in kept[index]]
        return found

    def close(self) -> None:
        self._model.close()


class ReplayedModel:
    """The stored answers of the model ``name``, without the model.

    The digest in the name of a model file can be omitted if only one file of that name was asked.
    """

    def __init__(self, store: SampleStore, name: str):
        known = store.names()
        files = [model for model in known if model.startswith(f"{name}@")]
        if name not in known and len(files) == 1:
            name = files[0]
        if name not in known:
            raise ModelError(f"{store.path} holds no answers of {name!r}; it has: {', '.join(known) or 'nothing'}")
        self._store, self.name = store, name
        self.context_length: int | None = None

    def count_tokens(self, text: str) -> int:
        return estimate_tokens(text)

    def sample(self, queries: Sequence[Query], sampling: Sampling, listener: Listener = NOBODY) -> list[list[Answer]]:
        """See `LanguageModel.sample`; raises the model's error again, and `ModelError` if a sample was not recorded."""
        found, unasked = _look_up(self._store, self.name, queries, sampling, listener, is_replay=True)
        if unasked:
            failure = self._store.read_failure(self.name, queries, sampling)
            raise ModelError(
                failure
                or f"{self._store.path} lacks the answers to {len(unasked)} of {len(queries)} prompts of this plan; "
                "run once without --replay to record them"
            )
        if listener.on_progress is not None:
            listener.on_progress(sum(map(len, found)), len(queries) * sampling.n)
        return found

    def close(self) -> None:
        pass


def _look_up(
    store: SampleStore,
    model: str,
    queries: Sequence[Query],
    sampling: Sampling,
    listener: Listener,
    is_replay: bool = False,
) -> tuple[list[list[Answer]], list[int]]:
    """The stored, accepted answers to each query, and the indices of the queries for which a sample is missing.

    A sample for which no acceptable answer came is not missing in a replay, nor after `MAX_ROUNDS` refusals.
    """
    found: list[list[Answer]] = []
    unasked = []
    for index, query in enumerate(queries):
        accepted, attempts, is_missing = [], [], False
        for sample in sampling.indices:
            stored = store.read(model, query, _settings(sampling), sample)
            answers = [answer for answer in stored if answer is not None]
            own = next(filter(None, (listener.read(index, answer) for answer in answers)), None)
            if own is not None:
                accepted.append(own)
            elif len(answers) < MAX_ROUNDS and not (is_replay and None in stored):
                is_missing = True
            attempts.append((sample, answers, own))
        found.append(accepted)
        if is_missing:
            unasked.append(index)
        elif listener.on_answer is not None:
            for sample, answers, own in attempts:
                for attempt, answer in enumerate(answers):
                    if own is not None and answer == own:
                        listener.on_answer(index, sample, attempt, own, True)
                    else:
                        listener.on_answer(index, sample, attempt, answer, False)
    return found, unasked


def _settings(sampling: Sampling) -> str:
    """The settings that decide an answer; the deadline does not."""
    return json.dumps({"seed": sampling.seed, "temperature": sampling.temperature}, sort_keys=True)


def _request_digest(queries: Sequence[Query], sampling: Sampling) -> str:
    fields = [*map(_digest, queries), _settings(sampling), str(sampling.first_index), str(sampling.n)]
    return hashlib.sha256(json.dumps(fields).encode()).hexdigest()


def _digest(query: Query) -> str:
    fields = (query.text, query.instruction, query.grammar, query.pattern, query.stop, query.max_tokens)
    return hashlib.sha256(json.dumps(fields).encode()).hexdigest()
