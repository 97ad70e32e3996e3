"""A GGUF model inside this process, run by llama.cpp (through xllamacpp) on all cores.

Many short prompts (factorised layout) are spread over one single-threaded server a core. One long prompt (sequence
layout) has one server with all cores. Each prompt has a slot of its own whose cache is reused: the demonstrations are
read once, for all samples and all later plans.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import signal
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from robust_instant_policy.errors import MissingExtraError, ModelError
from robust_instant_policy.llm.model import NO_FILE, NOBODY, Listener, Sampling, Tally, context_error, sample_seed
from robust_instant_policy.llm.reply import CUT_OFF, whole_numbers
from robust_instant_policy.query import Answer, Query

SHORT_TOKENS = 2048  # prompts up to this length, with their answers, run many at a time
SLOT_STEP_TOKENS, LONG_STEP_TOKENS = 256, 4096  # sizes of short and long slots are multiples of these
COUNTED_PROMPTS = 3  # the longest, whose tokens are counted
SHORT_SLOTS = 24  # over all cores; a plan has about ten prompts an arm
MAX_SERVERS = 8  # more cores bring little to ten or twenty prompts
PROGRESS_TOKENS = 128  # read between two checks of the deadline and of Ctrl-C, by each prompt
MAX_CONTEXT_TOKENS = 32_768  # bounds the memory for models with a longer context
REPLY_S = 30.0  # for what a server in this process answers at once, on a busy machine
FINGERPRINT_PIECES, PIECE_BYTES = 8, 1 << 20  # of a model file, evenly spaced, for its digest
_DIRECTLY = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # the servers are in this process


def file_name(path: Path) -> str:
    """The name of a model file and eight hexadecimal digits of its size and content; the name alone when it is missing.

    Reading a whole model takes seconds, and files with other weights differ nearly everywhere.
    """
    if not path.is_file():
        return path.stem
    size = path.stat().st_size
    digest = hashlib.sha256(str(size).encode())
    with path.open("rb") as file:
        for piece in range(FINGERPRINT_PIECES):
            file.seek(max(0, size - PIECE_BYTES) * piece // (FINGERPRINT_PIECES - 1))
            digest.update(file.read(PIECE_BYTES))
    return f"{path.stem}@{digest.hexdigest()[:8]}"


@dataclass(frozen=True)
class _Layout:
    """How many servers, how many slots in each, and how many tokens a slot holds."""

    servers: int
    slots: int
    tokens: int
    is_long: bool = False

    @classmethod
    def of(cls, tokens: int, most: int) -> _Layout:
        """For prompts of up to ``tokens``, in a context of ``most``."""
        if tokens > SHORT_TOKENS:
            return cls(1, 1, min(-(-tokens // LONG_STEP_TOKENS) * LONG_STEP_TOKENS, most), is_long=True)
        servers = min(os.cpu_count() or 1, MAX_SERVERS)
        return cls(servers, -(-SHORT_SLOTS // servers), -(-tokens // SLOT_STEP_TOKENS) * SLOT_STEP_TOKENS)


@dataclass(eq=False)
class _Deadline:
    """The time at which sampling stops; an error sets it to the past."""

    at: float

    @property
    def has_passed(self) -> bool:
        return time.monotonic() > self.at


@dataclass(eq=False)
class _Slot:
    """A slot of a server, with a cache of the last text that it read."""

    server: Any
    number: int
    text: str = ""
    queue: list[int] = field(default_factory=list)


class LlamaModel:
    """The model file at ``path``; ``name`` identifies it in the sample store.

    Without ``context_length`` (tokens) the model is loaded at once and llama.cpp is asked. Raises `ModelError`.
    """

    def __init__(self, path: Path, name: str, context_length: int | None = None):
        if not path.is_file():
            raise ModelError(NO_FILE.format(path))
        self._path = path
        self.name = name
        self._layout: _Layout | None = None
        self._servers: list[Any] = []
        self._slots: list[_Slot] = []
        self._lock = threading.Lock()
        # The servers listen on this machine's loopback address; the key keeps other programs out.
        self._key = secrets.token_hex(16)
        if context_length is None:
            context_length = self._get("/v1/models")["data"][0]["meta"]["n_ctx_train"]
        self.context_length: int | None = min(context_length, MAX_CONTEXT_TOKENS)

    def count_tokens(self, text: str) -> int:
        return len(self._get("/tokenize", {"content": text, "add_special": True})["tokens"])

    def _get(self, address: str, body: dict[str, Any] | None = None) -> Any:
        if not self._servers:
            self._start(_Layout.of(SHORT_TOKENS, SHORT_TOKENS))
        return self._fetch(self._servers[0], address, body)

    def _fetch(self, server: Any, address: str, body: dict[str, Any] | None = None) -> Any:
        request = urllib.request.Request(
            server.listening_address + address,
            None if body is None else json.dumps(body).encode(),
            {"Content-Type": "application/json", "Authorization": f"Bearer {self._key}"},
        )
        with _DIRECTLY.open(request, timeout=REPLY_S) as response:
            return json.load(response)

    def sample(self, queries: Sequence[Query], sampling: Sampling, listener: Listener = NOBODY) -> list[list[Answer]]:
        """See `LanguageModel.sample`."""
        deadline = _Deadline(time.monotonic() + sampling.deadline_s)
        tally = Tally(len(queries), sampling, listener)
        if not queries or sampling.n < 1:
            return tally.answers()
        with self._lock:  # two plans at the same time would slow each other down
            layout = self._layout_for(queries)
            if layout != self._layout:
                self._start(layout)
            self._ask(queries, tally, sampling, deadline)
        return tally.answers()

    def close(self) -> None:
        self._servers, self._slots, self._layout = [], [], None

    def _ask(self, queries: Sequence[Query], tally: Tally, sampling: Sampling, deadline: _Deadline) -> None:
        self._assign(queries)

        def work(slot: _Slot) -> None:
            for index in slot.queue:
                query = queries[index]
                while (missing := tally.missing(index)) and not deadline.has_passed:
                    request = _request(query, sampling, missing[0], tally.attempt(index, missing[0]))
                    request["id_slot"] = slot.number
                    slot.text = query.text
                    answer = _complete(slot.server, request, deadline)
                    if answer is not None:
                        tally.add(index, missing[0], answer)

        busy = [slot for slot in self._slots if slot.queue]
        with ThreadPoolExecutor(len(busy)) as pool:
            try:
                for _ in pool.map(work, busy):
                    pass
            except BaseException:
                deadline.at = 0.0  # the others stop at their next token
                raise

    def _assign(self, queries: Sequence[Query]) -> None:
        """Assign each query to the slot whose cache has most of it, evenly over the slots."""
        for slot in self._slots:
            slot.queue = []
        rounds = -(-len(queries) // len(self._slots))
        pairs = sorted(
            (-_common_length(query.text, slot.text), place, index)
            for index, query in enumerate(queries)
            for place, slot in enumerate(self._slots)
            if slot.text
        )
        placed: set[int] = set()
        for shared, place, index in pairs:
            slot = self._slots[place]
            if -shared * 2 > len(queries[index].text) and index not in placed and len(slot.queue) < rounds:
                slot.queue.append(index)
                placed.add(index)
        for index in range(len(queries)):
            if index not in placed:
                # the server with the least work, so that all cores are busy to the end
                load: Counter[int] = Counter()
                for slot in self._slots:
                    load[id(slot.server)] += len(slot.queue)
                free = min(self._slots, key=lambda slot: (len(slot.queue), bool(slot.text), load[id(slot.server)]))
                free.queue.append(index)

    def _layout_for(self, queries: Sequence[Query]) -> _Layout:
        # A token is at least one character of the numbers' alphabet, so most prompts need not be counted.
        assert self.context_length is not None
        longest = max(queries, key=lambda query: len(query.text) + query.max_tokens)
        need = len(longest.text) + 1 + longest.max_tokens
        if need > SLOT_STEP_TOKENS:
            by_length = sorted(queries, key=lambda query: len(query.text) + query.max_tokens)
            need = max(self.count_tokens(query.text) + query.max_tokens for query in by_length[-COUNTED_PROMPTS:])
        if need > self.context_length:
            raise context_error(need - longest.max_tokens, longest.max_tokens, self.context_length)
        layout = _Layout.of(need, self.context_length)
        running = self._layout
        if running is not None and running.is_long == layout.is_long and running.tokens >= layout.tokens:
            return running
        return layout

    def _start(self, layout: _Layout) -> None:
        try:
            import xllamacpp
        except ModuleNotFoundError:
            raise MissingExtraError("xllamacpp", "embedded") from None
        self.close()  # frees the other layout's memory first
        try:
            with _signals_held():
                for _ in range(layout.servers):
                    self._servers.append(xllamacpp.Server(self._params(xllamacpp, layout)))
                    # Answered by the loop over tasks: a server that is closed before its loop runs is never closed.
                    self._fetch(self._servers[-1], "/slots")
        except (RuntimeError, ValueError, OSError) as error:
            self.close()
            raise ModelError(
                f"{self._path} is not a readable GGUF file, or too large for this machine ({error}); download or copy "
                "it again"
            ) from None
        self._slots = [_Slot(server, number) for number in range(layout.slots) for server in self._servers]
        self._layout = layout

    def _params(self, xllamacpp: Any, layout: _Layout) -> Any:
        params = xllamacpp.CommonParams()
        params.model.path = str(self._path)
        params.api_keys = [self._key]
        params.n_parallel = layout.slots
        params.kv_unified = False
        params.n_ctx = layout.tokens * layout.slots
        # Without it, layers with a sliding window drop their cache, and a slot cannot continue from a prompt.
        params.swa_full = True
        params.cache_ram_mib = 0
        threads = _free_cores() if layout.is_long else 1
        params.cpuparams.n_threads = params.cpuparams_batch.n_threads = threads
        params.n_batch = PROGRESS_TOKENS
        params.fit_params = False
        params.warmup = False
        params.verbosity = 0
        return params


def _request(query: Query, sampling: Sampling, sample: int, attempt: int) -> dict[str, Any]:
    request: dict[str, Any] = {
        "prompt": query.text,
        "max_tokens": query.max_tokens,
        "temperature": sampling.temperature,
        "seed": sample_seed(sampling.seed, sample, attempt),
        "cache_prompt": True,
        "stream": True,
        "return_progress": True,  # the deadline is checked while a long prompt is read, too
        "stream_options": {"include_usage": True},
    }
    if query.grammar is not None:
        request["grammar"] = query.grammar
    if query.stop:
        request["stop"] = list(query.stop)
    return request


def _complete(server: Any, request: dict[str, Any], deadline: _Deadline) -> Answer | None:
    """The answer to one request, or None when the deadline passes first."""
    pieces: list[str] = []
    usage: dict[str, Any] = {}
    failure: list[str] = []
    finish: set[str] = set()
    start = time.monotonic()

    def receive(chunk: dict[str, Any]) -> bool:
        if "error" in chunk:
            failure.append(str(chunk["error"].get("message", chunk["error"])))
            return True
        pieces.extend(choice["text"] for choice in chunk.get("choices", ()) if choice["text"])
        finish.update(choice.get("finish_reason") or "" for choice in chunk.get("choices", ()))
        usage.update(chunk.get("usage") or {})
        return deadline.has_passed

    server.handle_completions(request, receive)
    if failure:
        raise ModelError(f"llama.cpp refused the prompt: {failure[0]}")
    if deadline.has_passed:
        return None
    text, cut = "".join(pieces), "length" in finish
    return Answer(
        whole_numbers(text) if cut else text,
        prompt_tokens=usage.get("prompt_tokens", 0),
        cached_tokens=usage.get("prompt_tokens_details", {}).get("cached_tokens", 0),
        completion_tokens=len(pieces),
        seconds=time.monotonic() - start,
        fault=CUT_OFF if cut else "",
    )


@contextmanager
def _signals_held() -> Iterator[None]:
    """Delay Ctrl-C: a server that is interrupted while it starts hangs.

    Its threads inherit the mask, so that the signal reaches Python's main thread later.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _free_cores() -> int:
    # llama.cpp's threads spin while they wait for each other: more threads than free cores slow all of them down.
    return max(1, (os.cpu_count() or 1) - round(os.getloadavg()[0]))


def _common_length(a: str, b: str) -> int:
    return next((place for place, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))
