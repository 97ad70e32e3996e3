"""Whatever a server sends is read, or refused in one line."""

from hypothesis import given, settings

from tests.fuzz_targets_llm import SERVER_REPLIES, check_server_reply


@settings(max_examples=200, deadline=1000, derandomize=True)
@given(SERVER_REPLIES)
def test_any_server_reply_is_read_or_refused_in_one_line(content: bytes):
    check_server_reply(content)
