"""Which faults do the checks catch, and do they name them? One line a fault and task, and a table of all.

    rip record --task TASK --episodes 10 --seed 200000 --out DATA/TASK       # for every task
    python benchmarks/sanity.py DATA --seed 600003 --out results/sanity

New scenes are drawn from ``--seed``. Measurements in ``--out`` are not repeated.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path

from faults import FAULTS, Fault

from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import RipError
from robust_instant_policy.sanity import SetReport, check_demonstrations
from robust_instant_policy.tasks import make_task
from robust_instant_policy.trajectory import downsample

OUTCOMES = ("error, named", "error", "warning", "not caught")


def outcome(
    fault: Fault, demonstrations: list[Demonstration], scene: Observation, sound: SetReport, sets: dict[str, SetReport]
) -> tuple[str, str]:
    """One of `OUTCOMES`, and what was told; ``sets`` keeps the reports of faults that a scene's fault shares."""
    try:
        if fault.plan and sound.envelope:
            found = sound.envelope.check(fault.plan(downsample(demonstrations[0].trajectory)))
        else:
            report, found = sound, ()
            if fault.demonstrations:
                key = fault.name.split(":")[0]
                if key not in sets:
                    sets[key] = check_demonstrations(fault.demonstrations(demonstrations))
                report = sets[key]
                found = report.findings
            found += report.check_observation(fault.scene(scene, demonstrations) if fault.scene else scene)
    except RipError as error:  # refused where the values are made
        return "error, named", str(error)
    told = " ".join(f"{finding.message} {finding.cause}" for finding in found)
    severities = {finding.severity for finding in found}
    if "error" in severities:
        return ("error, named" if any(word.lower() in told.lower() for word in fault.expected) else "error"), told
    return ("warning" if "warning" in severities else "not caught"), told


def measure(task: str, folder: Path, seed: int, out: Path) -> None:
    demonstrations = load_demonstrations(folder)
    simulated = make_task(task)
    scene = simulated.reset(seed)
    simulated.close()
    sound, sets = check_demonstrations(demonstrations), {}
    rows = {}
    for name, fault in FAULTS.items():
        rows[name] = outcome(fault, demonstrations, scene, sound, sets)
        print(f"{task:<20}{name:<34}{rows[name][0]}", flush=True)
    out.write_text(json.dumps(rows, indent=1))


def table(folder: Path) -> str:
    """Markdown: the number of tasks with each of `OUTCOMES` of each fault, of those that are not named in all tasks."""
    measured = [json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))]
    lines = [f"| fault | {' | '.join(OUTCOMES)} |", "| --- " * (len(OUTCOMES) + 1) + "|"]
    named = 0
    for name in FAULTS:
        counts = Counter(rows[name][0] for rows in measured if name in rows)
        if counts[OUTCOMES[0]] == len(measured):
            named += 1
        elif counts:
            lines.append(f"| {name} | {' | '.join(str(counts[one] or '') for one in OUTCOMES)} |")
    others = len(lines) - 2
    return (
        f"{named} of {named + others} faults are refused and named in all of {len(measured)} tasks. The others, by "
        f"number of tasks:\n\n{chr(10).join(lines)}\n"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--seed", type=int, default=600_003)
    parser.add_argument("--tasks", nargs="+", help="default: all folders of DATA")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for task in options.tasks or sorted(path.name for path in options.data.iterdir() if path.is_dir()):
        if not (path := options.out / f"{task}.json").exists():
            measure(task, options.data / task, options.seed, path)
    (options.out / "faults.md").write_text(table(options.out))


if __name__ == "__main__":
    main()
