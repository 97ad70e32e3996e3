"""A run's folder turned into what people look at: tables now, whenever rows came."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from robust_instant_policy.datasets.files import write_whole
from robust_instant_policy.evaluation.episodes import open_episodes
from robust_instant_policy.evaluation.manifest import Manifest
from robust_instant_policy.evaluation.summary import Summary
from robust_instant_policy.evaluation.tables import tables

TABLE_FILE = "table.md"


def publish(out: Path) -> str:
    """Write ``out/table.md`` with the tables of all suites in ``out`` and return its text."""
    with closing(open_episodes(out)) as episodes:
        summaries = [Summary(suite, episodes.rows) for suite in Manifest.read(out).suites]
    text = "\n".join(table.markdown() for summary in summaries if summary.rows for table in tables(summary))
    write_whole(out / TABLE_FILE, text.encode())
    return text
