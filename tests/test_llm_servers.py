"""The endpoint against servers that answer as OpenAI, vLLM, SGLang, Ollama, LM Studio and gateways do, over real HTTP.

Requests and replies follow the servers' documentation; the servers themselves were not run.
"""

from __future__ import annotations

import json
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from robust_instant_policy.errors import ModelError, UsageError
from robust_instant_policy.llm import Listener, Sampling, check_server, connect, refusal_advice
from robust_instant_policy.llm.endpoint import MAX_BROKEN, MAX_EMPTY
from robust_instant_policy.query import Answer, Query
from tests.fuzz_targets_llm import read_pair
from tests.stand_in_server import NOT_FOUND, Request, Response, Script, StandInServer, chat, completion, error

PAIR = Query(
    "1 2\n2 3\n3",
    max_tokens=8,
    grammar='root ::= [0-9] " " [0-9] "\\n"',
    pattern="[0-9] [0-9]",
    stop=("\n",),
    instruction="Continue.",
)
LONG = Query("12 34\n" * 400, max_tokens=8)
READ = Listener(accept=read_pair)


@pytest.fixture
def serve() -> Iterator[Callable[[Script], StandInServer]]:
    made: list[StandInServer] = []

    def start(script: Script, certificate: Path | None = None) -> StandInServer:
        made.append(StandInServer(script, certificate))
        return made[-1]

    yield start
    for server in made:
        server.close()


def models(owner: str, **entry: object) -> Response:
    return Response({"object": "list", "data": [{"id": "m", "object": "model", "owned_by": owner, **entry}]})


def plain(answer: Callable[[Request], Response]) -> Script:
    """A server that tells nothing of itself."""
    return lambda request: answer(request) if request.path.endswith("/completions") else NOT_FOUND


def sample(
    server: StandInServer, queries: int | list[Query] = 1, n: int = 1, style: str = "", deadline_s: float = 20.0
) -> list[list[Answer]]:
    asked = [PAIR] * queries if isinstance(queries, int) else queries
    return connect(f"{style}{server.url}#m").sample(asked, Sampling(n, 0.5, deadline_s=deadline_s), READ)


def message_of(server: StandInServer, **options: object) -> str:
    with pytest.raises(ModelError) as caught:
        sample(server, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# ---- what servers tell of themselves ----


def vllm(request: Request, has_template: bool = True) -> Response:
    if request.path == "/v1/models":
        return models("vllm", root="m", max_model_len=4096)
    if request.path == "/v1/chat/completions" and not has_template:
        message = (
            "As of transformers v4.44, default chat template is no longer allowed, so you must provide a chat template"
        )
        return Response({"object": "error", "message": message, "type": "BadRequestError", "code": 400}, 400)
    if request.path == "/tokenize":
        return Response({"count": 13, "max_model_len": 4096, "tokens": list(range(13))})
    if set(request.body) & {"grammar", "regex", "guided_regex"}:
        return Response({"object": "error", "message": "Extra inputs are not permitted", "code": 400}, 400)
    usage = {"prompt_tokens": 13, "completion_tokens": 6, "total_tokens": 19, "prompt_tokens_details": None}
    reply = chat if request.path == "/v1/chat/completions" else completion
    return reply(*["3 4"] * request.body.get("n", 1), usage=usage)


def test_vllm_is_asked_by_chat_with_a_regular_expression(serve):
    server = serve(vllm)
    model = connect(f"{server.url}#m")
    assert (model.context_length, model.count_tokens(PAIR.text)) == (4096, 13)
    (answers,) = model.sample([PAIR], Sampling(2, 0.5, seed=1), READ)
    assert [answer.value for answer in answers] == [(3, 4)] * 2
    assert [(answer.prompt_tokens, answer.completion_tokens) for answer in answers] == [(13, 3), (0, 3)]
    (request,) = server.asked
    assert request.path == "/v1/chat/completions"
    assert request.body["structured_outputs"] == {"regex": PAIR.pattern}
    assert [message["role"] for message in request.body["messages"]] == ["system", "user"]


def test_a_base_model_of_vllm_continues_the_text(serve):
    server = serve(lambda request: vllm(request, has_template=False))
    assert [len(own) for own in sample(server, queries=4)] == [1] * 4
    refused, *_, request = server.asked
    assert (refused.path, len(server.asked)) == ("/v1/chat/completions", 5)
    assert request.path == "/v1/completions"
    assert request.body["prompt"] == PAIR.text
    assert request.body["stop"] == ["\n"]


def test_sglang_gets_its_regular_expression(serve):
    def sglang(request: Request) -> Response:
        if request.path == "/v1/models":
            return models("sglang", root="m", max_model_len=32768)
        return chat(*["3 4"] * request.body.get("n", 1), usage={"prompt_tokens": 20, "completion_tokens": 8})

    server = serve(sglang)
    assert len(sample(server, n=2)[0]) == 2
    assert server.asked[0].body["regex"] == PAIR.pattern
    assert connect(f"{server.url}#m").context_length == 32768


def test_a_base_model_without_chat_template_on_sglang_is_asked_to_continue(serve):
    def sglang(request: Request) -> Response:
        if request.path == "/v1/models":
            return models("sglang", root="m", max_model_len=32768)
        if request.path == "/v1/chat/completions":
            return error("This tokenizer has no chat template, so messages cannot be formatted.")
        return completion("3 4")

    server = serve(sglang)
    assert len(sample(server, queries=4)) == 4
    assert [request.path for request in server.asked].count("/v1/chat/completions") == 1


@pytest.mark.parametrize(
    ("template", "style"),
    [("{{ .Prompt }}", "completions"), ("<|user|>{{ .Prompt }}<|assistant|>{{ .Response }}", "chat/completions")],
)
def test_ollama_tells_whether_a_model_chats_whatever_its_name(serve, template, style):
    def ollama(request: Request) -> Response:
        if request.path == "/v1/models":
            return models("unsloth")
        if request.path == "/api/show":
            assert request.body == {"model": "hf.co/unsloth/x"}
            return Response({"template": template, "parameters": 'stop "x"\nnum_ctx                        2048'})
        return (chat if "chat" in request.path else completion)("3 4")

    server = serve(ollama)
    model = connect(f"{server.url}#hf.co/unsloth/x")
    model.sample([PAIR], Sampling(1, 0.5), READ)
    assert server.asked[0].path == f"/v1/{style}"
    assert model.context_length == 2048


def test_lm_studio_tells_the_context_that_it_loaded(serve):
    def studio(request: Request) -> Response:
        if request.path == "/v1/models":
            return models("organization_owner")
        if request.path == "/api/v0/models/m":
            return Response({"id": "m", "type": "llm", "max_context_length": 131072, "loaded_context_length": 4096})
        return chat("3 4")

    server = serve(studio)
    assert connect(f"{server.url}#m").context_length == 4096
    assert len(sample(server)[0]) == 1


@pytest.mark.parametrize("length", [True, "4096", -1, 1e3, None, [4096], 10**40])
def test_a_context_length_that_is_none_is_not_believed(serve, length):
    server = serve(lambda _: models("vllm", max_model_len=length))
    assert connect(f"{server.url}#m").context_length is None


# ---- requests that are refused and put differently ----


def _at_once(count: int, answer: Callable[[Request], Response]) -> Callable[[Request], Response]:
    """Hold the first ``count`` requests until all are there, so that they are refused at the same time."""
    barrier, seen = threading.Barrier(count), []

    def script(request: Request) -> Response:
        seen.append(request)
        if len(seen) <= count:
            barrier.wait(timeout=10)
        return answer(request)

    return script


REFUSALS = {
    "max_tokens": error(
        "Unsupported parameter: 'max_tokens' is not supported with this model. Use 'max_completion_tokens' instead.",
        param="max_tokens",
    ),
    "temperature": error("Unsupported value: 'temperature' does not support 0.5 with this model.", param="temperature"),
    "seed": Response({"detail": [{"type": "extra_forbidden", "loc": ["body", "seed"], "msg": "Extra inputs"}]}, 422),
}


@pytest.mark.parametrize("field", REFUSALS)
def test_requests_refused_at_the_same_time_are_all_put_differently(serve, field):
    def strict(request: Request) -> Response:
        if field in request.body:
            return REFUSALS[field]
        return chat("3 4")

    warm = {"on": True}  # the endpoint gets to know the server first, so that later requests go at the same time
    held = _at_once(8, strict)
    server = serve(plain(lambda request: chat("3 4") if warm["on"] else held(request)))
    model = connect(f"{server.url}#m")
    model.sample([PAIR], Sampling(1, 0.5), READ)
    warm["on"] = False
    answers = model.sample([PAIR] * 8, Sampling(1, 0.5, deadline_s=20), READ)
    assert [len(own) for own in answers] == [1] * 8
    assert field not in server.asked[-1].body


def test_a_server_without_chat_is_found_out_by_several_requests_at_once(serve):
    warm = {"on": True}
    held = _at_once(8, lambda request: NOT_FOUND if "chat" in request.path else completion("3 4"))
    server = serve(plain(lambda request: chat("3 4") if warm["on"] else held(request)))
    model = connect(f"{server.url}#m")
    model.sample([PAIR], Sampling(1, 0.5), READ)
    warm["on"] = False
    assert [len(own) for own in model.sample([PAIR] * 8, Sampling(1, 0.5, deadline_s=20), READ)] == [1] * 8


def test_text_completions_never_carry_a_field_of_chat(serve):
    def strict(request: Request) -> Response:
        return completion("3 4") if "max_tokens" not in request.body else REFUSALS["max_tokens"]

    server = serve(plain(strict))
    assert "max_completion_tokens" in message_of(server, style="completions+")
    assert not any("max_completion_tokens" in request.body for request in server.asked)


def test_a_chat_model_behind_text_completions_is_asked_by_chat(serve):
    def openai(request: Request) -> Response:
        if request.path == "/v1/models":
            return models("vllm")
        if request.path == "/v1/completions":
            return error("This is a chat model and not supported in the v1/completions endpoint.", 404, "model")
        return chat("3 4") if "chat" in request.path else NOT_FOUND

    assert len(sample(serve(openai))[0]) == 1


def test_an_unknown_model_and_a_wrong_path_are_told_at_once(serve):
    server = serve(plain(lambda _: Response({"error": "model 'm' not found, try pulling it first"}, 404)))
    assert "model 'm' not found, try pulling it first" in message_of(server)
    assert len(server.asked) == 1
    assert "does the address end in /v1?" in message_of(serve(lambda _: Response(b"404 page not found", 404)))


def test_a_server_that_gives_one_answer_for_n_is_asked_at_the_same_time(serve):
    server = serve(plain(lambda _: chat("3 4")))
    assert len(sample(server, n=4)[0]) == 4
    assert [request.body.get("n") for request in server.asked] == [4, None, None, None]
    assert len({request.body["seed"] for request in server.asked}) == 4


# ---- replies that make no sense ----

SENSELESS = {
    "usage of strings": chat("3 4", usage={"prompt_tokens": "13", "completion_tokens": "x", "total_tokens": None}),
    "usage of floats and negatives": chat("3 4", usage={"prompt_tokens": 1e300, "completion_tokens": -5}),
    "usage that is a list": chat("3 4", usage=["13"]),
    "huge usage": chat("3 4", usage={"prompt_tokens": 10**30, "completion_tokens": 10**30}),
    "content in parts": chat([{"type": "text", "text": "3"}, {"type": "text", "text": " 4"}]),
    "half a surrogate": Response(b'{"choices":[{"message":{"content":"3 4\\ud800"},"finish_reason":"stop"}]}'),
}


@pytest.mark.parametrize("name", SENSELESS)
def test_odd_replies_with_an_answer_are_read(serve, name):
    answer = sample(serve(plain(lambda _: SENSELESS[name])))[0][0]
    assert answer.value == (3, 4)
    assert answer.text.encode()
    assert 0 <= answer.prompt_tokens < 10**9


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"<html><h1>Bad gateway</h1></html>",
        b"[" * 100_000,
        b'{"choices":' + b'{"a":' * 50_000,
        b"9" * 100_000,
        b"[]",
        b"null",
        b'{"choices":{}}',
        b'{"choices":[3]}',
        b'{"choices":[{"text":7}]}',
    ],
    ids=lambda body: repr(body[:12]),
)
def test_replies_without_an_answer_are_told_in_one_line(serve, body):
    server = serve(plain(lambda _: Response(body)))
    message = message_of(server, deadline_s=0.6)
    if "its reply could not be read" not in message:  # the machine is busy
        message = message_of(server, deadline_s=10.0)
    assert "its reply could not be read" in message


@pytest.mark.parametrize(
    ("response", "words"),
    [(Response(b"<html><h1>Sign in</h1></html>"), "web page: 'Sign in'"), (Response(b"oops", 500), "answered 500")],
)
def test_a_server_that_serves_no_model_is_told_after_a_few_requests(serve, response, words):
    server = serve(lambda _: response)
    assert words in message_of(server, deadline_s=30.0)
    assert len(server.requests) <= 8


@pytest.mark.parametrize(
    ("response", "words"), [(Response(b"oops", 500), "answered 500"), (Response({"hello": 1}), "it holds no answer")]
)
def test_a_server_that_serves_no_model_is_told_before_any_work(serve, response, words):
    server = serve(plain(lambda _: response))
    with pytest.raises(ModelError, match=words):
        check_server(f"{server.url}#m")
    assert len(server.asked) == MAX_BROKEN


def test_a_model_that_says_nothing_is_told_after_the_first_few_requests(serve):
    server = serve(plain(lambda request: chat(*[None] * request.body.get("n", 1))))
    assert "replies without text and no answer" in message_of(server, queries=16, n=5)
    assert len(server.asked) == MAX_EMPTY


@pytest.mark.parametrize(
    ("status", "body"),
    [
        (200, {"error": "no GPU left"}),
        (200, {"error": {"message": "no GPU left", "code": None}}),
        (400, {"error": "no GPU left"}),
        (400, {"message": "no GPU left"}),
        (418, {"detail": [{"msg": "no GPU left"}]}),
    ],
)
def test_errors_are_quoted_in_whatever_form_they_come(serve, status, body):
    assert "no GPU left" in message_of(serve(plain(lambda _: Response(body, status))))


def test_an_error_inside_a_success_that_passes_is_waited_for(serve):
    replies = [Response({"error": {"code": 429, "message": "slow down"}}), Response({"error": "server overloaded"})]
    server = serve(plain(lambda _: replies.pop() if replies else chat("3 4")))
    assert len(sample(server)[0]) == 1


def test_control_characters_reach_neither_messages_nor_answers(serve):
    nasty = "\x1b[2J\x1b]0;owned\x07no\x00 G\u202ePU\x9b1m\r\nleft"
    assert "no GPU1m left" in message_of(serve(plain(lambda _: error(nasty))))
    answer = sample(serve(plain(lambda _: chat("\x1b[31m3\x1b[0m 4\u202e\x07"))))[0][0]
    assert answer.text == "3 4"


# ---- answers that are none ----


@pytest.mark.parametrize("style", ["chat+", "completions+"])
def test_a_number_that_was_cut_off_is_not_taken(serve, style):
    whole = iter([False])

    def cut(request: Request) -> Response:
        reply = chat if "chat" in request.path else completion
        return reply("3 45") if next(whole, True) else reply("3 4", finish="length")

    assert [answer.value for answer in sample(serve(plain(cut)), style=style)[0]] == [(3, 45)]


def test_numbers_before_the_cut_are_taken(serve):
    server = serve(plain(lambda _: completion("3 4\nand so on and so fo", finish="length")))
    assert sample(server, style="completions+")[0][0].text == "3 4\nand so on and so "


def test_what_a_content_filter_left_is_not_taken(serve):
    finishes = ["content_filter", "stop"]
    server = serve(plain(lambda _: chat("3 4", finish=finishes.pop(0))))
    refused: list[Answer] = []
    model = connect(f"{server.url}#m")
    listener = Listener(read_pair, on_answer=lambda q, s, a, answer, ok: None if ok else refused.append(answer))
    assert len(model.sample([PAIR], Sampling(1, 0.5), listener)[0]) == 1
    assert refused[0].fault == "withheld by the server's content filter"


def test_refused_answers_are_heard_and_explained(serve):
    server = serve(plain(lambda _: chat("Sure! I would love to help you with that.")))
    refused: list[Answer] = []
    listener = Listener(read_pair, on_answer=lambda q, s, a, answer, ok: None if ok else refused.append(answer))
    assert connect(f"{server.url}#m").sample([PAIR], Sampling(1, 0.5), listener) == [[]]
    advice = refusal_advice(refused)
    assert advice.startswith("8 answers could not be read as numbers, for example 'Sure! I would love")
    assert "use a larger model" in advice
    assert refusal_advice([]) == ""


@pytest.mark.parametrize(
    ("content", "more"),
    [
        ("<think>3 + 1 is 4, so 7 8?</think>\n3 4", {}),
        ("3 + 1 is 4, so 7 8?</think>3 4", {}),
        ("[THINK]7 8[/THINK]3 4", {}),
        ("<|channel|>analysis<|message|>7 8<|end|><|start|>assistant<|channel|>final<|message|>3 4", {}),
        ("3 4", {"reasoning_content": "7 8"}),
        ("3 4", {"reasoning": "7 8"}),
    ],
)
def test_the_answer_of_a_reasoning_model_is_what_follows_its_thinking(serve, content, more):
    server = serve(plain(lambda _: chat(content, **more)))
    assert sample(server)[0][0].value == (3, 4)


@pytest.mark.parametrize(
    ("content", "more"),
    [
        (None, {"reasoning_content": "Let me see"}),
        ("", {"reasoning": "Let me see"}),
        ("<think>Let me see", {}),
        ("Let me see", {}),
    ],
)
def test_thinking_that_uses_up_the_tokens_gets_more_of_them(serve, content, more):
    def thinker(request: Request) -> Response:
        return chat(content, finish="length", **more) if request.body["max_tokens"] < 1000 else chat("3 4")

    server = serve(plain(thinker))
    assert [len(own) for own in sample(server, queries=8, n=5)] == [5] * 8
    assert sum(request.body["max_tokens"] < 1000 for request in server.asked) <= 2


def test_thinking_without_end_is_told_after_the_first_few_requests(serve):
    server = serve(plain(lambda _: chat(None, finish="length", reasoning_content="Let me see")))
    message = message_of(server, queries=8, n=5)
    assert "without giving an answer (cut off while still thinking: 'Let me see'); switch off" in message
    assert len(server.asked) <= 5


def test_a_prompt_that_the_server_cut_is_told(serve):
    server = serve(plain(lambda _: chat("3 4", usage={"prompt_tokens": 512, "completion_tokens": 3})))
    message = message_of(server, queries=[LONG])
    assert "read only 512 of about 1600 tokens of the prompt; raise the server's context (Ollama" in message
    whole = serve(plain(lambda _: chat("3 4", usage={"prompt_tokens": 1200, "completion_tokens": 3})))
    assert len(sample(whole, queries=[LONG])[0]) == 1


# ---- pauses ----


@pytest.mark.parametrize("header", ["0", "-5", "nan", "-inf", "soon", "Thu, 01 Jan 1970 00:00:00 GMT"])
def test_a_retry_after_of_nothing_does_not_switch_off_the_pauses(serve, header):
    server = serve(plain(lambda _: Response({"error": "busy"}, 429, {"Retry-After": header})))
    assert "it answered 429 (busy)" in message_of(server, deadline_s=1.5)
    assert len(server.asked) <= 6


def test_a_retry_after_is_kept_to(serve):
    replies = [Response({"error": "busy"}, 503, {"Retry-After": "1"})]
    server = serve(plain(lambda _: replies.pop() if replies else chat("3 4")))
    start = time.monotonic()
    assert len(sample(server)[0]) == 1
    assert time.monotonic() - start >= 1


# ---- keys ----


def test_each_key_goes_to_its_own_host_only(serve, monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", "sk-openaiopenai")
    server = serve(plain(lambda _: chat("3 4")))
    sample(server)
    assert not any("Authorization" in request.headers for request in server.requests)
    monkeypatch.setenv("RIP_API_KEY", "tok-private-1234\n")
    sample(server)
    assert server.requests[-1].headers["Authorization"] == "Bearer tok-private-1234"
    assert not any("sk-openai" in json.dumps(request.headers) for request in server.requests)


def test_a_key_is_not_sent_unencrypted_to_another_machine(monkeypatch):
    monkeypatch.setenv("RIP_API_KEY", "tok-private-1234")
    with pytest.raises(ModelError, match=r"would travel unencrypted to http://10\.0\.0\.7:1/v1; use https") as caught:
        connect("http://10.0.0.7:1/v1#m").sample([PAIR], Sampling(1, 0.5, deadline_s=5))
    assert "tok-private" not in str(caught.value)


def test_a_key_is_told_to_nobody(serve, monkeypatch):
    monkeypatch.setenv("RIP_API_KEY", "tok-private-1234")
    server = serve(plain(lambda _: error("bad key tok-private-1234; see sk-abcd***mnop")))
    message = message_of(server)
    assert "tok-private" not in message
    assert "abcd" not in message
    monkeypatch.setenv("RIP_API_KEY", "tok-pri\nvate")
    assert "RIP_API_KEY holds characters that no key has" in message_of(server)
    with pytest.raises(UsageError, match="RIP_API_KEY"):
        connect("http://user:secret@127.0.0.1:1/v1#m")


def test_a_redirect_is_told_and_not_followed(serve, monkeypatch):
    monkeypatch.setenv("RIP_API_KEY", "tok-private-1234")
    other = serve(plain(lambda _: chat("3 4")))
    server = serve(lambda request: Response({}, 307, {"Location": other.url + request.path.removeprefix("/v1")}))
    assert f"redirects to '{other.url}" in message_of(server)
    assert not other.requests


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("http://h:99999/v1#m", "http://h:99999/v1 is no address: Port out of range 0-65535"),
        ("http://h:x/v1#m", "http://h:x/v1 is no address: Port could not be cast to integer"),
        ("http://h:0/v1#m", "port 0"),
        ("http://[::1/v1#m", "is no address: Invalid IPv6 URL"),
        ("http://h/v1#", "an address needs its model behind a #"),
    ],
)
def test_what_is_wrong_with_an_address_is_told(address, words):
    with pytest.raises(UsageError, match=words):
        connect(address)


# ---- TLS ----


def certificate(folder: Path, name: str) -> Path:
    path = folder / "both.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2",
         "-keyout", folder / "key.pem", "-out", folder / "cert.pem", "-subj", "/CN=test", "-addext",
         f"subjectAltName={name}"],
        check=True, capture_output=True,
    )  # fmt: skip
    path.write_text((folder / "key.pem").read_text() + (folder / "cert.pem").read_text())
    return path


def test_tls_failures_are_named(serve, tmp_path, monkeypatch):
    answer = plain(lambda _: chat("3 4"))
    server = serve(answer, certificate(tmp_path, "IP:127.0.0.1"))
    assert "certificate that is not trusted (self-signed certificate); put its certificate" in message_of(server)
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "cert.pem"))
    assert len(sample(server)[0]) == 1
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "missing.pem"))
    assert "SSL_CERT_FILE" in message_of(server)


def test_a_certificate_for_another_host_is_named(serve, tmp_path, monkeypatch):
    server = serve(plain(lambda _: chat("3 4")), certificate(tmp_path, "DNS:example.com"))
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "cert.pem"))
    assert "use the name that its certificate is for" in message_of(server)


def test_http_and_https_taken_for_each_other_are_named(serve, tmp_path):
    open_, secret = serve(plain(lambda _: chat("3 4"))), serve(NOT_FOUND, certificate(tmp_path, "IP:127.0.0.1"))
    open_.url = open_.url.replace("http:", "https:")
    assert "does not speak TLS; write http://" in message_of(open_)
    secret.url = secret.url.replace("https:", "http:")
    assert "speaks TLS; write https://" in message_of(secret)
