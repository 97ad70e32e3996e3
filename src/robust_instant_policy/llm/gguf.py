"""GGUF files: reading the header, and writing a copy whose vocabulary is cut to the tokens that numbers need.

A small model spends most of its work on words it will never say: of Gemma 3 270M's 268 million parameters 168
million are its 262,144 token embeddings, and every sampled token scores all of them. Text made of numbers uses a few
hundred. The embedding matrix is stored a row a token, so the rows that are kept are kept bit for bit, and
the scores of the kept tokens are the same as in the whole model; only what could never be said is gone.

Format: https://github.com/ggml-org/ggml/blob/master/docs/gguf.md (version 3, little endian).
"""

from __future__ import annotations

import hashlib
import math
import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from robust_instant_policy.errors import ModelError

MAGIC = b"GGUF"
DEFAULT_ALIGNMENT = 32  # bytes
COPY_CHUNK = 1 << 20  # bytes
FINGERPRINT_PIECES = 8  # of COPY_CHUNK bytes

_SCALARS = {0: "B", 1: "b", 2: "H", 3: "h", 4: "I", 5: "i", 6: "f", 7: "?", 10: "Q", 11: "q", 12: "d"}
_STRING, _ARRAY = 8, 9
_BLOCKS = {0: (1, 4), 1: (1, 2), 6: (32, 22), 8: (32, 34), 12: (256, 144), 14: (256, 210)}  # ggml type: values, bytes

PER_TOKEN_ARRAYS = ("tokenizer.ggml.tokens", "tokenizer.ggml.scores", "tokenizer.ggml.token_type")
EMBEDDING = "token_embd.weight"


@dataclass(frozen=True)
class Tensor:
    """Where a tensor lies: ``shape`` innermost first, ggml's type number, ``offset`` from the start of the data."""

    name: str
    shape: tuple[int, ...]
    kind: int
    offset: int

    @property
    def row_bytes(self) -> int:
        values, size = _BLOCKS[self.kind]
        return self.shape[0] // values * size

    @property
    def num_bytes(self) -> int:
        return self.row_bytes * math.prod(self.shape[1:])


@dataclass(frozen=True)
class Header:
    """Everything before the weights: ``fields`` maps a key to its GGUF type and value (arrays: element type, list)."""

    fields: dict[str, tuple[int, Any]]
    tensors: tuple[Tensor, ...]
    data_start: int

    def value(self, key: str, default: Any = None) -> Any:
        return self.fields[key][1] if key in self.fields else default

    @property
    def alignment(self) -> int:
        return int(self.value("general.alignment", DEFAULT_ALIGNMENT))

    @property
    def context_length(self) -> int | None:
        """Tokens the model was trained to look back on."""
        return self.value(f"{self.value('general.architecture')}.context_length")


def read_header(path: Path) -> Header:
    """The header of the GGUF file at ``path``; `ModelError` when it is not one."""
    try:
        with path.open("rb") as file:
            return _read_header(file)
    except FileNotFoundError:
        raise ModelError(f"no model file at {path}; give the path of a .gguf file") from None
    except (OSError, struct.error, KeyError, ValueError, MemoryError, OverflowError) as error:
        raise ModelError(f"{path} is not a readable GGUF file ({error}); download or copy it again") from None


def _read_header(file: BinaryIO) -> Header:
    if file.read(4) != MAGIC:
        raise ValueError("it does not begin with GGUF")
    version = _read(file, "I")
    if version not in (2, 3):
        raise ValueError(f"version {version} of the format")
    num_tensors, num_fields = _read(file, "Q"), _read(file, "Q")
    fields: dict[str, tuple[int, Any]] = {}
    for _ in range(num_fields):
        key = _read_string(file).decode()
        kind = _read(file, "I")
        fields[key] = (kind, _read_value(file, kind))
        if key == "general.architecture":
            fields[key] = (kind, fields[key][1].decode())
    tensors = []
    for _ in range(num_tensors):
        name = _read_string(file).decode()
        shape = tuple(_read(file, "Q") for _ in range(_read(file, "I")))
        tensors.append(Tensor(name, shape, _read(file, "I"), _read(file, "Q")))
    header = Header(fields, tuple(tensors), 0)
    return Header(fields, tuple(tensors), _aligned(file.tell(), header.alignment))


def fingerprint(path: Path) -> str:
    """Eight hexadecimal digits of a file's content: its size and evenly spaced pieces of it, header and end included.

    Reading a whole model takes seconds; weights that differ at all differ nearly everywhere. Raises `ModelError`.
    """
    try:
        size = path.stat().st_size
        digest = hashlib.sha256(str(size).encode())
        with path.open("rb") as file:
            for piece in range(FINGERPRINT_PIECES):
                file.seek(max(0, size - COPY_CHUNK) * piece // (FINGERPRINT_PIECES - 1))
                digest.update(file.read(COPY_CHUNK))
    except OSError as error:
        raise ModelError(f"no model file at {path} ({error.strerror}); give the path of a .gguf file") from None
    return digest.hexdigest()[:8]


def cut_vocabulary(source: Path, target: Path, keep: Callable[[bytes, int], bool]) -> int:
    """Write a copy of ``source`` to ``target`` that holds only the tokens for which ``keep(piece, type)`` is true.

    The special tokens named in the header are always kept. The file appears under its name only when it is whole.
    Returns the number of tokens kept. Raises `ModelError` for models whose vocabulary is not a plain list of scored
    pieces with one embedding row each (SentencePiece models: Gemma, Llama 2).
    """
    header = read_header(source)
    by_name = {tensor.name: tensor for tensor in header.tensors}
    if any(key not in header.fields for key in PER_TOKEN_ARRAYS) or "output.weight" in by_name:
        raise ModelError(f"the vocabulary of {source.name} cannot be cut; use the file as it is, by gguf:{source}")
    pieces = header.value(PER_TOKEN_ARRAYS[0])[1]
    types = header.value(PER_TOKEN_ARRAYS[2])[1]
    special = {key: value for key, (_, value) in header.fields.items() if key.endswith("_token_id")}
    kept = [
        index
        for index, (piece, kind) in enumerate(zip(pieces, types, strict=True))
        if index in special.values() or keep(piece, kind)
    ]
    renumbered = {old: new for new, old in enumerate(kept)}
    fields = dict(header.fields)
    for key in PER_TOKEN_ARRAYS:
        kind, (element, values) = fields[key]
        fields[key] = (kind, (element, [values[index] for index in kept]))
    for key, value in special.items():
        fields[key] = (fields[key][0], renumbered[value])

    embedding = by_name[EMBEDDING]
    tensors, offset = [], 0
    for tensor in header.tensors:
        shape = (tensor.shape[0], len(kept)) if tensor is embedding else tensor.shape
        tensors.append(Tensor(tensor.name, shape, tensor.kind, offset))
        offset = _aligned(offset + tensors[-1].num_bytes, header.alignment)

    partial = target.with_name(f"{target.name}.{os.getpid()}.part")
    try:
        with source.open("rb") as reader, partial.open("wb") as writer:
            _write_header(writer, fields, tensors, header.alignment)
            start = writer.tell()
            for old, new in zip(header.tensors, tensors, strict=True):
                writer.write(b"\0" * (start + new.offset - writer.tell()))
                reader.seek(header.data_start + old.offset)
                if old is embedding:
                    for index in kept:
                        reader.seek(header.data_start + old.offset + index * old.row_bytes)
                        writer.write(reader.read(old.row_bytes))
                else:
                    _copy(reader, writer, old.num_bytes)
            writer.flush()
            os.fsync(writer.fileno())
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)
    return len(kept)


def _write_header(file: BinaryIO, fields: dict[str, tuple[int, Any]], tensors: list[Tensor], alignment: int) -> None:
    file.write(MAGIC + struct.pack("<IQQ", 3, len(tensors), len(fields)))
    for key, (kind, value) in fields.items():
        _write_string(file, key.encode())
        file.write(struct.pack("<I", kind))
        _write_value(file, kind, value)
    for tensor in tensors:
        _write_string(file, tensor.name.encode())
        file.write(struct.pack(f"<I{len(tensor.shape)}Q", len(tensor.shape), *tensor.shape))
        file.write(struct.pack("<IQ", tensor.kind, tensor.offset))
    file.write(b"\0" * (_aligned(file.tell(), alignment) - file.tell()))


def _copy(reader: BinaryIO, writer: BinaryIO, size: int) -> None:
    while size:
        block = reader.read(min(size, COPY_CHUNK))
        if not block:
            raise ModelError("the model file ends too early; download or copy it again")
        writer.write(block)
        size -= len(block)


def _aligned(offset: int, alignment: int) -> int:
    return -(-offset // alignment) * alignment


def _read(file: BinaryIO, code: str) -> Any:
    return struct.unpack("<" + code, file.read(struct.calcsize("<" + code)))[0]


def _read_string(file: BinaryIO) -> bytes:
    return file.read(_read(file, "Q"))


def _read_value(file: BinaryIO, kind: int) -> Any:
    if kind == _STRING:
        return _read_string(file)
    if kind == _ARRAY:
        element, count = _read(file, "I"), _read(file, "Q")
        if element in _SCALARS:
            return element, list(struct.unpack(f"<{count}{_SCALARS[element]}", file.read(count * _size(element))))
        return element, [_read_value(file, element) for _ in range(count)]
    return _read(file, _SCALARS[kind])


def _size(kind: int) -> int:
    return struct.calcsize("<" + _SCALARS[kind])


def _write_string(file: BinaryIO, text: bytes) -> None:
    file.write(struct.pack("<Q", len(text)) + text)


def _write_value(file: BinaryIO, kind: int, value: Any) -> None:
    if kind == _STRING:
        _write_string(file, value.encode() if isinstance(value, str) else value)
    elif kind == _ARRAY:
        element, values = value
        file.write(struct.pack("<IQ", element, len(values)))
        for item in values:
            _write_value(file, element, item)
    else:
        file.write(struct.pack("<" + _SCALARS[kind], value))
