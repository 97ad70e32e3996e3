"""Any server that speaks OpenAI's protocol: OpenAI itself, vLLM, SGLang, llama.cpp, Ollama, LM Studio."""

from __future__ import annotations

import asyncio
import os
import random
import re
import time
import urllib.parse
import urllib.request
from collections.abc import AsyncIterator, Coroutine, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any, Literal, TypeVar

import httpx2
import openai
from openai.types import Completion
from openai.types.chat import ChatCompletion

from robust_instant_policy.errors import ModelError
from robust_instant_policy.llm.dialect import ServerFacts
from robust_instant_policy.llm.model import NOBODY, Listener, Sampling, Tally, context_error, estimate_tokens
from robust_instant_policy.query import Answer, Query

KEY_VARIABLE = "OPENAI_API_KEY"
CONNECT_TIMEOUT_S = 5.0
FACTS_TIMEOUT_S = 5.0  # for what is asked besides the plan itself
PATIENCE = 0.5  # share of the remaining time that one request may take, so that a hanging one can be repeated
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 8.0  # between repeats; doubles from the first to the longest
MAX_UNREACHABLE = 6  # refused connections in a row after which the server counts as absent, about 8 s
MAX_REPLY_BYTES = 8 << 20
MAX_CONCURRENT = 32  # requests under way at a time
CHAT_MARGIN_TOKENS = 64  # for the words that chat models put around numbers

Style = Literal["chat", "completions"]
Result = TypeVar("Result")

_OPTIONAL_FIELDS = ("seed", "stop", "temperature")  # left out when a model does not take them


class Endpoint:
    """The model ``model`` of the server at ``url`` (with its ``/v1``).

    ``style`` is how it is asked; None chooses by the model's name and by what the server offers. The key is read
    from ``OPENAI_API_KEY`` at each use, sent only to ``url``, and kept nowhere.
    """

    def __init__(self, url: str, model: str, style: Style | None = None):
        self.name = model
        self.url = url.rstrip("/")
        self._style: Style | None = style
        self._facts: ServerFacts | None = None
        self._honours_n = True
        self._left_out: set[str] = set()
        self._length_field = "max_tokens"

    @property
    def context_length(self) -> int | None:
        return _run(self._learned()).context_length

    @property
    def counts_exactly(self) -> bool:
        return _run(self._learned()).counts_tokens

    def count_tokens(self, text: str) -> int:
        return _run(self._counted(text))

    def sample(self, queries: Sequence[Query], sampling: Sampling, listener: Listener = NOBODY) -> list[list[Answer]]:
        """See `LanguageModel.sample`."""
        tally = Tally(len(queries), sampling, listener)
        if queries and sampling.n > 0:
            _run(_Plan(self, queries, tally, sampling).carry_out())
        return tally.answers()

    def close(self) -> None:
        """Nothing is held between plans."""

    def client(self) -> openai.AsyncOpenAI:
        """A client that repeats nothing by itself and never takes in more than `MAX_REPLY_BYTES`."""
        try:
            transport = _BoundedTransport(proxy=_proxy(self.url))
        except (ImportError, ValueError):  # its words may hold a password
            raise ModelError(
                f"the proxy that the environment names for {self.url} cannot be used; give it as http://host:port, or "
                "put the server into no_proxy"
            ) from None
        return openai.AsyncOpenAI(
            base_url=self.url,
            api_key=_key() or "none",
            max_retries=0,
            http_client=httpx2.AsyncClient(transport=transport, headers={"Accept-Encoding": "identity"}),
        )

    async def facts(self, client: openai.AsyncOpenAI) -> ServerFacts:
        """What the server says of itself; one that says nothing is asked as plainly as OpenAI is."""
        if self._facts is None:
            try:
                reply = await client.get("/models", cast_to=object, options={"timeout": FACTS_TIMEOUT_S})
            except openai.APIConnectionError:
                return ServerFacts()  # perhaps it answers the next time
            except (openai.OpenAIError, ValueError):
                reply = None
            self._facts = ServerFacts.from_models(reply, self.name)
        return self._facts

    async def count(self, client: openai.AsyncOpenAI, text: str) -> int:
        facts = await self.facts(client)
        if facts.counts_tokens:
            address = self.url.removesuffix("/v1") + "/tokenize"
            body = facts.tokenize_body(self.name, text)
            try:
                reply = await client.post(address, body=body, cast_to=object, options={"timeout": FACTS_TIMEOUT_S})
            except (openai.OpenAIError, ValueError):
                reply = None
            count = facts.tokenize_count(reply)
            if count is not None:
                return count
        return estimate_tokens(text)

    async def ask(
        self, client: openai.AsyncOpenAI, query: Query, count: int, temperature: float, seed: int, timeout_s: float
    ) -> list[Answer]:
        """One request for ``count`` answers; fewer come back from servers that do not know ``n``.

        Raises `openai.OpenAIError`, `ValueError` for a reply that makes no sense, and `ModelError` for a request
        that will never succeed.
        """
        facts = await self.facts(client)
        style = self._style or ("chat" if facts.prefers_chat(self.name) else "completions")
        fields: dict[str, Any] = {"model": self.name, "temperature": temperature, "seed": seed}
        if count > 1:
            fields["n"] = count
        if query.stop and style == "completions":  # a chat model may begin with other lines
            fields["stop"] = list(query.stop)
        fields[self._length_field] = query.max_tokens + (CHAT_MARGIN_TOKENS if style == "chat" else 0)
        extra = {} if "constraint" in self._left_out else facts.constraint(query)
        for name in self._left_out & fields.keys():
            del fields[name]
        timeout = httpx2.Timeout(timeout_s, connect=min(CONNECT_TIMEOUT_S, timeout_s))
        start = time.monotonic()
        try:
            if style == "chat":
                messages: list[Any] = [{"role": "user", "content": query.text}]
                if query.instruction is not None:
                    messages.insert(0, {"role": "system", "content": query.instruction})
                reply: Any = await client.chat.completions.create(
                    messages=messages, extra_body=extra, timeout=timeout, **fields
                )
            else:
                reply = await client.completions.create(prompt=query.text, extra_body=extra, timeout=timeout, **fields)
        except (openai.NotFoundError, openai.BadRequestError, openai.UnprocessableEntityError) as error:
            self._adapt(error, style, fields, bool(extra))
            return []
        return await self._answers(client, reply, count, time.monotonic() - start)

    def _adapt(self, error: openai.APIStatusError, style: Style, fields: dict[str, Any], constrained: bool) -> None:
        """Ask differently from now on, in the way the server's complaint suggests, or raise `ModelError`."""
        words = error.message.lower()
        if isinstance(error, openai.NotFoundError):
            if style == "completions" and self._style is None and "model" not in words:
                self._style = "chat"
                return
        elif "context" in words and re.search(r"exceed|maximum|too long|length", words):
            raise ModelError(
                f"the prompt does not fit into the context of {self.name}; use fewer demonstrations or steps, "
                "or layout='factorised'"
            )
        elif "max_completion_tokens" in words and self._length_field == "max_tokens":
            self._length_field = "max_completion_tokens"
            return
        elif "n" in fields and (getattr(error, "param", None) == "n" or re.search(r"['\"`]n['\"`]|\bn\b must", words)):
            self._honours_n = False
            return
        else:
            for name in _OPTIONAL_FIELDS:
                if name in fields and name in words:
                    self._left_out.add(name)
                    return
            if constrained and "constraint" not in self._left_out:
                self._left_out.add("constraint")
                return
        raise ModelError(f"{self.url} refused the request for {self.name}: {scrubbed(error.message)}")

    async def _answers(self, client: openai.AsyncOpenAI, reply: Any, count: int, seconds: float) -> list[Answer]:
        if not isinstance(reply, Completion | ChatCompletion) or not isinstance(reply.choices, list):
            raise ValueError("the reply is not one of OpenAI's protocol")
        texts = []
        for choice in reply.choices[:count]:
            message = getattr(choice, "message", None)
            text = message.content if message is not None else getattr(choice, "text", None)
            texts.append(text if isinstance(text, str) else "")
        if not texts:
            raise ValueError("the reply holds no answer")
        if len(texts) < count:
            self._honours_n = False
        usage = reply.usage
        details = getattr(usage, "prompt_tokens_details", None)
        written = [await self.count(client, text) for text in texts] if len(texts) > 1 else [estimate_tokens(texts[0])]
        if usage is not None and not (self._facts is not None and self._facts.is_llama_cpp and len(texts) > 1):
            # The total is the server's; llama.cpp tells only the first answer's.
            written = _shared_out(usage.completion_tokens or 0, written)
        return [
            Answer(
                text,
                prompt_tokens=(usage.prompt_tokens or 0) if usage is not None and index == 0 else 0,
                cached_tokens=(getattr(details, "cached_tokens", None) or 0) if index == 0 else 0,
                completion_tokens=tokens,
                seconds=seconds,
            )
            for index, (text, tokens) in enumerate(zip(texts, written, strict=True))
        ]

    @property
    def honours_n(self) -> bool:
        """Whether several answers can be had from one request, as far as is known."""
        return self._honours_n

    async def _learned(self) -> ServerFacts:
        async with self.client() as client:
            return await self.facts(client)

    async def _counted(self, text: str) -> int:
        async with self.client() as client:
            return await self.count(client, text)


class _Plan:
    """All answers of one call of `Endpoint.sample`, under one deadline."""

    def __init__(self, endpoint: Endpoint, queries: Sequence[Query], tally: Tally, sampling: Sampling):
        self._endpoint, self._queries, self._tally, self._sampling = endpoint, queries, tally, sampling
        self._deadline = time.monotonic() + sampling.deadline_s
        self._room = asyncio.Semaphore(MAX_CONCURRENT)
        self._unreachable = 0
        self._last_failure = "nothing came back"

    async def carry_out(self) -> None:
        failure: ModelError | None = None
        try:
            async with asyncio.timeout(self._sampling.deadline_s), self._endpoint.client() as client:
                await self._refuse_long(client)
                try:
                    async with asyncio.TaskGroup() as group:
                        for index in range(len(self._queries)):
                            group.create_task(self._fill(client, index))
                except* ModelError as errors:
                    failure = _first(errors)
        except TimeoutError:
            pass
        if failure is not None:
            raise failure from None
        if self._tally.is_empty:
            raise ModelError(
                f"{self._endpoint.name} at {self._endpoint.url} gave no answer within {self._sampling.deadline_s:g} s: "
                f"{self._last_failure}"
            )

    async def _refuse_long(self, client: openai.AsyncOpenAI) -> None:
        facts = await self._endpoint.facts(client)
        length = facts.context_length
        longest = max(self._queries, key=lambda query: len(query.text) + query.max_tokens)
        if length is None or len(longest.text) + longest.max_tokens < length:  # a token is a character at least
            return
        tokens = await self._endpoint.count(client, longest.text)
        if tokens + longest.max_tokens > length:
            raise context_error(tokens, longest.max_tokens, length, facts.counts_tokens)

    async def _fill(self, client: openai.AsyncOpenAI, index: int) -> None:
        """Ask until the query has all its answers."""
        while missing := self._tally.missing(index):
            if self._endpoint.honours_n:
                await self._ask(client, index, missing)
            else:
                async with asyncio.TaskGroup() as group:
                    for sample in missing:
                        group.create_task(self._ask(client, index, [sample]))

    async def _ask(self, client: openai.AsyncOpenAI, index: int, samples: list[int]) -> None:
        """One request, repeated with growing pauses until something comes back."""
        pause = FIRST_PAUSE_S
        while True:
            wait: float | None = None
            try:
                async with self._room:
                    answers = await self._endpoint.ask(
                        client,
                        self._queries[index],
                        len(samples),
                        self._sampling.temperature,
                        _seed(self._sampling.seed, samples[0], self._tally.attempt(index, samples[0])),
                        max(PATIENCE * (self._deadline - time.monotonic()), 0.1),
                    )
                self._unreachable = 0
                for sample, answer in zip(samples, answers, strict=False):
                    self._tally.add(index, sample, answer)
                return
            except openai.APITimeoutError:
                self._last_failure = "it did not answer in time"
            except openai.APIConnectionError as error:
                self._last_failure = f"the connection failed ({scrubbed(str(error.__cause__ or error))})"
                if isinstance(error.__cause__, httpx2.ConnectError):
                    self._unreachable += 1
                    if self._unreachable >= MAX_UNREACHABLE:
                        raise ModelError(
                            f"nothing answers at {self._endpoint.url}; is the server running, and the address right?"
                        ) from None
            except openai.APIStatusError as error:
                if error.status_code not in (408, 409, 429) and error.status_code < 500:
                    raise ModelError(_refusal(self._endpoint, error)) from None
                self._last_failure = f"it answered {error.status_code} ({scrubbed(error.message)})"
                wait = _retry_after(error.response)
            except (openai.OpenAIError, ValueError) as error:
                self._last_failure = f"its reply could not be read ({scrubbed(str(error))})"
            await asyncio.sleep(wait if wait is not None else pause * random.uniform(0.5, 1.0))
            pause = min(2 * pause, LONGEST_PAUSE_S)


class _BoundedTransport(httpx2.AsyncHTTPTransport):
    """Breaks off replies that are larger than any answer, or packed so that their size cannot be told."""

    async def handle_async_request(self, request: httpx2.Request) -> httpx2.Response:
        response = await super().handle_async_request(request)
        if response.headers.get("Content-Encoding", "identity") != "identity":
            await response.aclose()
            raise httpx2.RemoteProtocolError("the reply is compressed although that was not asked for")
        assert isinstance(response.stream, httpx2.AsyncByteStream)
        response.stream = _BoundedStream(response.stream)
        return response


class _BoundedStream(httpx2.AsyncByteStream):
    def __init__(self, stream: httpx2.AsyncByteStream):
        self._stream = stream

    async def __aiter__(self) -> AsyncIterator[bytes]:
        size = 0
        async for chunk in self._stream:
            size += len(chunk)
            if size > MAX_REPLY_BYTES:
                raise httpx2.RemoteProtocolError(f"the reply is longer than {MAX_REPLY_BYTES >> 20} MB")
            yield chunk

    async def aclose(self) -> None:
        await self._stream.aclose()


def scrubbed(words: str, length: int = 200) -> str:
    """A message for the user: one short line, without anything that looks like a key."""
    key = os.environ.get(KEY_VARIABLE, "").strip()
    if key:
        words = words.replace(key, "***")
    words = re.sub(r"\b(sk|key)-[\w*-]{4,}", "***", words)
    words = " ".join(words.split())
    return words if len(words) <= length else words[:length] + "…"


def _key() -> str:
    """The key, without the line break that files and pipes leave behind it; raises `ModelError` where it is none."""
    key = os.environ.get(KEY_VARIABLE, "").strip()
    if not (key.isascii() and key.isprintable()):
        raise ModelError(f"{KEY_VARIABLE} holds characters that no key has; set it to the key alone")
    return key


def _proxy(url: str) -> str | None:
    """The proxy that the environment names for ``url``; none for this machine itself."""
    parts = urllib.parse.urlsplit(url)
    host = parts.hostname or ""
    if host == "localhost" or host.startswith("127.") or host == "::1" or urllib.request.proxy_bypass(host):
        return None
    proxies = urllib.request.getproxies()
    proxy = proxies.get(parts.scheme) or proxies.get("all")
    return f"http://{proxy}" if proxy and "://" not in proxy else proxy


def _first(errors: BaseExceptionGroup[ModelError]) -> ModelError:
    """The first of the errors in a group, however deep groups are nested."""
    first = errors.exceptions[0]
    return _first(first) if isinstance(first, BaseExceptionGroup) else first


def _refusal(endpoint: Endpoint, error: openai.APIStatusError) -> str:
    if error.status_code in (401, 403):
        return f"{endpoint.url} refused the key ({error.status_code}); set {KEY_VARIABLE} to a valid one"
    return f"{endpoint.url} refused the request for {endpoint.name}: {scrubbed(error.message)}"


def _retry_after(response: httpx2.Response) -> float | None:
    try:
        return min(max(float(response.headers["Retry-After"]), 0.0), 60.0)
    except (KeyError, ValueError):
        return None


def _shared_out(total: int, weights: Sequence[int]) -> list[int]:
    """``total`` split in proportion to ``weights``; the parts add up to it."""
    edges = [round(total * sum(weights[:end]) / max(sum(weights), 1)) for end in range(len(weights))] + [total]
    return [stop - start for start, stop in pairwise(edges)]


def _seed(seed: int, sample: int, attempt: int) -> int:
    return (seed * 1_000_003 + attempt * 10_007 + sample) % 2**31


def _run(work: Coroutine[Any, Any, Result]) -> Result:
    """Run to the end, also where an event loop is running already (a notebook)."""
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return asyncio.run(work)
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, work).result()
