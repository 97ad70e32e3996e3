"""Accuracy of the diagnosis: share of flagged candidates among those that fail, and succeed, when executed alone.

    python benchmarks/naming.py --run results/adaptive --out docs/tables/naming.md

The run is one of `rip eval --suite table1` with the methods `rip` and `kat`, its samples beside its rows: `kat`
executes every candidate alone. Only scenes in which `rip` succeeds count: with wrong keypoints all candidates fail
and none is an outlier. No model is needed and nothing is executed.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from stored_proposals import NUM_DEMOS, NUM_QUERIES, arguments, proposals

from robust_instant_policy.evaluation import STORE_FILE, Variant, read_results
from robust_instant_policy.llm import model_name
from robust_instant_policy.policies import Settings, aggregate
from robust_instant_policy.reporting.tables import Table

COLUMNS = ("fail, named", "succeed, named", "fail, named without", "succeed, named without")
NOTE = "Candidates that fail or succeed when executed alone, in scenes in which RIP succeeds."


def executions(run: Path, task: str, llm: str) -> tuple[set[int], dict[int, list[bool]]]:
    """Seeds of the scenes in which `rip` succeeded, and which candidates of each scene succeeded alone."""
    rip, kat = (Variant(name, NUM_DEMOS, NUM_QUERIES, model=model_name(llm)) for name in ("rip", "kat"))
    rows = [row for row in read_results(run).episodes if (row.scene.task, row.scene.objects) == (task, "seen")]
    good = {row.scene.seed for row in rows if row.variant == rip and row.success}
    alone: dict[int, list[bool]] = {}
    for row in sorted((row for row in rows if row.variant == kat), key=lambda row: row.candidate):
        alone.setdefault(row.scene.seed, []).append(row.success)
    return good, alone


def counted(run: Path, task: str, data: Path, llm: str) -> np.ndarray:
    """``(2, 2, 2)``: with or without `Prompt.variation`; candidates that fail or succeed; named, and all of them."""
    good, alone = executions(run, task, llm)
    counts = np.zeros((2, 2, 2), dtype=int)
    for seed, context, scene, proposal in proposals(task, data, run / STORE_FILE, llm, len(alone)):
        if seed not in good:
            continue
        succeeded = np.array(alone[seed], dtype=int)
        without = replace(context, prompt=replace(context.prompt, variation=None))
        for way, known in enumerate((context, without)):
            named = aggregate(known, scene, proposal, Settings()).hallucinated
            for outcome in (0, 1):
                counts[way, outcome] += [named[succeeded == outcome].sum(), (succeeded == outcome).sum()]
    return counts


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--run", type=Path, required=True, help="a folder that rip eval wrote")
    options = parser.parse_args()
    counts = {task: counted(options.run, task, options.data, options.llm) for task in options.tasks}
    counts["all"] = sum(counts.values())
    rows = [(task, *(f"{named} of {count}" for named, count in own.reshape(-1, 2))) for task, own in counts.items()]
    options.out.write_text(Table(("task", *COLUMNS), tuple(rows), NOTE).markdown())
    print(options.out.read_text())


if __name__ == "__main__":
    main()
