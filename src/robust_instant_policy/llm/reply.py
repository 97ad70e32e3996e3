"""Reading what a server sends: JSON, error messages and answers. Nothing in a reply is trusted to have its type."""

import json
import os
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from robust_instant_policy.llm.model import QUOTED_CHARS, estimate_tokens
from robust_instant_policy.query import Answer

KEY_VARIABLES = ("OPENAI_API_KEY", "RIP_API_KEY")
CUT_OFF = "cut off by the token limit"  # a fault of an answer
MAX_ANSWER_CHARS = 1 << 18  # a hundred times the longest answer; the rest is not read
MAX_MESSAGE_CHARS = 10_000  # of an error, likewise
MAX_COUNT = 10**9  # tokens; a larger number is ignored

_ESCAPE = re.compile(r"\x1b(?:\[[0-?]*[ -/]*[@-~]|\][^\x07\x1b]*(?:\x07|\x1b\\)?|[@-Z\\^_])")  # ANSI: CSI, OSC, others
# How reasoning models mark their thinking: DeepSeek and Qwen, Magistral, and gpt-oss (harmony).
_THINKING = re.compile(r"<think(?:ing)?>|\[THINK\]|<\|channel\|>analysis<\|message\|>")
_THOUGHT = re.compile(r"</think(?:ing)?>|\[/THINK\]|<\|channel\|>final<\|message\|>")


class UnreadableReplyError(Exception):
    """The reply is not one of the protocol; the message says why."""


@dataclass(frozen=True)
class Complaint:
    """A server's error: its message, and the request field it names where it names one."""

    message: str
    field: str = ""

    def names(self, field: str) -> bool:
        # "n" is also a letter of prose: it counts only in quotes or before "must".
        word = rf"['\"`]{field}['\"`]|\b{field}\b must" if len(field) == 1 else rf"\b{field}\b"
        return field == self.field or re.search(word, self.message, re.IGNORECASE) is not None


@dataclass(frozen=True)
class Reply:
    """Answers to one request. ``ran_out``: all were cut off by the token limit; ``thought``: all in their reasoning."""

    answers: tuple[Answer, ...]
    ran_out: bool = False
    thought: bool = False


def read_json(content: bytes) -> Any:
    """Raises `UnreadableReplyError` for text that is not JSON or nested too deeply."""
    try:
        return json.loads(content)
    except RecursionError:
        raise UnreadableReplyError("its JSON is nested too deeply") from None
    except ValueError:
        raise UnreadableReplyError(
            f"it is not JSON: {one_line(content[:400].decode(errors='replace'), 80)!r}"
        ) from None


def read_complaint(content: bytes) -> Complaint:
    """The error message in the body of a refused request, in any of the forms that servers use."""
    try:
        value = json.loads(content)
        message = _message(value)
    except (ValueError, RecursionError):
        value, message = None, ""
    if not message:
        message = re.sub(r"<[^>]*>", " ", content[:2000].decode(errors="replace"))
    error = value.get("error") if isinstance(value, dict) else None
    field = error.get("param") if isinstance(error, dict) else None
    return Complaint(one_line(message), field if isinstance(field, str) else "")


def _message(value: object) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, list):
        return "; ".join(filter(None, map(_message, value[:3])))
    if isinstance(value, dict):
        found = next(filter(None, (_message(value.get(key)) for key in ("error", "message", "detail", "msg"))), "")
        place = value.get("loc")  # FastAPI: ["body", "seed"]
        return f"{'.'.join(map(str, place))}: {found}" if found and isinstance(place, list) else found
    return ""


def read_reply(reply: object, count: int, seconds: float, counts_all: bool = True) -> Reply:
    """The answers in a chat or text completion, ``count`` at most. Raises `UnreadableReplyError`.

    ``counts_all``: the server's count of written tokens is the sum over all answers.
    """
    choices = reply.get("choices") if isinstance(reply, dict) else None
    if not isinstance(choices, list) or not choices:
        raise UnreadableReplyError("it holds no answer")
    assert isinstance(reply, dict)
    read = [_read_choice(choice) for choice in choices[:count]]
    usage = as_map(reply.get("usage"))
    estimates = [estimate_tokens(text) for text, _, _, _ in read]
    total = token_count(usage.get("completion_tokens"))
    written = estimates if total is None or not counts_all else _shared_out(total, estimates)
    costs = (
        token_count(usage.get("prompt_tokens")) or 0,
        token_count(as_map(usage.get("prompt_tokens_details")).get("cached_tokens")) or 0,
    )
    answers = tuple(
        Answer(text, *(costs if index == 0 else (0, 0)), tokens, seconds, fault=fault)
        for index, ((text, fault, _, _), tokens) in enumerate(zip(read, written, strict=True))
    )
    return Reply(answers, all(cut for _, _, cut, _ in read), all(thought for _, _, _, thought in read))


def _read_choice(choice: object) -> tuple[str, str, bool, bool]:
    """Text, fault, whether the token limit cut it off, and whether it ended within the reasoning."""
    choice = as_map(choice)
    message = as_map(choice.get("message"))
    if "message" not in choice and not isinstance(choice.get("text"), str):
        raise UnreadableReplyError("its choice holds neither message nor text")
    content = _text(message.get("content")) if "message" in choice else choice["text"]
    text = clean(content[:MAX_ANSWER_CHARS])
    thinking = _text(message.get("reasoning_content")) or _text(message.get("reasoning"))
    finish = choice.get("finish_reason")
    if finish == "content_filter":
        return "", "withheld by the server's content filter", False, False
    cut = finish == "length"
    *before, text = _THOUGHT.split(text)
    if not before and (begin := _THINKING.search(text)):
        thinking, text = text[begin.end() :], ""
    if not text.strip():
        if cut and thinking:
            return "", f"cut off while still thinking: {one_line(thinking, QUOTED_CHARS)!r}", True, True
        if cut:
            return "", CUT_OFF, True, False
        refusal = _text(message.get("refusal"))
        return "", f"refused by the model: {one_line(refusal, QUOTED_CHARS)!r}" if refusal else "", False, False
    return (whole_numbers(text), CUT_OFF, True, False) if cut else (text, "", False, False)


def whole_numbers(text: str) -> str:
    """A cut-off answer without its last number or word, which may be incomplete."""
    stop = len(text)
    while stop and (text[stop - 1].isalnum() or text[stop - 1] in "_.+-"):
        stop -= 1
    return text[:stop]


def _text(content: object) -> str:
    """A message's content: a string, null, or a list of parts."""
    if isinstance(content, list):
        return "".join(as_text(as_map(part).get("text")) for part in content)
    return as_text(content)


def as_text(value: object) -> str:
    return value if isinstance(value, str) else ""


def as_map(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def token_count(value: object) -> int | None:
    """``value`` if it is a number of tokens, else None."""
    return value if isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= MAX_COUNT else None


def _shared_out(total: int, weights: Sequence[int]) -> list[int]:
    """``total`` split in proportion to ``weights``; the parts add up to it."""
    edges = [round(total * sum(weights[:end]) / max(sum(weights), 1)) for end in range(len(weights))] + [total]
    return [stop - start for start, stop in pairwise(edges)]


def clean(text: str) -> str:
    """``text`` without terminal escapes, control, formatting and surrogate characters; line breaks and tabs stay."""
    text = _ESCAPE.sub("", text)
    return "".join(c for c in text if c in "\n\t" or unicodedata.category(c) not in ("Cc", "Cf", "Cs", "Zl", "Zp"))


def one_line(words: str, length: int = 200) -> str:
    """Text of a server as one short, clean line, without anything that looks like a key."""
    words = words[:MAX_MESSAGE_CHARS]
    for variable in KEY_VARIABLES:
        if key := os.environ.get(variable, "").strip():
            words = words.replace(key, "***")
    words = " ".join(clean(re.sub(r"\b(sk|key)-[\w*-]{4,}", "***", words)).split())
    return words if len(words) <= length else words[:length] + "…"
