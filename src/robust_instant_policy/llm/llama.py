"""A GGUF model run inside this process by llama.cpp (through xllamacpp), on all cores."""

from __future__ import annotations

import json
import os
import threading
import time
import urllib.request
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robust_instant_policy.errors import MissingExtraError, ModelError
from robust_instant_policy.llm.gguf import read_header
from robust_instant_policy.llm.model import (
    DEADLINE_S,
    Accept,
    OnAnswer,
    OnProgress,
    Tally,
    context_error,
)
from robust_instant_policy.query import Answer, Query

SHORT_PROMPT_TOKENS = 1024  # room of a slot, prompt and answer together, when many short prompts run at once
SHORT_PROMPT_SLOTS = 20
LONG_PROMPT_SLOTS = 5
PROMPT_CACHE_MIB = 512  # prompts read once are kept in memory, up to this
MAX_CONTEXT_TOKENS = 32_768  # bounds memory for models with a long context


@dataclass(frozen=True)
class _Shape:
    """How a server's memory is divided: ``slots`` conversations of ``tokens`` each."""

    slots: int
    tokens: int


class LlamaModel:
    """A model file of llama.cpp.

    Sampling runs in `slots` that are decoded together; prompts that share their beginning with an earlier one are
    read only from where they differ. The server behind it is started at the first use and sized by the prompts.
    """

    counts_exactly = True

    def __init__(self, path: Path, name: str | None = None):
        self._header = read_header(path)
        self._path = path
        self.name = name or path.stem
        self.context_length: int | None = min(self._header.context_length or MAX_CONTEXT_TOKENS, MAX_CONTEXT_TOKENS)
        self._server: Any = None
        self._shape = _Shape(0, 0)
        self._lock = threading.Lock()

    def count_tokens(self, text: str) -> int:
        server = self._server or self._start(_Shape(SHORT_PROMPT_SLOTS, SHORT_PROMPT_TOKENS))
        body = json.dumps({"content": text, "add_special": True}).encode()
        request = urllib.request.Request(
            server.listening_address + "/tokenize", body, {"Content-Type": "application/json"}
        )
        with urllib.request.urlopen(request, timeout=30) as response:
            return len(json.load(response)["tokens"])

    def sample(
        self,
        queries: Sequence[Query],
        n: int,
        *,
        temperature: float,
        seed: int = 0,
        first_index: int = 0,
        deadline_s: float = DEADLINE_S,
        accept: Accept | None = None,
        on_progress: OnProgress | None = None,
        on_answer: OnAnswer | None = None,
    ) -> list[list[Answer]]:
        """See `LanguageModel.sample`."""
        deadline = time.monotonic() + deadline_s
        tally = Tally(len(queries), n, first_index, accept, on_progress, on_answer)
        if not queries or n < 1:
            return tally.answers()
        with self._lock:  # one plan at a time: two would only slow each other down
            server = self._start(self._shape_for(queries))

            def run(query_index: int) -> None:
                while (missing := tally.missing(query_index)) and time.monotonic() < deadline:
                    indices = missing[: self._shape.slots]
                    request_seed = _seed(seed, query_index, tally.attempt(query_index, indices[0]), indices[0])
                    answers = _complete(server, queries[query_index], len(indices), temperature, request_seed, deadline)
                    for index, answer in zip(indices, answers, strict=False):
                        tally.add(query_index, index, answer)

            with ThreadPoolExecutor(max(1, self._shape.slots // n)) as pool:
                for _ in pool.map(run, range(len(queries))):
                    pass
        return tally.answers()

    def close(self) -> None:
        self._server = None

    def _shape_for(self, queries: Sequence[Query]) -> _Shape:
        # Numbers cost about one token a character, so the text's length tells short prompts without tokenising all.
        assert self.context_length is not None
        longest = max(queries, key=lambda query: len(query.text) + query.max_tokens)
        if len(longest.text) + longest.max_tokens + 1 <= SHORT_PROMPT_TOKENS:
            return _Shape(SHORT_PROMPT_SLOTS, SHORT_PROMPT_TOKENS)
        tokens = self.count_tokens(longest.text)
        if tokens + longest.max_tokens <= SHORT_PROMPT_TOKENS:
            return _Shape(SHORT_PROMPT_SLOTS, SHORT_PROMPT_TOKENS)
        if tokens + longest.max_tokens > self.context_length:
            raise context_error(tokens, longest.max_tokens, self.context_length)
        return _Shape(LONG_PROMPT_SLOTS, self.context_length)

    def _start(self, shape: _Shape) -> Any:
        if self._server is not None and shape == self._shape:
            return self._server
        try:
            import xllamacpp
        except ModuleNotFoundError:
            raise MissingExtraError("xllamacpp", "embedded") from None
        self._server = None  # frees the other shape's memory first
        params = xllamacpp.CommonParams()
        params.model.path = str(self._path)
        params.n_parallel = shape.slots
        # One memory for all slots suits a few long answers to one prompt, which share it; many short prompts are
        # quicker apart, because attention then only looks at a slot's own tokens.
        params.kv_unified = shape.slots == LONG_PROMPT_SLOTS
        params.n_ctx = shape.tokens if params.kv_unified else shape.tokens * shape.slots
        params.cache_ram_mib = PROMPT_CACHE_MIB
        params.cpuparams.n_threads = params.cpuparams_batch.n_threads = os.cpu_count() or 1
        params.fit_params = False
        params.warmup = False
        params.verbosity = 0
        try:
            self._server = xllamacpp.Server(params)
        except (RuntimeError, ValueError) as error:
            raise ModelError(f"llama.cpp cannot load {self._path} ({error}); is the file whole?") from None
        self._shape = shape
        return self._server


def _complete(
    server: Any, query: Query, count: int, temperature: float, seed: int, deadline: float
) -> list[Answer]:
    """``count`` answers to one query in one request; stopped, with none, when the deadline passes."""
    pieces: list[list[str]] = [[] for _ in range(count)]
    cost = {"prompt_tokens": 0, "cached_tokens": 0}
    failure: list[str] = []
    start = time.monotonic()

    def receive(chunk: Any) -> bool:
        if "error" in chunk or "code" in chunk:
            failure.append(str(chunk.get("error", chunk).get("message", chunk)))
            return True
        for choice in chunk.get("choices", ()):
            if choice["text"]:
                pieces[choice["index"]].append(choice["text"])
        if usage := chunk.get("usage"):
            cost["prompt_tokens"] = usage["prompt_tokens"]
            cost["cached_tokens"] = usage.get("prompt_tokens_details", {}).get("cached_tokens", 0)
        return time.monotonic() > deadline

    request: dict[str, Any] = {
        "prompt": query.text,
        "n": count,
        "max_tokens": query.max_tokens,
        "temperature": temperature,
        "seed": seed,
        "cache_prompt": True,
        "stream": True,
        "stream_options": {"include_usage": True},
    }
    if query.grammar is not None:
        request["grammar"] = query.grammar
    if query.stop:
        request["stop"] = list(query.stop)
    server.handle_completions(request, receive)
    if failure:
        raise ModelError(f"llama.cpp refused the prompt: {failure[0]}")
    seconds = time.monotonic() - start
    if time.monotonic() > deadline:
        return []
    return [
        Answer(
            "".join(parts),
            prompt_tokens=cost["prompt_tokens"] if index == 0 else 0,  # read once for all
            cached_tokens=cost["cached_tokens"] if index == 0 else 0,
            completion_tokens=len(parts),
            seconds=seconds,
        )
        for index, parts in enumerate(pieces)
    ]


def _seed(seed: int, query_index: int, attempt: int, index: int) -> int:
    # llama.cpp adds the choice's number to the seed of the request, so neighbouring seeds must stay apart.
    return (seed * 1_000_003 + query_index * 10_007 + attempt * 101_009 + index) % 2**31
