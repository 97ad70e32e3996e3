"""Success, training time and planning time of the baselines, from runs of `rip eval`.

rip eval --methods kat-dp --demos 200 --episodes 20 --out runs/proof    (and the like)
python benchmarks/baselines.py results/adaptive runs/proof --checkpoints checkpoints --table docs/tables/baselines.md

Training times are stored in `results/baselines/training.json`, so that checkpoints can be deleted.
"""

from __future__ import annotations

import argparse
import json
import re
from collections import defaultdict
from pathlib import Path
from statistics import median

from robust_instant_policy.evaluation import Episode, read_results, wilson_interval
from robust_instant_policy.evaluation.episodes import EpisodeKey
from robust_instant_policy.policies import METHOD_NAMES
from robust_instant_policy.policies.diffusion import checkpoint

KEPT = Path(__file__).parents[1] / "results" / "baselines" / "training.json"
UNTRAINED, DEMOS = ("neighbours", "gp"), 10  # shown beside those that are trained, with so many demonstrations
NAME = re.compile(r"(?P<method>kat-dp|dp)-(?P<task>.+)-(?P<demos>\d+)-[0-9a-f]+")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folders written by rip eval")
    parser.add_argument("--checkpoints", type=Path, default=Path("checkpoints"))
    parser.add_argument("--table", type=Path, required=True)
    options = parser.parse_args()
    rows: dict[tuple, dict[EpisodeKey, Episode]] = defaultdict(dict)  # rows of two runs count once
    for run in options.runs:
        for row in read_results(run).episodes:
            if row.variant.steps is None and (row.variant.method not in UNTRAINED or row.variant.demos != DEMOS):
                continue
            rows[row.scene.task, row.variant.demos, row.variant.method, row.variant.steps][row.key] = row
    trained = training_seconds(options.checkpoints)
    lines = [
        "| task | demonstrations | method | success | 95% interval | training | in | planning (median) |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for (task, demos, method, steps), by_key in sorted(rows.items(), key=lambda item: place(*item[0])):
        own = by_key.values()
        successes = sum(row.success for row in own)
        low, high = wilson_interval(successes, len(own))
        training = "none" if steps is None else f"{steps} steps"
        seconds = "0 s" if steps is None else f"{trained[method, task, demos, steps]:.0f} s"
        planning = median(row.seconds for row in own)
        rate = f"{successes}/{len(own)} | {low:.0%} to {high:.0%}"
        lines.append(f"| {task} | {demos} | {method} | {rate} | {training} | {seconds} | {planning:.2f} s |")
    options.table.write_text("\n".join(lines) + "\n")
    print(options.table.read_text())


def place(task: str, demos: int, method: str, steps: int | None) -> tuple:
    """Order in the table: by task and demonstrations, methods as in other tables."""
    return task, demos, METHOD_NAMES.index(method), steps or 0


def training_seconds(folder: Path) -> dict[tuple[str, str, int, int], float]:
    """Seconds by method, task, demonstrations and steps, of finished checkpoints in ``folder`` and of stored times."""
    seconds = {tuple(key): value for key, value in json.loads(KEPT.read_text())} if KEPT.exists() else {}
    for path in folder.glob("*.safetensors"):
        name = NAME.fullmatch(path.stem)
        if name:
            tensors, facts = checkpoint.load(path)
            seconds[name["method"], name["task"], int(name["demos"]), len(tensors["losses"])] = facts["seconds"]
    KEPT.write_text("[\n" + ",\n".join(json.dumps([key, seconds[key]]) for key in sorted(seconds)) + "\n]\n")
    return seconds


if __name__ == "__main__":
    main()
