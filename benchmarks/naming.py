"""How well hallucinated candidates are named: those that fail when they are executed alone, and those that succeed.

    python benchmarks/naming.py --run results/paper --out docs/tables/naming.md

The run is one of `rip eval --suite table1` with the methods `rip` and `kat`, its samples beside its rows: `kat`
executes every candidate by itself. Only scenes in which `rip` succeeds count: where the keypoints are wrong, all
candidates fail and none is the odd one out. No model is asked and nothing is executed.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from stored_proposals import NUM_DEMOS, NUM_QUERIES, proposals

from robust_instant_policy.evaluation.suites import SIMULATION_TASKS
from robust_instant_policy.policies.rip import DOF, robust_plan

COLUMNS = ("fail, named", "succeed, named", "fail, named without", "succeed, named without")


def executions(run: Path, task: str) -> tuple[set[int], dict[int, list[bool]]]:
    """Seeds of the scenes in which `rip` succeeded, and which of each scene's candidates did by themselves."""
    wanted = [("task", "=", task), ("demos", "=", NUM_DEMOS), ("queries", "=", NUM_QUERIES)]
    wanted += [("objects", "=", "seen"), ("downsampling", "=", "masked"), ("frames", "=", "adaptive")]
    rows = pq.read_table(run / "episodes.parquet", filters=wanted).to_pylist()
    good = {row["seed"] for row in rows if row["method"] == "rip" and row["dof"] == DOF and row["success"]}
    alone: dict[int, list[bool]] = {}
    for row in sorted((row for row in rows if row["method"] == "kat"), key=lambda row: row["candidate"]):
        alone.setdefault(row["seed"], []).append(row["success"])
    return good, alone


def counted(run: Path, task: str, data: Path, llm: str) -> np.ndarray:
    """``(2, 2, 2)``: with or without `Proposal.variation`; candidates that fail or succeed; named, and all of them."""
    good, alone = executions(run, task)
    counts = np.zeros((2, 2, 2), dtype=int)
    for seed, _, proposal in proposals(task, data, run / "samples.sqlite", llm, len(alone)):
        if seed not in good:
            continue
        succeeded = np.array(alone[seed], dtype=int)
        for way, known in enumerate((proposal, replace(proposal, variation=None))):
            named = robust_plan(known).hallucinated
            for outcome in (0, 1):
                counts[way, outcome] += [named[succeeded == outcome].sum(), (succeeded == outcome).sum()]
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, required=True, help="a folder that rip eval wrote")
    parser.add_argument("--data", type=Path, default=Path("data"), help="where the demonstrations are")
    parser.add_argument("--tasks", nargs="+", default=SIMULATION_TASKS)
    parser.add_argument("--llm", default="embedded", help="the model of that run")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    counts = {task: counted(options.run, task, options.data, options.llm) for task in options.tasks}
    counts["all"] = sum(counts.values())
    lines = [["task", *COLUMNS], ["---"] * (1 + len(COLUMNS))]
    lines += [[task, *(f"{named} of {count}" for named, count in own.reshape(-1, 2))] for task, own in counts.items()]
    options.out.write_text("".join("| " + " | ".join(cells) + " |\n" for cells in lines))
    print(options.out.read_text())


if __name__ == "__main__":
    main()
