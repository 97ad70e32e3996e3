"""One line of text says which language model to use."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from robust_instant_policy.errors import UsageError
from robust_instant_policy.llm.model import LanguageModel

FORMS = "'embedded', 'gguf:PATH', 'openai:MODEL', 'http://HOST:PORT/v1#MODEL'"
OPENAI_URL = "https://api.openai.com/v1"
EMBEDDED_NAME = "gemma-3-270m-q4_k_m-numbers"

Style = Literal["chat", "completions"]
STYLES: tuple[Style, ...] = ("chat", "completions")


def connect(spec: str) -> LanguageModel:
    """The language model that ``spec`` names.

    ``"embedded"`` is Gemma 3 270M inside this process; ``"gguf:PATH"`` any model file of llama.cpp, likewise;
    ``"openai:gpt-4o"`` OpenAI by model name, with the key from the environment variable ``OPENAI_API_KEY``;
    ``"http://host:port/v1#model"`` any server that speaks OpenAI's protocol. ``chat+http://…`` or
    ``completions+http://…`` forces one of the protocol's two ways to ask, where the choice made for the model does
    not suit it.

    Raises `UsageError` for anything else, `ModelError` when the model cannot be loaded.
    """
    return _parse(spec)[1]()


def model_name(spec: str) -> str:
    """The name under which a store keeps the answers of the model that ``spec`` names, without loading the model.

    A model file is named by its name and its content; one that is not there, by its name alone, which is enough to
    replay its answers.
    """
    return _parse(spec)[0]


def _parse(spec: str) -> tuple[str, Callable[[], LanguageModel]]:
    """The model's name, and what makes it. The imports wait until then: they take longer than all the rest."""
    kind, _, rest = spec.partition(":")
    if spec == "embedded":
        return EMBEDDED_NAME, _embedded
    if kind == "gguf" and rest:
        path = Path(rest).expanduser()
        return _file_name(path), lambda: _gguf(path)
    if kind == "openai" and rest:
        return rest, lambda: _endpoint(OPENAI_URL, rest, "chat")
    forced = next((style for style in STYLES if spec.startswith(style + "+")), None)
    address = spec if forced is None else spec.removeprefix(forced + "+")
    if address.startswith(("http://", "https://")):
        url, _, model = address.partition("#")
        if urlsplit(url).username is not None:
            raise UsageError("a key does not belong into the address; put it into the variable OPENAI_API_KEY")
        if not urlsplit(url).hostname or not model:
            raise UsageError("an address needs its model behind a #, as in http://localhost:8000/v1#my-model")
        return model, lambda: _endpoint(url, model, forced)
    raise UsageError(f"unknown language model {spec!r}; known forms: {FORMS}")


def _file_name(path: Path) -> str:
    from robust_instant_policy.llm.gguf import fingerprint

    return f"{path.stem}@{fingerprint(path)}" if path.is_file() else path.stem


def _embedded() -> LanguageModel:
    from robust_instant_policy.llm.gemma import load_embedded

    return load_embedded()


def _gguf(path: Path) -> LanguageModel:
    from robust_instant_policy.llm.llama import LlamaModel

    return LlamaModel(path, _file_name(path))


def _endpoint(url: str, model: str, style: Style | None) -> LanguageModel:
    from robust_instant_policy.llm.endpoint import Endpoint

    return Endpoint(url, model, style)
