"""Largest second differences of demonstrations, single samples, their mean, and robust trajectories with and
without the curvature of the demonstrations.

    python benchmarks/smoothness.py --samples results/adaptive/samples.sqlite --out docs/tables/smoothness.md

The samples are those that `rip eval --suite table1` stored; no model is needed. Second differences are those of any of
the gripper's points over three successive steps.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pick_and_place import key_error
from stored_proposals import NUM_DEMOS, arguments, proposals

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.policies import Context, LocatedScene, Proposal, Settings, aggregate
from robust_instant_policy.policies.aggregation import agree
from robust_instant_policy.reporting.tables import Table
from robust_instant_policy.trajectory import Trajectory

COLUMNS = ("demonstrations", "a single sample", "mean", "robust, curvature unknown", "robust")


def sharpest_turn(trajectory: Trajectory) -> float:
    """Metres, the largest second difference of any point of ``trajectory``."""
    points = trajectory.triplets.reshape(len(trajectory), -1, 3)
    return float(np.linalg.norm(np.diff(points, n=2, axis=0), axis=-1).max())


def turns(context: Context, scene: LocatedScene, proposal: Proposal) -> tuple[list[float], float]:
    """Largest second differences for all but the first of `COLUMNS`, and the shift of key steps by known curvature."""
    mean, robust = (
        aggregate(context, scene, proposal, Settings(estimator=estimator)).trajectory for estimator in ("mean", "em")
    )
    unknown = agree(proposal, Settings(), variation=context.prompt.for_scene(scene.keypoints).variation)
    free = Trajectory(unknown.actions, unknown.times)
    paths = (proposal.candidates[0], mean, free, robust)
    return [sharpest_turn(path) for path in paths], key_error(robust, free)


def measured(task_name: str, data: Path, samples: Path, llm: str, scenes: int) -> tuple[str, ...]:
    """One line of the table."""
    rows, moved = [], []
    for _, context, scene, proposal in proposals(task_name, data, samples, llm, scenes):
        row, difference = turns(context, scene, proposal)
        rows.append(row)
        moved.append(difference)
        shown = [sharpest_turn(trajectory) for trajectory in context.trajectories]
    columns: list[FloatArray] = [np.array(shown), *np.array(rows).T]
    cells = [f"{1000 * np.median(column):.0f} ({1000 * column.max():.0f})" for column in columns]
    return task_name, *cells, f"{1000 * np.median(moved):.1f} ({1000 * max(moved):.1f})"


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--samples", type=Path, required=True, help="samples.sqlite of a run of rip eval")
    parser.add_argument("--scenes", type=int, default=20)
    options = parser.parse_args()
    rows = [measured(task, options.data, options.samples, options.llm, options.scenes) for task in options.tasks]
    note = f"Millimetres, median (largest) over {options.scenes} scenes, and over {NUM_DEMOS} demonstrations."
    options.out.write_text(Table(("task", *COLUMNS, "moved at key steps"), tuple(rows), note).markdown())
    print(options.out.read_text())


if __name__ == "__main__":
    main()
