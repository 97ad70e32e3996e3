"""What servers that speak OpenAI's protocol do beyond it: constrained answers, token counts, context lengths."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from robust_instant_policy.query import Query

# Names of models that are made to be talked to rather than to continue text.
_CHAT_MODEL = re.compile(r"instruct|chat|assistant|[-_:]it\b|^gpt-|^o\d|^claude|^gemini", re.IGNORECASE)

# Ollama and LM Studio put a model's own template around a completion's prompt, so they are talked to.
_TEMPLATE_OWNERS = ("library", "organization_owner")

# Context lengths in tokens that OpenAI documents but its protocol does not tell, by the beginning of the name.
_OPENAI_CONTEXT = (("gpt-4.1", 1_047_576), ("gpt-4o", 128_000), ("gpt-4-turbo", 128_000), ("gpt-3.5-turbo", 16_385))


@dataclass(frozen=True)
class ServerFacts:
    """``owner`` is the server's kind as it calls itself in its list of models, empty when it says nothing."""

    owner: str = ""
    context_length: int | None = None

    @classmethod
    def from_models(cls, reply: object, model: str) -> ServerFacts:
        """From the answer to ``GET /models``; one that makes no sense says nothing."""
        entries = reply.get("data") if isinstance(reply, dict) else None
        entries = [entry for entry in entries if isinstance(entry, dict)] if isinstance(entries, list) else []
        own = next((entry for entry in entries if entry.get("id") == model), entries[0] if len(entries) == 1 else {})
        meta = own.get("meta")
        meta = meta if isinstance(meta, dict) else {}
        lengths = (own.get("max_model_len"), meta.get("n_ctx"), meta.get("n_ctx_train"))
        known = (length for name, length in _OPENAI_CONTEXT if model.startswith(name))
        length = next((length for length in lengths if isinstance(length, int) and length > 0), next(known, None))
        return cls(str(own.get("owned_by", "")), length)

    @property
    def is_llama_cpp(self) -> bool:
        return self.owner == "llamacpp"

    @property
    def counts_tokens(self) -> bool:
        return self.owner in ("llamacpp", "vllm")

    def prefers_chat(self, model: str) -> bool:
        return bool(_CHAT_MODEL.search(model)) or self.owner in _TEMPLATE_OWNERS

    def constraint(self, query: Query) -> dict[str, Any]:
        """Fields that hold the server to the query's well-formed answers; empty where it has none.

        Sources: the README of llama.cpp's server; vLLM, Structured Outputs (0.12 and later); SGLang, Structured
        Outputs.
        """
        if self.is_llama_cpp and query.grammar is not None:
            return {"grammar": query.grammar}
        if self.owner == "vllm" and query.pattern is not None:
            return {"structured_outputs": {"regex": query.pattern}}
        if self.owner == "sglang" and query.pattern is not None:
            return {"regex": query.pattern}
        return {}

    def tokenize_body(self, model: str, text: str) -> dict[str, Any]:
        if self.is_llama_cpp:
            return {"content": text, "add_special": True}
        return {"model": model, "prompt": text}

    def tokenize_count(self, reply: object) -> int | None:
        """The number of tokens in a reply to ``POST /tokenize``."""
        tokens = reply.get("tokens") if isinstance(reply, dict) else None
        return len(tokens) if isinstance(tokens, list) else None
