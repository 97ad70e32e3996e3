"""A line of text that names a language model, and the model it names."""

from collections.abc import Callable
from pathlib import Path
from typing import cast
from urllib.parse import urlsplit

from robust_instant_policy.errors import ModelError, UsageError
from robust_instant_policy.llm.model import NO_FILE, LanguageModel

FORMS = "'embedded', 'gguf:PATH', 'openai:MODEL', 'http://HOST:PORT/v1#MODEL'"
OPENAI_URL = "https://api.openai.com/v1"


def connect(spec: str) -> LanguageModel:
    """The language model that ``spec`` names.

    - ``"embedded"``: Gemma 3 270M inside this process
    - ``"gguf:PATH"``: any model file of llama.cpp, inside this process
    - ``"openai:gpt-4o"``: OpenAI by model name; the key is read from ``OPENAI_API_KEY``
    - ``"http://host:port/v1#model"``: any server that speaks OpenAI's protocol; a key is read from ``RIP_API_KEY``
    - ``"chat+http://…"``, ``"completions+http://…"``: the same with the request style fixed

    Raises `UsageError` for anything else, `ModelError` when the model cannot be loaded.
    """
    return _parse(spec)[1]()


def model_name(spec: str) -> str:
    """The name under which the sample store keeps the answers of the model of ``spec``; loads no model.

    A model file is named by its name and a digest of its content; a missing file by its name alone, which is enough to
    replay its answers.
    """
    return _parse(spec)[0]


def check_server(spec: str) -> None:
    """One short request where ``spec`` names a server, to report a wrong address, key or model before long work.

    Raises `UsageError` as `connect` does, `ModelError` where the server cannot be used, or a model file is missing.
    """
    kind, _, rest = spec.partition(":")
    if kind == "gguf" and rest:
        if not (path := Path(rest).expanduser()).is_file():
            raise ModelError(NO_FILE.format(path))
        return
    if spec == "embedded":
        return
    from robust_instant_policy.llm.endpoint import Endpoint

    if isinstance(model := connect(spec), Endpoint):
        model.check()


def _parse(spec: str) -> tuple[str, Callable[[], LanguageModel]]:
    """The model's name, and what makes it. Imports wait until then: they take most of the time."""
    kind, _, rest = spec.partition(":")
    if spec == "embedded":
        from robust_instant_policy.llm.gemma import EMBEDDED_NAME, load_embedded

        return EMBEDDED_NAME, load_embedded
    if kind == "gguf" and rest:
        from robust_instant_policy.llm.llama import LlamaModel, file_name

        path = Path(rest).expanduser()
        name = file_name(path)
        return name, lambda: LlamaModel(path, name)
    if kind == "openai" and rest:
        return rest, lambda: _endpoint(OPENAI_URL, rest, "chat")
    style, _, address = spec.rpartition("+") if spec.startswith(("chat+", "completions+")) else ("", "", spec)
    if address.startswith(("http://", "https://")):
        url, _, model = address.partition("#")
        try:
            parts = urlsplit(url)
            if parts.port == 0:
                raise ValueError("port 0 is no port of a server")
        except ValueError as error:  # such as a port that is no number, or above 65535
            raise UsageError(f"{url} is no address: {error}; write it as in http://localhost:8000/v1") from None
        if not (parts.hostname and model):
            raise UsageError("an address needs its model behind a #, as in http://localhost:8000/v1#my-model")
        if parts.username is not None:
            raise UsageError("a key does not belong into the address; put it into the variable RIP_API_KEY")
        return model, lambda: _endpoint(url, model, style)
    raise UsageError(f"unknown language model {spec!r}; known forms: {FORMS}")


def _endpoint(url: str, model: str, style: str) -> LanguageModel:
    from robust_instant_policy.llm.dialect import Style
    from robust_instant_policy.llm.endpoint import Endpoint

    return Endpoint(url, model, cast(Style | None, style or None))
