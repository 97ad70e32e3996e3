"""Compares `lerobot-eval` with `rip eval` on the same scenes.

    python benchmarks/lerobot_eval.py --lerobot ENV [--tasks TASK ...] [--episodes N] [--out DIR] [--llm LLM]

ENV is an environment with LeRobot 0.6 and the plugins (`plugins/setup.sh`). For each task both plan with the same
demonstrations and the same language model; one executes through the plugins `lerobot_policy_rip` and
`lerobot_env_rip`, the other through `rip eval`. The table goes to docs/tables/lerobot_eval.md. An interrupted run
continues.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

from scipy.stats import binomtest

from robust_instant_policy.evaluation.scenes import scene_seed
from robust_instant_policy.evaluation.store import read_results
from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.simulated_task import SimulatedTask

TABLE = Path(__file__).parent.parent / "docs" / "tables" / "lerobot_eval.md"
TASKS = [
    "pick-banana", "aloha-pick-banana", "push-cube", "aloha-sweep", "open-drawer", "aloha-cup-upright",
    "close-cabinet", "aloha-hang", "turn-faucet", "aloha-pick-place",
]  # fmt: skip
MODELS = {"hand-e": "ur5e-hande", "left": "viperx-left", "right": "viperx-right"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lerobot", type=Path, required=True)
    parser.add_argument("--tasks", nargs="+", default=TASKS)
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("runs/lerobot-eval"))
    parser.add_argument("--llm", default="embedded")
    options = parser.parse_args()
    count = str(options.episodes)
    for task in options.tasks:
        ours = ["-m", "robust_instant_policy.cli", "eval", "--tasks", task, "--methods", "rip", "--episodes", count]
        run(sys.executable, *ours, "--llm", options.llm, "--no-analysis", "--keep", "--out", str(options.out / "rip"))
        with_lerobot(options.lerobot, task, options.episodes, options.llm, options.out / task)
        write_table(options.tasks, options.episodes, options.out)


def with_lerobot(env: Path, task: str, episodes: int, llm: str, out: Path) -> None:
    """`lerobot-eval` on the test scenes of ``task``, unless it is done."""
    if (out / "eval" / "eval_info.json").exists():
        return
    made = make_task(task)
    assert isinstance(made, SimulatedTask)
    several = len(made.end_effectors) > 1
    arms = [{"model": MODELS[name], "name": name if several else ""} for name in made.end_effectors]
    options = [
        f"--demonstrations={Path('data', task).resolve()}", f"--arms={json.dumps(arms)}", f"--llm={llm}",
        f"--rate_hz={made.control_hz}", f"--waypoint_hz={made.execute_hz}", "--min_confidence=0",
        f"--workspace={json.dumps(made.workspace.tolist())}",
    ]  # fmt: skip
    made.close()
    run(str(env / "bin/python"), "-m", "lerobot_policy_rip", *options, f"--out={out / 'policy'}")
    run(
        str(env / "bin/lerobot-eval"), f"--policy.path={out / 'policy'}", "--env.type=rip", f"--env.task={task}",
        "--env.live_images=false", f"--eval.n_episodes={episodes}", "--eval.batch_size=1",
        "--eval.use_async_envs=false", f"--seed={scene_seed(0, 0, 'test')}", f"--output_dir={out / 'eval'}",
    )  # fmt: skip


def run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, "MUJOCO_GL": "egl"})
    if done.returncode:
        sys.exit(f"{' '.join(command)}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}")


def write_table(tasks: list[str], episodes: int, out: Path) -> None:
    rows, more, less, both = [], 0, 0, 0
    results = read_results(out / "rip").episodes
    first = scene_seed(0, 0, "test")
    for task in tasks:
        file = out / task / "eval" / "eval_info.json"
        if not file.exists():
            continue
        lerobot = json.loads(file.read_text())["per_task"][0]["metrics"]["successes"]
        by_seed = {row.scene.seed: row.success for row in results if row.scene.task == task}
        pairs = [(bool(done), by_seed[first + index]) for index, done in enumerate(lerobot[:episodes])]
        only_lerobot, only_rip = pairs.count((True, False)), pairs.count((False, True))
        more, less, both = more + only_lerobot, less + only_rip, both + len(pairs)
        ours, theirs = sum(rip for _, rip in pairs), sum(done for done, _ in pairs)
        rows.append(f"| {task} | {len(pairs)} | {ours} | {theirs} | {only_rip} | {only_lerobot} |")
    p = binomtest(more, more + less).pvalue if more + less else 1.0
    lines = [
        "| task | scenes | success of `rip eval` | of `lerobot-eval` | only of `rip eval` | only of `lerobot-eval` |",
        "| --- | --- | --- | --- | --- | --- |",
        *rows,
        "",
        f"Of {both} shared scenes {both - more - less} ended alike; exact sign test of the others p = {p:.2f}. "
        "Method `rip`, ten demonstrations, the embedded model; written by `python benchmarks/lerobot_eval.py`.",
        "",
    ]
    TABLE.write_text("\n".join(lines))


if __name__ == "__main__":
    main()
