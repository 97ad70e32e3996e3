"""One line of text says which language model to use."""

from __future__ import annotations

from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from robust_instant_policy.errors import UsageError
from robust_instant_policy.llm.model import LanguageModel

FORMS = "'embedded', 'gguf:PATH', 'openai:MODEL', 'http://HOST:PORT/v1#MODEL'"
OPENAI_URL = "https://api.openai.com/v1"
STYLES: tuple[Literal["chat", "completions"], ...] = ("chat", "completions")


def connect(spec: str) -> LanguageModel:
    """The language model that ``spec`` names.

    ``"embedded"`` is Gemma 3 270M inside this process; ``"gguf:PATH"`` any model file of llama.cpp, likewise;
    ``"openai:gpt-4o"`` OpenAI by model name, with the key from the environment variable ``OPENAI_API_KEY``;
    ``"http://host:port/v1#model"`` any server that speaks OpenAI's protocol. ``chat+http://…`` or
    ``completions+http://…`` forces one of the protocol's two ways to ask, where the choice made for the model does
    not suit it.

    Raises `UsageError` for anything else, `ModelError` when the model cannot be loaded.
    """
    kind, _, rest = spec.partition(":")
    if spec == "embedded":
        from robust_instant_policy.llm.gemma import load_embedded

        return load_embedded()
    if kind == "gguf" and rest:
        from robust_instant_policy.llm.llama import LlamaModel

        return LlamaModel(Path(rest).expanduser())
    if kind == "openai" and rest:
        from robust_instant_policy.llm.endpoint import Endpoint

        return Endpoint(OPENAI_URL, rest, style="chat")
    forced = next((style for style in STYLES if spec.startswith(style + "+")), None)
    address = spec if forced is None else spec.removeprefix(forced + "+")
    if address.startswith(("http://", "https://")):
        from robust_instant_policy.llm.endpoint import Endpoint

        url, _, model = address.partition("#")
        if urlsplit(url).username is not None:
            raise UsageError("a key does not belong into the address; put it into the variable OPENAI_API_KEY")
        if not urlsplit(url).hostname or not model:
            raise UsageError("an address needs its model behind a #, as in http://localhost:8000/v1#my-model")
        return Endpoint(url, model, style=forced)
    raise UsageError(f"unknown language model {spec!r}; known forms: {FORMS}")
