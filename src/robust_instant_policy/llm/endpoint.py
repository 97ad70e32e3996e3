"""Any server that speaks OpenAI's protocol: OpenAI itself, vLLM, SGLang, llama.cpp, Ollama, LM Studio."""

import asyncio
import contextlib
import random
import re
import time
from collections.abc import Coroutine, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any, TypeVar

from robust_instant_policy.errors import ModelError, RipError
from robust_instant_policy.llm.dialect import Dialect, Server, Style, discover
from robust_instant_policy.llm.model import (
    NOBODY,
    Listener,
    Sampling,
    Tally,
    context_error,
    estimate_tokens,
    sample_seed,
)
from robust_instant_policy.llm.reply import Reply, UnreadableReplyError, as_map, read_reply
from robust_instant_policy.llm.transport import Connection, RefusedError, UnavailableError
from robust_instant_policy.query import Answer, Query

PATIENCE = 0.5  # share of the remaining time that one request may take, so that a hanging one can be repeated
HEAD_START = 0.25  # share of the time for which the first request goes alone, so that refusals are met once
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 8.0  # between repeats; doubles from the first to the longest
MAX_UNREACHABLE = 6  # refused connections in a row after which the server counts as absent, about 8 s
MAX_BROKEN = 3  # failures of one request inside a server that has answered nothing, after which it is given up
MAX_EMPTY = 3  # replies without text before any answer was accepted, after which the model is given up
FACTS_TIME_S = 10.0  # at most, for asking the server about itself
MAX_CONCURRENT = 32  # requests under way at a time
# If a reply counts fewer prompt tokens than this share of the estimate, the server cut the prompt. Tokenizers with a
# token for " 12" need half of the estimate, all others more.
TRUNCATED_SHARE = 0.45
MIN_TOKENS_TO_COMPARE = 200  # below this the estimate is too coarse
CHECK_TIME_S = 10.0  # at most, for `Endpoint.check`; a server may be loading its model
SHORT = Query("1 2 3", max_tokens=1)  # the request of `Endpoint.check`

Result = TypeVar("Result")


class Endpoint:
    """The model ``model`` of the server at ``url`` (with its ``/v1``).

    ``style`` is how it is asked; with None the server is asked which one suits, and the other is tried when it refuses.
    The key is read from the environment at each use and sent only to ``url`` (see `transport`).
    """

    def __init__(self, url: str, model: str, style: Style | None = None):
        self.name = model
        self.url = url.rstrip("/")
        self._style = style
        self._told: dict[str, object] = {}  # replies to questions about the server
        self._server: Server | None = None
        self.dialect = Dialect.first(Server(), style)  # how the server is asked, as far as is known
        self.is_known = False  # an answer has come in the present dialect

    @property
    def context_length(self) -> int | None:
        return _run(self._facts()).context_length

    def count_tokens(self, text: str) -> int:
        async def count() -> int:
            async with contextlib.aclosing(self.connection()) as connection:
                return await self.count(connection, await self.learn(connection), text)

        return _run(count())

    def sample(self, queries: Sequence[Query], sampling: Sampling, listener: Listener = NOBODY) -> list[list[Answer]]:
        """See `LanguageModel.sample`."""
        tally = Tally(len(queries), sampling, listener)
        if queries and sampling.n > 0:
            _run(_Plan(self, queries, tally, sampling).carry_out())
        return tally.answers()

    def check(self) -> None:
        """One short request. Raises `ModelError` where nothing listens at the address, the key, the address or the
        model is refused, or the request fails inside the server `MAX_BROKEN` times; a slow or busy server passes."""

        async def ask() -> None:
            async with contextlib.aclosing(self.connection()) as connection:
                await self.learn(connection, CHECK_TIME_S)
                broken = 0
                while True:
                    try:
                        if await self.ask(connection, SHORT, 1, 0.0, 0, CHECK_TIME_S) is not None:
                            return
                    except UnavailableError as failure:
                        if failure.absent:
                            raise self.absent(failure) from None
                        if not failure.broken:
                            return
                        broken += 1
                        if broken == MAX_BROKEN:
                            raise self.broken(failure) from None
                        await asyncio.sleep(FIRST_PAUSE_S)

        _run(ask())

    def close(self) -> None:
        """Nothing is held between plans."""

    def connection(self) -> Connection:
        return Connection(self.url, has_answered=bool(self._told))

    async def _facts(self) -> Server:
        async with contextlib.aclosing(self.connection()) as connection:
            return await self.learn(connection)

    async def learn(self, connection: Connection, time_s: float = FACTS_TIME_S) -> Server:
        """Facts that the server reports within ``time_s``; missing ones are requested again the next time."""
        if self._server is not None:
            return self._server
        end = time.monotonic() + min(time_s, FACTS_TIME_S)

        async def tell(address: str, body: dict[str, Any] | None = None) -> object:
            if address not in self._told:
                try:
                    rest = max(end - time.monotonic(), 0.1)
                    self._told[address] = await connection.request(address, body, rest * PATIENCE)
                except RefusedError:
                    self._told[address] = None
            return self._told[address]

        broken = 0
        while self._server is None:
            try:
                self._server = await discover(tell, self.url, self.name)
            except UnavailableError as failure:
                broken += failure.broken
                if failure.absent or broken >= MAX_BROKEN or time.monotonic() + FIRST_PAUSE_S > end:
                    break
                await asyncio.sleep(FIRST_PAUSE_S)
            else:
                self.dialect = Dialect.first(self._server, self._style)
        return self._server or Server()

    async def count(self, connection: Connection, server: Server, text: str) -> int:
        """The server's count of tokens, an estimate if it cannot count."""
        if server.counts_tokens:
            is_llama = server.kind == "llamacpp"
            body = {"content": text, "add_special": True} if is_llama else {"model": self.name, "prompt": text}
            with contextlib.suppress(UnavailableError, RefusedError):
                reply = await connection.request(self.url.removesuffix("/v1") + "/tokenize", body)
                if isinstance(tokens := as_map(reply).get("tokens"), list):
                    return len(tokens)
        return estimate_tokens(text)

    async def refuse_long(self, connection: Connection, server: Server, queries: Sequence[Query]) -> None:
        """Raise `ModelError` for prompts that do not fit into the context, before they are sent."""
        length = server.context_length
        longest = max(queries, key=lambda query: len(query.text) + query.max_tokens)
        if length is None or len(longest.text) + longest.max_tokens < length:  # a token is a character at least
            return
        tokens = await self.count(connection, server, longest.text)
        if tokens + longest.max_tokens > length:
            raise context_error(tokens, longest.max_tokens, length, server.counts_tokens)

    async def ask(
        self, connection: Connection, query: Query, count: int, temperature: float, seed: int, timeout_s: float
    ) -> Reply | None:
        """One request for ``count`` answers; None if the dialect has changed and the request must be made again.

        Servers that do not support ``n`` return fewer. Raises `UnavailableError`, and `ModelError` for a request that
        cannot succeed.
        """
        used = self.dialect
        body = used.body(self.name, query, count, temperature, seed)
        start = time.monotonic()
        try:
            content = await connection.request(self.url + used.path, body, timeout_s)
            # llama.cpp counts the tokens of the first answer only.
            counts_all = count == 1 or self._server is None or self._server.kind != "llamacpp"
            reply = read_reply(content, count, time.monotonic() - start, counts_all)
        except RefusedError as refusal:
            self._adapt(used, refusal, body)
            return None
        except UnreadableReplyError as error:
            raise UnavailableError(f"its reply could not be read ({error})", broken=True) from None
        self._refuse_truncated(query, reply.answers[0].prompt_tokens)
        if len(reply.answers) < count and self.dialect == used:
            self.dialect = replace(used, several=False)
        return reply

    def make_room(self, used: Dialect, answer: Answer) -> None:
        """Allow more tokens after ``answer`` was cut off; raises `ModelError` at the largest margin."""
        if self.dialect != used:
            return
        changed = used.with_more_room()
        if changed is None:
            raise ModelError(
                f"{self.name} at {self.url} used up {used.margin_tokens} tokens without giving an answer "
                f"({answer.fault}); switch off or shorten its reasoning in the server, or use another model"
            )
        self.dialect = changed

    def _adapt(self, used: Dialect, refusal: RefusedError, body: dict[str, Any]) -> None:
        """Change the dialect after a refusal, or raise `ModelError`.

        If another request has changed the dialect in the meantime, the refusal is out of date.
        """
        words = refusal.complaint.message
        if "context" in words.lower() and re.search(r"exceed|maximum|too long|length", words, re.IGNORECASE):
            raise ModelError(
                f"the prompt does not fit into the context of {self.name}; use fewer demonstrations or steps, "
                "or layout='factorised'"
            )
        if self.dialect != used:
            return
        changed = used.adapted(refusal, body)
        if changed is None:
            advice = "; does the address end in /v1?" if used.tried and refusal.status in (404, 405) else ""
            raise ModelError(f"{self.url} refused the request for {self.name}: {words}{advice}")
        self.dialect = changed

    def absent(self, failure: UnavailableError) -> ModelError:
        return ModelError(f"nothing answers at {self.url} ({failure}); is the server running, and the address right?")

    def broken(self, failure: UnavailableError) -> ModelError:
        return ModelError(
            f"{self.name} at {self.url} failed {MAX_BROKEN} times and answered nothing: {failure}; is it the address "
            "of the API, and what does the server's log say?"
        )

    def silent(self, answer: Answer) -> ModelError:
        fault = f" ({answer.fault})" if answer.fault else ""
        return ModelError(
            f"{self.name} at {self.url} gave {MAX_EMPTY} replies without text{fault} and no answer; is it a model for "
            "text, and what does the server's log say?"
        )

    def _refuse_truncated(self, query: Query, read: int) -> None:
        sent = estimate_tokens(query.text)
        if sent >= MIN_TOKENS_TO_COMPARE and 0 < read < TRUNCATED_SHARE * sent:
            raise ModelError(
                f"{self.name} at {self.url} read only {read} of about {sent} tokens of the prompt; raise the server's "
                "context (Ollama: OLLAMA_CONTEXT_LENGTH or num_ctx), or use fewer demonstrations or layout='factorised'"
            )


class _Plan:
    """All answers of one call of `Endpoint.sample`, under one deadline."""

    def __init__(self, endpoint: Endpoint, queries: Sequence[Query], tally: Tally, sampling: Sampling):
        self._endpoint, self._queries, self._tally, self._sampling = endpoint, queries, tally, sampling
        self._deadline = time.monotonic() + sampling.deadline_s
        self._room = asyncio.Semaphore(MAX_CONCURRENT)
        self._opened = asyncio.Event()  # the first request has met the server
        self._unreachable = self._empty = 0
        self._last_failure = "nothing came back"

    async def carry_out(self) -> None:
        failure: RipError | None = None
        try:
            async with (
                asyncio.timeout(self._sampling.deadline_s),
                contextlib.aclosing(self._endpoint.connection()) as connection,
            ):
                server = await self._endpoint.learn(connection, HEAD_START * self._sampling.deadline_s)
                await self._endpoint.refuse_long(connection, server, self._queries)
                try:
                    async with asyncio.TaskGroup() as group:
                        group.create_task(self._fill(connection, 0))
                        if not self._endpoint.is_known:
                            with contextlib.suppress(TimeoutError):
                                await asyncio.wait_for(self._opened.wait(), HEAD_START * self._sampling.deadline_s)
                        self._opened.set()
                        for index in range(1, len(self._queries)):
                            group.create_task(self._fill(connection, index))
                except* RipError as errors:
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

    async def _fill(self, connection: Connection, index: int) -> None:
        """Ask until the query has all its answers."""
        while missing := self._tally.missing(index):
            if self._endpoint.dialect.several:
                await self._ask(connection, index, missing)
            elif not self._opened.is_set():
                await self._ask(connection, index, missing[:1])
            else:
                async with asyncio.TaskGroup() as group:
                    for sample in missing:
                        group.create_task(self._ask(connection, index, [sample]))

    async def _ask(self, connection: Connection, index: int, samples: list[int]) -> None:
        """One request, repeated with growing pauses until something comes back."""
        pause, broken = FIRST_PAUSE_S, 0
        while True:
            try:
                async with self._room:
                    used = self._endpoint.dialect
                    if len(samples) > 1 and not used.several:
                        return
                    reply = await self._endpoint.ask(
                        connection,
                        self._queries[index],
                        len(samples),
                        self._sampling.temperature,
                        sample_seed(self._sampling.seed, samples[0], self._tally.attempt(index, samples[0])),
                        max(PATIENCE * (self._deadline - time.monotonic()), 0.1),
                    )
                self._unreachable = 0
                if reply is None:
                    continue
                for sample, answer in zip(samples, reply.answers, strict=False):
                    self._tally.add(index, sample, answer)
                if reply.ran_out and (reply.thought or used.style == "chat") and not self._tally.has_accepted:
                    self._endpoint.make_room(used, reply.answers[0])
                elif not any(answer.text for answer in reply.answers) and not self._tally.has_accepted:
                    self._empty += 1
                    if self._empty == MAX_EMPTY:
                        raise self._endpoint.silent(reply.answers[0])
                else:
                    self._endpoint.is_known = True
                    self._opened.set()
                return
            except UnavailableError as failure:
                self._last_failure = str(failure)
                self._unreachable = self._unreachable + 1 if failure.absent else 0
                if self._unreachable >= MAX_UNREACHABLE:
                    raise self._endpoint.absent(failure) from None
                broken += failure.broken
                if broken >= MAX_BROKEN and self._tally.is_empty:
                    raise self._endpoint.broken(failure) from None
                # The pause is a lower bound, also if the server asks for a shorter one.
                await asyncio.sleep(max(failure.wait_s, pause * random.uniform(0.5, 1.0)))
                pause = min(2 * pause, LONGEST_PAUSE_S)


def _first(errors: BaseExceptionGroup[RipError]) -> RipError:
    """The first error in a group of errors, which may be nested."""
    first = errors.exceptions[0]
    return _first(first) if isinstance(first, BaseExceptionGroup) else first


def _run(work: Coroutine[Any, Any, Result]) -> Result:
    """Run ``work``, also if an event loop is running already (a notebook)."""
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return asyncio.run(work)
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, work).result()
