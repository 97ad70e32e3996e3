"""Differences of servers within OpenAI's protocol: the facts that they report, and the form of requests."""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from typing import Any, Literal
from urllib.parse import quote, urlsplit

from robust_instant_policy.llm.reply import as_map, as_text, token_count
from robust_instant_policy.llm.transport import RefusedError
from robust_instant_policy.query import Query

CHAT_MARGINS = (64, 2048, 8192)  # tokens beside the numbers: for a few words, then for more and more reasoning
OPTIONAL_FIELDS = ("seed", "stop", "temperature")  # omitted if a server refuses them

# The field that holds answers to the query's form, by kind of server. Sources: README of llama.cpp's server;
# vLLM, Structured Outputs (0.12 and later); SGLang, Structured Outputs.
_CONSTRAINTS = {"llamacpp": "grammar", "vllm": "structured_outputs", "sglang": "regex"}

Style = Literal["chat", "completions"]


@dataclass(frozen=True)
class Server:
    """Facts that a server reports: ``kind`` ("" if unknown), context in tokens, whether the model has a chat template
    (None if unknown)."""

    kind: str = ""
    context_length: int | None = None
    chats: bool | None = None

    @property
    def counts_tokens(self) -> bool:
        return self.kind in ("llamacpp", "vllm")


Tell = Callable[..., Awaitable[object]]  # address, body -> the server's reply, None when it knows no such address


async def discover(tell: Tell, url: str, model: str) -> Server:
    """Ask the server at ``url`` about itself and ``model``. Raises `UnavailableError` when it cannot be asked now."""
    if (urlsplit(url).hostname or "").endswith("api.openai.com"):
        return Server("openai", chats=True)
    models = as_map(await tell(url + "/models")).get("data")
    entry = _entry(models, model)
    meta = as_map(entry.get("meta"))
    lengths = map(token_count, (entry.get("max_model_len"), meta.get("n_ctx"), meta.get("n_ctx_train")))
    length = next((number for number in lengths if number), None)
    owner = entry.get("owned_by")
    root = url.removesuffix("/v1")
    if owner == "llamacpp":
        template = as_text(as_map(await tell(root + "/props")).get("chat_template"))
        chats = bool(template)
        if "<|im_start|>" in template:
            # ChatML stands in for a missing template; a model that was trained with it has a token for its mark.
            body = {"content": "<|im_start|>", "add_special": False, "parse_special": True}
            tokens = as_map(await tell(root + "/tokenize", body)).get("tokens")
            chats = isinstance(tokens, list) and len(tokens) == 1
        return Server(owner, length, chats)
    if owner in ("vllm", "sglang"):  # they refuse to chat with a model that has no template
        return Server(owner, length)
    if owner == "organization_owner":
        about = as_map(await tell(f"{root}/api/v0/models/{quote(model)}"))
        return Server("lmstudio", token_count(about.get("loaded_context_length")) or length, True)
    if models:
        about = as_map(await tell(root + "/api/show", {"model": model}))
        if isinstance(about.get("template"), str):
            limit = re.search(r"^num_ctx\s+(\d{1,9})$", as_text(about.get("parameters")), re.MULTILINE)
            is_plain = re.sub(r"\s", "", about["template"]) in ("", "{{.Prompt}}")
            return Server("ollama", int(limit[1]) if limit else None, not is_plain)
    return Server("", length)


def _entry(models: object, model: str) -> dict[str, Any]:
    """The model's entry in the list of models, or the only one."""
    entries = [entry for entry in models if isinstance(entry, dict)] if isinstance(models, list) else []
    return next((entry for entry in entries if entry.get("id") == model), entries[0] if len(entries) == 1 else {})


@dataclass(frozen=True)
class Dialect:
    """The form of requests to one server, as far as it is known. Each refusal narrows it, so adapting ends.

    ``fixed``: the user chose the style. ``margin`` indexes `CHAT_MARGINS`.
    """

    style: Style
    fixed: bool = False
    constraint: str | None = None
    length_field: str | None = "max_tokens"
    left_out: frozenset[str] = frozenset()
    several: bool = True
    margin: int = 0
    tried: frozenset[Style] = frozenset()

    @classmethod
    def first(cls, server: Server, style: Style | None) -> Dialect:
        chosen: Style = style or ("completions" if server.chats is False else "chat")
        return cls(chosen, style is not None, _CONSTRAINTS.get(server.kind))

    @property
    def path(self) -> str:
        return "/chat/completions" if self.style == "chat" else "/completions"

    @property
    def margin_tokens(self) -> int:
        return CHAT_MARGINS[self.margin] if self.style == "chat" or self.margin else 0

    def body(self, model: str, query: Query, count: int, temperature: float, seed: int) -> dict[str, Any]:
        """The request for ``count`` answers."""
        body: dict[str, Any] = {"model": model, "temperature": temperature, "seed": seed}
        if self.style == "chat":
            system = [] if query.instruction is None else [{"role": "system", "content": query.instruction}]
            body["messages"] = [*system, {"role": "user", "content": query.text}]
        else:
            body["prompt"] = query.text
            if query.stop and not self.margin:  # a chat or reasoning model may begin with other lines
                body["stop"] = list(query.stop)
        if count > 1:
            body["n"] = count
        if self.length_field is not None:
            body[self.length_field] = query.max_tokens + self.margin_tokens
        form = query.grammar if self.constraint == "grammar" else query.pattern
        if self.constraint is not None and form is not None:
            body[self.constraint] = {"regex": form} if self.constraint == "structured_outputs" else form
        return {name: value for name, value in body.items() if name not in self.left_out}

    def adapted(self, refusal: RefusedError, body: dict[str, Any]) -> Dialect | None:
        """The dialect to use after ``refusal`` of ``body``; None if nothing is left to change."""
        complaint, words = refusal.complaint, refusal.complaint.message.lower()
        is_model_unknown = "model" in words and re.search(r"not found|not exist|no such|unknown|pull", words)
        if (refusal.status in (404, 405) and not is_model_unknown) or re.search(
            r"chat template|not a chat model|this is a chat model", words
        ):
            return self._other_style()
        if "max_tokens" in body and (complaint.names("max_tokens") or complaint.names("max_completion_tokens")):
            if self.style == "chat":
                return replace(self, length_field="max_completion_tokens")
            # Text completions have no such field.
            return self._other_style() if complaint.names("max_completion_tokens") else replace(self, length_field=None)
        if "n" in body and complaint.names("n"):
            return replace(self, several=False)
        for name in OPTIONAL_FIELDS:
            if name in body and complaint.names(name):
                return replace(self, left_out=self.left_out | {name})
        if self.constraint in body:
            return replace(self, constraint=None)
        return None

    def _other_style(self) -> Dialect | None:
        other: Style = "completions" if self.style == "chat" else "chat"
        if self.fixed or other in self.tried:
            return None
        return replace(self, style=other, tried=self.tried | {self.style})

    def with_more_room(self) -> Dialect | None:
        """More tokens for reasoning; None at the largest margin."""
        return replace(self, margin=self.margin + 1) if self.margin + 1 < len(CHAT_MARGINS) else None
