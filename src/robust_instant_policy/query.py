"""What is asked of a language model and what it answers.

`context` writes queries and reads answers, `llm` asks them; neither imports the other.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Query:
    """One prompt.

    ``text`` is what the model continues; ``grammar`` (GBNF) and ``pattern`` (an equivalent regular expression)
    describe the only well-formed answers, for servers that can enforce either; ``max_tokens`` bounds the answer
    and ``stop`` ends it. ``instruction`` is what a chat model is told first.
    """

    text: str
    max_tokens: int
    grammar: str | None = None
    pattern: str | None = None
    stop: tuple[str, ...] = ()
    instruction: str | None = None


@dataclass(frozen=True)
class Answer:
    """One sampled continuation, with its cost: tokens read, read from a cache, and written; seconds of wall time."""

    text: str
    prompt_tokens: int = 0
    cached_tokens: int = 0
    completion_tokens: int = 0
    seconds: float = 0.0
    replayed: bool = False
