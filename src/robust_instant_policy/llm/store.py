"""The sample store: every answer of every language model in one SQLite file, to record and to replay."""

from __future__ import annotations

import csv
import hashlib
import json
import sqlite3
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

from robust_instant_policy.errors import ModelError, UsageError
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
# The attempt number of a row without text: the sample was asked for, and no acceptable answer came. A replay then
# misses it, too; a model is asked again.
_NOTHING_CAME = 1_000_000


@dataclass(frozen=True)
class StoredCount:
    """What a store holds of one model."""

    model: str
    queries: int
    answers: int
    prompt_tokens: int
    completion_tokens: int


class SampleStore:
    """The SQLite file at ``path``, made when missing.

    Each answer is written as it arrives, in a transaction of its own: a killed process loses at most the answers under
    way, and several processes may share a file.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
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
        """What the store holds of each model."""
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
        """Keep one answer, or with None that no acceptable one came.

        What is there stays: another answer under the same number gets the next free one.
        """
        digest = _digest(query)
        cost = (0, 0, 0, 0.0)
        if answer is not None:
            cost = (answer.prompt_tokens, answer.cached_tokens, answer.completion_tokens, answer.seconds)
        text = None if answer is None else answer.text
        key = (model, digest, settings, sample)
        where = "WHERE model = ? AND query = ? AND settings = ? AND sample = ?"
        with self._lock:
            self._db.execute("BEGIN IMMEDIATE")
            try:
                self._db.execute(
                    "INSERT OR IGNORE INTO queries VALUES (?, ?, ?, ?, ?, ?, ?)",
                    (
                        digest,
                        query.text,
                        query.instruction,
                        query.grammar,
                        query.pattern,
                        json.dumps(query.stop),
                        query.max_tokens,
                    ),
                )
                taken = self._db.execute(
                    f"SELECT text FROM answers {where} AND attempt = ?", (*key, attempt)
                ).fetchone()
                if taken is not None and taken != (text,):
                    last = f"SELECT MAX(attempt) + 1 FROM answers {where} AND text IS NOT NULL"
                    attempt = self._db.execute(last, key).fetchone()[0]
                self._db.execute(
                    "INSERT OR IGNORE INTO answers VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", (*key, attempt, text, *cost)
                )
            except BaseException:
                self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")

    def take(self, other: str | Path) -> int:
        """Copy what only the store at ``other`` holds, all of it or nothing; returns the number of answers copied.

        Raises `UsageError` where ``other`` is not a store.
        """
        if not Path(other).is_file():
            raise UsageError(f"no sample store at {other}")
        with self._lock:
            before = self._count()
            try:
                self._db.execute("ATTACH ? AS other", (str(other),))
                try:
                    self._db.execute("BEGIN IMMEDIATE")
                    for table in ("queries", "answers", "failures"):
                        self._db.execute(f"INSERT OR IGNORE INTO {table} SELECT * FROM other.{table}")
                    self._db.execute("COMMIT")
                finally:
                    if self._db.in_transaction:
                        self._db.execute("ROLLBACK")
                    self._db.execute("DETACH other")
            except sqlite3.DatabaseError as error:
                raise UsageError(f"the samples of {other} cannot be copied to {self.path} ({error})") from None
            return self._count() - before

    def _count(self) -> int:
        count: int = self._db.execute("SELECT COUNT(text) FROM answers").fetchone()[0]
        return count

    def read(self, model: str, query: Query, settings: str, sample: int) -> list[Answer | None]:
        """All attempts at one sample, in order, and None last when no acceptable one came. Empty: never asked."""
        rows = self._select(
            "SELECT text, prompt_tokens, cached_tokens, completion_tokens, seconds FROM answers "
            "WHERE model = ? AND query = ? AND settings = ? AND sample = ? ORDER BY attempt",
            (model, _digest(query), settings, sample),
        )
        return [None if row[0] is None else replace(Answer(*row), replayed=True) for row in rows]

    def write_failure(self, model: str, queries: Sequence[Query], sampling: Sampling, message: str) -> None:
        """Keep the message with which a model failed; a replay fails with the same."""
        row = (model, _request_digest(queries, sampling), message)
        with self._lock:
            self._db.execute("INSERT OR REPLACE INTO failures VALUES (?, ?, ?)", row)

    def read_failure(self, model: str, queries: Sequence[Query], sampling: Sampling) -> str | None:
        """The message of the last failure when these queries were asked together, None without one."""
        rows = self._select(
            "SELECT message FROM failures WHERE model = ? AND request = ?", (model, _request_digest(queries, sampling))
        )
        return rows[0][0] if rows else None

    def _select(self, sql: str, values: Sequence[object] = ()) -> list[tuple]:
        with self._lock:
            return self._db.execute(sql, values).fetchall()


class RecordedModel:
    """A language model whose answers are kept in a store and are not asked for twice."""

    def __init__(self, model: LanguageModel, store: SampleStore):
        self._model, self._store = model, store
        self.name = model.name

    @property
    def context_length(self) -> int | None:
        return self._model.context_length

    @property
    def counts_exactly(self) -> bool:
        return self._model.counts_exactly

    def count_tokens(self, text: str) -> int:
        return self._model.count_tokens(text)

    def sample(self, queries: Sequence[Query], sampling: Sampling, listener: Listener = NOBODY) -> list[list[Answer]]:
        """See `LanguageModel.sample`; asks the model only for queries of which the store lacks a sample.

        A sample that was missing at an earlier deadline is asked for again, one refused `MAX_ROUNDS` times is not.
        """
        stored = [_look_up(self._store, self.name, query, sampling) for query in queries]
        found = [_accepted(index, attempts, listener) for index, attempts in enumerate(stored)]
        unasked = [
            index
            for index, attempts in enumerate(stored)
            if any(
                own is None and sum(answer is not None for answer in tries) < MAX_ROUNDS
                for own, tries in zip(found[index], attempts, strict=True)
            )
        ]
        for index in set(range(len(queries))) - set(unasked):
            _tell(index, sampling, stored[index], found[index], listener)
        if unasked:
            self._ask(queries, unasked, sampling, listener, found)
        return [[answer for answer in own if answer is not None] for own in found]

    def _ask(
        self,
        queries: Sequence[Query],
        unasked: Sequence[int],
        sampling: Sampling,
        listener: Listener,
        found: list[list[Answer | None]],
    ) -> None:
        """Ask for the queries ``unasked``, and add to ``found`` what comes for samples that are missing there."""
        asked = [queries[index] for index in unasked]
        accept, settings = listener.accept, _settings(sampling)

        def keep(position: int, sample: int, attempt: int, answer: Answer, accepted: bool) -> None:
            if answer.text or not answer.fault:  # a withheld answer says nothing about the model
                self._store.write(self.name, asked[position], settings, sample, attempt, answer)
            own, place = found[unasked[position]], sample - sampling.first_index
            if accepted and own[place] is None:
                own[place] = answer
            if listener.on_answer is not None:
                listener.on_answer(unasked[position], sample, attempt, answer, accepted)

        to_model = Listener(
            None if accept is None else lambda position, text: accept(unasked[position], text),
            listener.on_progress,
            keep,
        )
        try:
            self._model.sample(asked, sampling, to_model)
        except ModelError as error:
            self._store.write_failure(self.name, queries, sampling, str(error))
            raise
        for index in unasked:
            for sample, own in zip(sampling.indices, found[index], strict=True):
                if own is None:
                    self._store.write(self.name, queries[index], settings, sample, _NOTHING_CAME, None)

    def close(self) -> None:
        self._model.close()


class ReplayedModel:
    """The answers that a store holds of the model ``name``, without the model.

    A model file's name without its digest will do, where only one file of that name was asked.
    """

    counts_exactly = False

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
        """See `LanguageModel.sample`; raises what the model raised then, and `ModelError` for a sample that was never
        recorded."""
        stored = [_look_up(self._store, self.name, query, sampling) for query in queries]
        found = [_accepted(index, attempts, listener) for index, attempts in enumerate(stored)]
        unknown = sum(
            any(
                own is None and None not in tries and len(tries) < MAX_ROUNDS
                for own, tries in zip(found[index], attempts, strict=True)
            )
            for index, attempts in enumerate(stored)
        )
        if unknown:
            failure = self._store.read_failure(self.name, queries, sampling)
            raise ModelError(
                failure
                or f"{self._store.path} lacks the answers to {unknown} of {len(queries)} prompts of this plan; "
                "run once without --replay to record them"
            )
        for index, (attempts, own) in enumerate(zip(stored, found, strict=True)):
            _tell(index, sampling, attempts, own, listener)
        answers = [[answer for answer in own if answer is not None] for own in found]
        if listener.on_progress is not None:
            listener.on_progress(sum(map(len, answers)), len(queries) * sampling.n)
        return answers

    def close(self) -> None:
        pass


def _look_up(store: SampleStore, model: str, query: Query, sampling: Sampling) -> list[list[Answer | None]]:
    """All attempts at each sample of a query."""
    settings = _settings(sampling)
    return [store.read(model, query, settings, sample) for sample in sampling.indices]


def _accepted(index: int, attempts: list[list[Answer | None]], listener: Listener) -> list[Answer | None]:
    """The first attempt at each sample that the listener accepts, with its value; None without one."""
    read = ((listener.read(index, answer) for answer in tries if answer is not None) for tries in attempts)
    return [next((answer for answer in tries if answer is not None), None) for tries in read]


def _tell(
    index: int,
    sampling: Sampling,
    attempts: list[list[Answer | None]],
    found: list[Answer | None],
    listener: Listener,
) -> None:
    """Report stored answers as if they had just come."""
    if listener.on_answer is None:
        return
    for sample, tries, own in zip(sampling.indices, attempts, found, strict=True):
        for attempt, answer in enumerate(tries):
            if answer is not None:
                is_own = own is not None and answer.text == own.text
                listener.on_answer(index, sample, attempt, own if is_own and own else answer, is_own)


def _settings(sampling: Sampling) -> str:
    """The settings that decide an answer; the deadline is none of them."""
    return json.dumps({"seed": sampling.seed, "temperature": sampling.temperature}, sort_keys=True)


def _request_digest(queries: Sequence[Query], sampling: Sampling) -> str:
    fields = [*map(_digest, queries), _settings(sampling), str(sampling.first_index), str(sampling.n)]
    return hashlib.sha256(json.dumps(fields).encode()).hexdigest()


def _digest(query: Query) -> str:
    fields = (query.text, query.instruction, query.grammar, query.pattern, query.stop, query.max_tokens)
    return hashlib.sha256(json.dumps(fields).encode()).hexdigest()
