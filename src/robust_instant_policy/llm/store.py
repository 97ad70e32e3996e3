"""Every answer of a language model, kept by content in one SQLite file, to record and to replay."""

from __future__ import annotations

import csv
import hashlib
import json
import sqlite3
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

from robust_instant_policy.errors import ModelError, UsageError
from robust_instant_policy.llm.model import NOBODY, Accept, LanguageModel, Listener, Sampling, estimate_tokens
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
# A row without text says that the sample was asked for and no (acceptable) answer came in time.
_NOTHING_CAME = 1_000_000  # the attempt number of such a row


@dataclass(frozen=True)
class StoredCount:
    """What a store holds of one model."""

    model: str
    queries: int
    answers: int
    prompt_tokens: int
    completion_tokens: int


class SampleStore:
    """The SQLite file at ``path`` (made when missing).

    Each answer is written as it arrives, in a transaction of its own: a kill at any moment loses at most the
    answers still under way, and several processes may share a file.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        try:
            self._db = sqlite3.connect(self.path, timeout=BUSY_TIMEOUT_S, check_same_thread=False, isolation_level=None)
            tables = {name for (name,) in self._db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            if tables and not tables & {"queries", "answers", "failures"}:
                raise UsageError(f"{self.path} is a database of something else; give another file")
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=NORMAL")
            self._db.executescript(_TABLES)
        except sqlite3.DatabaseError as error:
            raise UsageError(f"{self.path} is not a sample store ({error}); give another file") from None
        self._lock = threading.Lock()

    def close(self) -> None:
        self._db.close()

    def models(self) -> list[StoredCount]:
        """What the store holds, by model."""
        rows = self._select(
            "SELECT model, COUNT(DISTINCT query), COUNT(text), SUM(prompt_tokens), SUM(completion_tokens) "
            "FROM answers GROUP BY model ORDER BY model"
        )
        return [StoredCount(*row) for row in rows]

    def names(self) -> list[str]:
        """The models that were asked, whether they answered or not."""
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
        """Keep one answer, or with None that no acceptable one came; what is already there stays."""
        digest = _digest(query)
        cost = (0, 0, 0, 0.0)
        if answer is not None:
            cost = (answer.prompt_tokens, answer.cached_tokens, answer.completion_tokens, answer.seconds)
        row = (model, digest, settings, sample, attempt, None if answer is None else answer.text, *cost)
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
                self._db.execute("INSERT OR IGNORE INTO answers VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", row)
            except BaseException:
                self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")

    def take(self, other: str | Path) -> int:
        """Copy what the store at ``other`` holds and this one does not; returns how many answers that were.

        All or nothing of it is copied. Raises `UsageError` where ``other`` is not a store.
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
        """All attempts at one sample, in order; None stands for "nothing acceptable came". Empty: never asked."""
        rows = self._select(
            "SELECT text, prompt_tokens, cached_tokens, completion_tokens, seconds FROM answers "
            "WHERE model = ? AND query = ? AND settings = ? AND sample = ? ORDER BY attempt",
            (model, _digest(query), settings, sample),
        )
        return [None if row[0] is None else replace(Answer(*row), replayed=True) for row in rows]

    def write_failure(self, model: str, queries: Sequence[Query], sampling: Sampling, message: str) -> None:
        """Keep the words with which a model failed; a replay fails with the same."""
        row = (model, _request_digest(queries, sampling), message)
        with self._lock:
            self._db.execute("INSERT OR REPLACE INTO failures VALUES (?, ?, ?)", row)

    def read_failure(self, model: str, queries: Sequence[Query], sampling: Sampling) -> str | None:
        """How the model failed the last time these queries were asked together, if it did."""
        rows = self._select(
            "SELECT message FROM failures WHERE model = ? AND request = ?", (model, _request_digest(queries, sampling))
        )
        return rows[0][0] if rows else None

    def _select(self, sql: str, values: Sequence[object] = ()) -> list[tuple]:
        with self._lock:
            return self._db.execute(sql, values).fetchall()


class RecordedModel:
    """A language model whose answers are kept in a store, and which is not asked twice for the same sample."""

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
        """See `LanguageModel.sample`; asks the model only for queries of which a sample is missing."""
        found, unasked = _look_up(self._store, self.name, queries, sampling, listener)
        if not unasked:
            return found
        asked = [queries[index] for index in unasked]
        accept, settings = listener.accept, _settings(sampling)

        def keep(position: int, sample: int, attempt: int, answer: Answer, accepted: bool) -> None:
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
        for position, answers in enumerate(fresh):
            if len(answers) < sampling.n:
                for sample in sampling.indices:
                    self._store.write(self.name, asked[position], settings, sample, _NOTHING_CAME, None)
        # What the store holds now, not what came: a sample that was there already stays what it was.
        kept, _ = _look_up(self._store, self.name, queries, sampling, Listener(accept))
        for index in unasked:
            found[index] = [replace(answer, replayed=False) for answer in kept[index]]
        return found

    def close(self) -> None:
        self._model.close()


class ReplayedModel:
    """The answers that a store holds of the model ``name``, without the model.

    Of a model file the name without its fingerprint will do, where only one of that name was asked.
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
        found, unasked = _look_up(self._store, self.name, queries, sampling, listener)
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
    store: SampleStore, model: str, queries: Sequence[Query], sampling: Sampling, listener: Listener
) -> tuple[list[list[Answer]], list[int]]:
    """Stored answers to each query, and the indices of queries of which a sample has to be asked for."""
    found: list[list[Answer]] = [[] for _ in queries]
    unasked = []
    settings = _settings(sampling)
    for index, query in enumerate(queries):
        attempts = [store.read(model, query, settings, sample) for sample in sampling.indices]
        chosen = [next(_accepted(index, tries, listener.accept), None) for tries in attempts]
        if any(answer is None and None not in tries for answer, tries in zip(chosen, attempts, strict=True)):
            unasked.append(index)
            continue
        found[index] = [answer for answer in chosen if answer is not None]
        if listener.on_answer is not None:
            for sample, own, tries in zip(sampling.indices, chosen, attempts, strict=True):
                for attempt, answer in enumerate(tries):
                    if answer is not None:
                        listener.on_answer(index, sample, attempt, answer, answer is own)
    return found, unasked


def _accepted(index: int, tries: list[Answer | None], accept: Accept | None) -> Iterator[Answer]:
    for answer in tries:
        if answer is not None and (accept is None or accept(index, answer.text)):
            yield answer


def _settings(sampling: Sampling) -> str:
    """What decides an answer besides its query and number; a deadline does not."""
    return json.dumps({"seed": sampling.seed, "temperature": sampling.temperature}, sort_keys=True)


def _request_digest(queries: Sequence[Query], sampling: Sampling) -> str:
    fields = [*map(_digest, queries), _settings(sampling), str(sampling.first_index), str(sampling.n)]
    return hashlib.sha256(json.dumps(fields).encode()).hexdigest()


def _digest(query: Query) -> str:
    fields = (query.text, query.instruction, query.grammar, query.pattern, query.stop, query.max_tokens)
    return hashlib.sha256(json.dumps(fields).encode()).hexdigest()
