"""A copy of a GGUF model whose vocabulary is cut to the tokens that numbers need.

Of Gemma 3 270M's 268 million parameters 168 million are the embeddings of 262,144 tokens, and every sampled token
scores all of them; text made of numbers uses a few hundred. The embedding matrix has a row a token: rows that are kept
are kept bit for bit, so the scores of the kept tokens are those of the whole model.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from robust_instant_policy.errors import MissingExtraError

_TOKENS, _TYPES = "tokenizer.ggml.tokens", "tokenizer.ggml.token_type"
_PER_TOKEN = (_TOKENS, "tokenizer.ggml.scores", _TYPES)
_EMBEDDING = "token_embd.weight"


def cut_vocabulary(source: Path, target: Path, keep: Callable[[str, int], bool]) -> int:
    """Write a copy of ``source`` to ``target`` with only the tokens for which ``keep(piece, type)`` is true.

    Special tokens that the header names are always kept. ``target`` takes its name when it is whole. Returns the number
    of tokens kept. For models with scored pieces and one embedding row each, without output weights of their own
    (SentencePiece: Gemma, Llama 2).
    """
    try:
        from gguf import GGUFReader, GGUFValueType, GGUFWriter
    except ModuleNotFoundError:
        raise MissingExtraError("gguf", "embedded") from None
    reader = GGUFReader(source)
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
    return len(kept)
