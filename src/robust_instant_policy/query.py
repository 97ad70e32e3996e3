"""Queries to a language model and its answers.

`context` writes queries and reads answers, `llm` sends them; neither imports the other.
"""

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Query:
    """One prompt.

    The model continues ``text``. ``grammar`` (GBNF) and ``pattern`` (an equivalent regular expression) describe the
    well-formed answers, for servers that can enforce one of them. ``max_tokens`` bounds the answer and ``stop`` ends
    it. ``instruction`` is the system message for a chat model.
    """

    text: str
    max_tokens: int
    grammar: str | None = None
    pattern: str | None = None
    stop: tuple[str, ...] = ()
    instruction: str | None = None


@dataclass(frozen=True)
class Answer:
    """One sampled continuation and its cost: tokens read, read from a cache, and written; wall time in seconds.

    ``value`` is what `Listener.accept` read from the text, None when nothing read it. ``fault`` says what is wrong with
    the answer itself (cut off, withheld, only thinking), empty when nothing is.
    """

    text: str
    prompt_tokens: int = 0
    cached_tokens: int = 0
    completion_tokens: int = 0
    seconds: float = 0.0
    replayed: bool = False
    value: Any = field(default=None, compare=False)
    fault: str = field(default="", compare=False)
