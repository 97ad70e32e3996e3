"""An evaluation on a local Ray cluster of two nodes, one of which is killed half-way; the run must be complete.

python benchmarks/cluster.py --data data --out runs/cluster [--samples runs/paper/samples.sqlite] [--table FILE]

Each node is a separate raylet with one core, as on another machine. Two processes on this machine execute the same
scenes again; the rows must be equal up to order and times. Without --samples only the method without a language model
is executed.
"""

from __future__ import annotations

import argparse
import shutil
import time
from pathlib import Path

from ray.cluster_utils import Cluster

from robust_instant_policy.evaluation import (
    STORE_FILE,
    Choice,
    Progress,
    Setup,
    Variant,
    make_suites,
    read_results,
    run_suites,
)
from robust_instant_policy.evaluation.cluster import RayWorkers
from robust_instant_policy.evaluation.episodes import Episode
from robust_instant_policy.evaluation.processes import LocalWorkers
from robust_instant_policy.evaluation.work import Workers
from robust_instant_policy.llm import model_name

TIMES = ("seconds", "physics_seconds")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("data"))
    parser.add_argument("--tasks", nargs="+", default=["push-cube", "turn-faucet"])
    parser.add_argument("--episodes", type=int, default=6)
    parser.add_argument("--demos", type=int, default=10)
    parser.add_argument("--samples", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--table", type=Path)
    options = parser.parse_args()

    methods = ["neighbours", "rip", "rip-gauss", "kat"] if options.samples else ["neighbours"]
    base = Variant("rip", demos=options.demos, model=model_name("embedded"))
    suites = make_suites(["table1"], Choice(base, options.tasks, methods, options.episodes))
    scenes = len(suites[0].scenes)
    lines = ["| workers | scenes | rows | killed | complete | minutes |", "| --- | --- | --- | --- | --- | --- |"]

    def run(name: str, workers: Workers, on_scene=lambda count: None) -> list[Episode]:
        out = options.out / name
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir(parents=True)
        store = out / STORE_FILE
        if options.samples:
            shutil.copy(options.samples, store)
        setup = Setup("embedded", bool(options.samples), store, options.data, 300.0, films=False)
        seen = set()

        def outcome(done: int, total: int, what) -> None:
            if isinstance(what, Episode):
                seen.add(what.scene)
                on_scene(len(seen))
            print(f"\r{name}: {done} of {total} plans", end="", flush=True)

        start = time.monotonic()
        run_suites(suites, setup, out, workers, Progress(outcome=outcome))
        print()
        rows = list(read_results(out).episodes)
        complete = len({row.scene for row in rows}) == scenes
        minutes = (time.monotonic() - start) / 60
        killed = f"one node after {scenes // 2} scenes" if name == "cluster" else "none"
        lines.append(f"| {name} | {scenes} | {len(rows)} | {killed} | {'yes' if complete else 'no'} | {minutes:.1f} |")
        return rows

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    second = [cluster.add_node(num_cpus=1)]
    cluster.wait_for_nodes()

    def kill_one(done: int) -> None:
        if done >= scenes // 2 and second:
            print("\nkilling the second node")
            cluster.remove_node(second.pop(), allow_graceful=False)

    try:
        over_nodes = run("cluster", RayWorkers(cluster.address, 2), kill_one)
    finally:
        cluster.shutdown()
    here = run("processes", LocalWorkers(2))
    same = {row.key: _timeless(row) for row in over_nodes} == {row.key: _timeless(row) for row in here}
    lines.append("")
    lines.append(f"Rows of both equal up to order and times: {'yes' if same else 'no'}.")
    print("\n".join(lines))
    if options.table:
        options.table.write_text("\n".join(lines) + "\n")


def _timeless(row: Episode) -> dict:
    return {name: value for name, value in vars(row).items() if name not in TIMES}


if __name__ == "__main__":
    main()
