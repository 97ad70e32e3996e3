"""The interface of every language model, and the bookkeeping of answers that all of them share."""

import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from robust_instant_policy.errors import ModelError
from robust_instant_policy.query import Answer, Query

DEADLINE_S = 300.0  # wall time for all the answers of one plan; a busy laptop may need minutes
MAX_ROUNDS = 8  # attempts at one sample before it is given up
QUOTED_CHARS = 160  # of a refused answer, in messages

Accept = Callable[[int, str], Any]  # query index, text -> parsed value; None or False to refuse the answer
OnProgress = Callable[[int, int], None]  # accepted answers, wanted answers
OnAnswer = Callable[[int, int, int, Answer, bool], None]  # query index, sample index, attempt, answer, accepted

NO_FILE = "no model file at {}; give the path of a .gguf file"


@dataclass(frozen=True)
class Sampling:
    """How answers are drawn: ``n`` for each query, numbered from ``first_index``, all within ``deadline_s`` seconds of
    wall time. The same ``seed`` gives the same answers where the server honours seeds."""

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
    """Callbacks for answers as they arrive.

    ``accept`` parses an answer once; its result becomes `Answer.value`. An answer for which it returns None or False
    is refused and sampled again. ``on_answer`` receives every answer, including refused ones.
    """

    accept: Accept | None = None
    on_progress: OnProgress | None = None
    on_answer: OnAnswer | None = None

    def read(self, query_index: int, answer: Answer) -> Answer | None:
        """The answer with its value, or None when it is refused."""
        if answer.fault and not answer.text:
            return None
        if self.accept is None:
            return answer
        value = self.accept(query_index, answer.text)
        return None if value is None or value is False else replace(answer, value=value)


NOBODY = Listener()


class LanguageModel(Protocol):
    """A model that continues text.

    ``name`` identifies its weights in the sample store. ``context_length`` is in tokens, None when the server does not
    tell. `count_tokens` estimates where the server has no tokenizer.
    """

    @property
    def name(self) -> str: ...

    @property
    def context_length(self) -> int | None: ...

    def count_tokens(self, text: str) -> int: ...

    def sample(self, queries: Sequence[Query], sampling: Sampling, listener: Listener = NOBODY) -> list[list[Answer]]:
        """For each query up to ``sampling.n`` independent answers, in the order of their sample index.

        Refused answers are sampled again until the deadline, at most `MAX_ROUNDS` times each. Returns what has arrived
        by then: lists may be short or empty. Raises `ModelError` when the model cannot be used, and, before anything
        is sent, when a prompt does not fit into its context.
        """
        ...

    def close(self) -> None: ...


class Tally:
    """Which samples of which query are still missing. Safe to use from several threads."""

    def __init__(self, num_queries: int, sampling: Sampling, listener: Listener = NOBODY):
        self._indices = sampling.indices
        self._attempts: list[dict[int, int]] = [{} for _ in range(num_queries)]
        self._accepted: list[dict[int, Answer]] = [{} for _ in range(num_queries)]
        self._total = num_queries * sampling.n
        self._listener = listener
        self._lock = threading.Lock()

    def missing(self, query_index: int) -> list[int]:
        """Sample indices without an accepted answer, except those refused `MAX_ROUNDS` times."""
        with self._lock:
            attempts, accepted = self._attempts[query_index], self._accepted[query_index]
            return [i for i in self._indices if i not in accepted and attempts.get(i, 0) < MAX_ROUNDS]

    def attempt(self, query_index: int, index: int) -> int:
        """How often the sample has been refused."""
        with self._lock:
            return self._attempts[query_index].get(index, 0)

    def add(self, query_index: int, index: int, answer: Answer) -> None:
        read = self._listener.read(query_index, answer)
        with self._lock:
            if index in self._accepted[query_index]:
                return
            attempt = self._attempts[query_index].get(index, 0)
            self._attempts[query_index][index] = attempt + 1
            if read is not None:
                self._accepted[query_index][index] = read
            if self._listener.on_answer is not None:
                self._listener.on_answer(query_index, index, attempt, read or answer, read is not None)
            if read is not None and self._listener.on_progress is not None:
                self._listener.on_progress(sum(map(len, self._accepted)), self._total)

    @property
    def is_empty(self) -> bool:
        """No answer has arrived, accepted or refused."""
        with self._lock:
            return not any(self._attempts)

    @property
    def has_accepted(self) -> bool:
        with self._lock:
            return any(self._accepted)

    def answers(self) -> list[list[Answer]]:
        with self._lock:
            return [[answer for _, answer in sorted(accepted.items())] for accepted in self._accepted]


def refusal_advice(refused: Sequence[Answer]) -> str:
    """One line about answers that `Listener.accept` refused: how many, one of them, and what to change.

    Empty when there are none. Collect them with `Listener.on_answer`.
    """
    if not refused:
        return ""
    last = refused[-1]
    fault = f" ({last.fault})" if last.fault else ""
    return (
        f"{len(refused)} answers could not be read as numbers, for example {last.text[:QUOTED_CHARS]!r}{fault}; "
        "use a larger model, a server that enforces a grammar, or the other request style (chat+ or completions+ "
        "before the address)"
    )


def sample_seed(seed: int, sample: int, attempt: int) -> int:
    """The 31-bit seed of one attempt at one sample; other samples and attempts get other seeds."""
    return (seed * 1_000_003 + attempt * 10_007 + sample) % 2**31


def context_error(prompt_tokens: int, answer_tokens: int, context_length: int, exact: bool = True) -> ModelError:
    return ModelError(
        f"the prompt has {'' if exact else 'about '}{prompt_tokens} tokens and the answer needs up to {answer_tokens}, "
        f"more than the model's context of {context_length}; use fewer demonstrations or steps, "
        "or layout='factorised'"
    )


_PIECE = re.compile(r"\d{1,3}|\s?[^\W\d]{1,6}|\s+|[^\w\s]|_")


def estimate_tokens(text: str) -> int:
    """Estimated number of tokens, for a tokenizer with three-digit number tokens; one-digit tokenizers need more."""
    return len(_PIECE.findall(text))
