"""What a fuzzer feeds to the language-model room: replies of servers, as bytes.

`check_server_reply` passes for every input: the reply is read rightly, or refused with an error of our own in one line.
"""

from __future__ import annotations

import json
import re

from hypothesis import strategies as st

from robust_instant_policy.llm.dialect import Server, discover
from robust_instant_policy.llm.model import Listener
from robust_instant_policy.llm.reply import UnreadableReplyError, read_complaint, read_json, read_reply
from robust_instant_policy.query import Answer


def read_pair(_: int, text: str) -> tuple[int, ...] | None:
    """Two numbers in the first line, or None."""
    parts = text.strip().split("\n")[0].split()
    return tuple(map(int, parts)) if len(parts) == 2 and all(part.isdecimal() for part in parts) else None


def check_server_reply(content: bytes) -> None:
    """Read ``content`` as an answer, as an error message and as a list of models."""
    complaint = read_complaint(content)
    _check_line(complaint.message)
    complaint.names("n"), complaint.names("seed")
    try:
        reply = read_json(content)
    except UnreadableReplyError as error:
        _check_line(str(error))
        return
    _check_server(reply)
    for count in (1, 3):
        try:
            answers = read_reply(reply, count, 0.5).answers
        except UnreadableReplyError as error:
            _check_line(str(error))
            continue
        assert 1 <= len(answers) <= count
        for answer in answers:
            _check_answer(answer)


def _check_server(reply: object) -> None:
    async def tell(*_: object) -> object:
        return reply

    step = discover(tell, "http://localhost/v1", "m")
    try:
        step.send(None)
    except StopIteration as end:
        server: Server = end.value
        assert server.context_length is None or (type(server.context_length) is int and server.context_length > 0)


def _check_answer(answer: Answer) -> None:
    answer.text.encode()
    assert not any(ord(c) < 32 and c not in "\n\t" for c in answer.text)
    _check_line(answer.fault)
    for number in (answer.prompt_tokens, answer.cached_tokens, answer.completion_tokens):
        assert type(number) is int
        assert 0 <= number <= 10**9
    read = Listener(read_pair).read(0, answer)
    assert read is None or len(read.value) == 2


def _check_line(message: str) -> None:
    assert "\n" not in message
    assert "\x1b" not in message
    assert len(message) < 500


_TEXT = st.one_of(
    st.text(max_size=30),
    st.sampled_from(["3 4", "<think>", "</think>3 4", "\x1b[2J3 4", "length", "stop", "content_filter", "\ud800"]),
)
_NAMES = (
    "choices message text content finish_reason reasoning_content reasoning refusal usage prompt_tokens code data id "
    "completion_tokens prompt_tokens_details cached_tokens error detail msg loc param owned_by meta n_ctx tokens count "
    "max_model_len template parameters chat_template"
)
_KEYS = st.sampled_from(re.findall(r"\w+", _NAMES))
_VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), _TEXT, st.sampled_from(["vllm", "llamacpp", "m"])),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(_KEYS, inner, max_size=5)),
    max_leaves=12,
)
_CHOICE = st.fixed_dictionaries(
    {}, optional={"message": st.one_of(_VALUES, st.dictionaries(_KEYS, _VALUES, max_size=4)), "text": _VALUES,
                  "finish_reason": _VALUES},
)  # fmt: skip
_REPLIES = st.fixed_dictionaries(
    {"choices": st.lists(st.one_of(_CHOICE, _VALUES), max_size=4)}, optional={"usage": _VALUES, "error": _VALUES}
)
_JSON = st.one_of(_REPLIES, _VALUES).map(lambda value: json.dumps(value).encode())
_NESTED = st.tuples(st.sampled_from([b"[", b'{"error":', b'{"choices":[']), st.integers(1, 20_000)).map(
    lambda pair: pair[0] * pair[1]
)
_LONG = st.builds(
    lambda piece, count, finish: json.dumps({"choices": [{"text": piece * count, "finish_reason": finish}]}).encode(),
    st.sampled_from(["a", "1 ", "-1.5", "\x1b[", "\x1b]0;", "<think>", "</think>", "key-"]),
    st.integers(1, 100_000),
    st.sampled_from(["stop", "length"]),
)
_CUT = st.tuples(_JSON, st.integers(0, 200)).map(lambda pair: pair[0][: pair[1]])

SERVER_REPLIES: st.SearchStrategy[bytes] = st.one_of(_JSON, _CUT, _NESTED, _LONG, st.binary(max_size=200))
