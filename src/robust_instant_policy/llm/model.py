"""What every language model here can do, however it is reached."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from robust_instant_policy.errors import ModelError
from robust_instant_policy.query import Answer, Query

DEADLINE_S = 120.0  # wall time of one plan, all its answers together
MAX_ROUNDS = 8  # times an answer that does not parse is asked for again before it is given up

Accept = Callable[[int, str], bool]  # query index, text
OnProgress = Callable[[int, int], None]  # accepted answers, wanted answers
OnAnswer = Callable[[int, int, int, Answer, bool], None]  # query index, sample index, attempt, answer, accepted


@dataclass(frozen=True)
class Sampling:
    """How answers are drawn: ``n`` of them to each query, numbered from ``first_index``, so that more can be had later,
    within ``deadline_s`` seconds of wall time for all together."""

    n: int
    temperature: float
    seed: int = 0
    first_index: int = 0
    deadline_s: float = DEADLINE_S

    @property
    def indices(self) -> range:
        return range(self.first_index, self.first_index + self.n)


@dataclass(frozen=True)
class Listener:
    """Who hears of answers as they come. Answers that ``accept`` refuses are asked for again."""

    accept: Accept | None = None
    on_progress: OnProgress | None = None
    on_answer: OnAnswer | None = None


NOBODY = Listener()


class LanguageModel(Protocol):
    """A model that continues text.

    ``name`` identifies its weights in the sample store. ``context_length`` is in tokens, None when the server does
    not say. ``counts_exactly`` tells whether `count_tokens` is the model's own count or an estimate.
    """

    @property
    def name(self) -> str: ...

    @property
    def context_length(self) -> int | None: ...

    @property
    def counts_exactly(self) -> bool: ...

    def count_tokens(self, text: str) -> int: ...

    def sample(self, queries: Sequence[Query], sampling: Sampling, listener: Listener = NOBODY) -> list[list[Answer]]:
        """For each query up to ``sampling.n`` independent answers, in the order of their sample index.

        Refused answers are asked for again until the deadline has passed (or `MAX_ROUNDS` times); what has arrived
        by then is returned, so lists may be short or empty. Raises `ModelError` when the model cannot be reached or
        used at all, and, before anything is sent, when a prompt does not fit into its context.
        """
        ...

    def close(self) -> None: ...


class Tally:
    """Which samples of which query are still missing. Safe to use from several threads."""

    def __init__(self, num_queries: int, sampling: Sampling, listener: Listener = NOBODY):
        self._missing = [list(sampling.indices) for _ in range(num_queries)]
        self._attempts: list[dict[int, int]] = [{} for _ in range(num_queries)]
        self._accepted: list[dict[int, Answer]] = [{} for _ in range(num_queries)]
        self._total = num_queries * sampling.n
        self._listener = listener
        self._lock = threading.Lock()

    def missing(self, query_index: int) -> list[int]:
        """Sample indices that have no accepted answer yet, except those refused `MAX_ROUNDS` times."""
        with self._lock:
            attempts = self._attempts[query_index]
            return [index for index in self._missing[query_index] if attempts.get(index, 0) < MAX_ROUNDS]

    def attempt(self, query_index: int, index: int) -> int:
        """How often the sample has been refused."""
        with self._lock:
            return self._attempts[query_index].get(index, 0)

    def add(self, query_index: int, index: int, answer: Answer) -> None:
        hear = self._listener
        accepted = hear.accept is None or hear.accept(query_index, answer.text)
        with self._lock:
            if index not in self._missing[query_index]:
                return
            attempt = self._attempts[query_index].get(index, 0)
            self._attempts[query_index][index] = attempt + 1
            if accepted:
                self._missing[query_index].remove(index)
                self._accepted[query_index][index] = answer
            if hear.on_answer is not None:
                hear.on_answer(query_index, index, attempt, answer, accepted)
            if accepted and hear.on_progress is not None:
                hear.on_progress(sum(map(len, self._accepted)), self._total)

    @property
    def is_empty(self) -> bool:
        """No answer at all has come, accepted or not."""
        with self._lock:
            return not any(self._attempts)

    def answers(self) -> list[list[Answer]]:
        with self._lock:
            return [[answer for _, answer in sorted(accepted.items())] for accepted in self._accepted]


def context_error(prompt_tokens: int, answer_tokens: int, context_length: int, exact: bool = True) -> ModelError:
    return ModelError(
        f"the prompt has {'' if exact else 'about '}{prompt_tokens} tokens and the answer needs up to {answer_tokens}, "
        f"more than the model's context of {context_length}; use fewer demonstrations or steps, "
        "or layout='factorised'"
    )


_PIECE = re.compile(r"\d{1,3}|\s?[^\W\d]{1,6}|\s+|[^\w\s]|_")


def estimate_tokens(text: str) -> int:
    """About as many tokens as a model with three-digit number tokens would count; models with one-digit tokens more."""
    return len(_PIECE.findall(text))
