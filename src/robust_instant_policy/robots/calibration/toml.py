"""Writing TOML: the standard library only reads it."""

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from robust_instant_policy.files import write_whole


def save_calibration(path: Path, header: str, facts: Mapping[str, Any], **tables: Mapping[str, Any]) -> None:
    """Write ``facts`` and ``tables`` as TOML behind the comments ``header``."""
    parts = [header + toml(facts), *(f"[{name}]\n{toml(table)}" for name, table in tables.items())]
    write_whole(path, "\n".join(parts).encode())


def now() -> str:
    """Date and time of a calibration, UTC."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def toml(facts: Mapping[str, Any]) -> str:
    """Keys with numbers, text and nested lists of numbers as TOML, one key a line, matrices one row a line."""
    lines = []
    for key, value in facts.items():
        if isinstance(value, list) and value and isinstance(value[0], list):
            rows = ",\n".join(f"  {json.dumps(row)}" for row in value)
            lines.append(f"{key} = [\n{rows},\n]")
        else:
            lines.append(f"{key} = {json.dumps(value, ensure_ascii=False)}")
    return "\n".join(lines) + "\n"
