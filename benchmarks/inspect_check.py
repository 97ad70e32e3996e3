"""`rip` and its simulated tasks within Inspect Robots: conformance, and an evaluation.

    python benchmarks/inspect_check.py --demos data/push-cube --scenes 5

Inspect Robots and the plugin of this package are installed in an environment of their own, at --venv, which also sees
the packages of this one (for the simulator). Checked are: the entry points; the conformance of the embodiment;
the compatibility of policy and embodiment; and that an evaluation by `inspect_robots.eval` succeeds in as many
scenes as plans that this package executes itself. `--method rip` asks the embedded language model.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import sysconfig
import tempfile
import venv
from pathlib import Path

PACKAGES = ("inspect-robots==0.60.0",)
PLUGIN = Path(__file__).parents[1] / "plugins" / "inspect_robots_rip"
CHECK = """
import json, sys

from inspect_robots import eval as evaluate
from inspect_robots.compat import assert_compatible
from inspect_robots.conformance import assert_embodiment_conformant, check_embodiment
from inspect_robots.registry import resolve
from inspect_robots.scene import Scene
from inspect_robots.task import Task

from robust_instant_policy.evaluation import scene_seed
from robust_instant_policy.tasks import make_task

demos, name, method, count, logs = sys.argv[1:]
policy = resolve("policy", "rip", demos=demos, method=method, min_confidence=0.0)
twin = resolve("embodiment", "rip-twin", task=name)
assert_embodiment_conformant(twin.info)
print(check_embodiment(twin.info).summary())
scenes = [Scene(f"{name}-{i}", twin.info.docs, init_seed=scene_seed(0, i)) for i in range(int(count))]
task = Task("push", scenes, "success_at_end", max_steps=60)
report = assert_compatible(policy, twin, task)
print("compatible;", [issue.message for issue in report.issues] or "no warnings")
(log,) = evaluate(task, policy, twin, log_dir=logs)
twin.close()
theirs = [bool(scene.reduced.get("success_at_end")) for scene in log.samples]
print("status", log.status, "successes", theirs, [scene.error for scene in log.samples if scene.error])
task, ours = make_task(name), []
for scene in scenes:
    plan = policy._planner.plan(task.reset(scene.init_seed))
    ours.append(task.execute(plan.trajectory).success)
task.close()
print("executed here", ours)
sys.exit(theirs != ours)
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--demos", type=Path, required=True)
    parser.add_argument("--task", default="push-cube")
    parser.add_argument("--method", default="neighbours")
    parser.add_argument("--scenes", type=int, default=5)
    parser.add_argument("--venv", type=Path, default=Path(tempfile.gettempdir()) / "inspect-venv")
    options = parser.parse_args()
    python = environment(options.venv)
    with tempfile.TemporaryDirectory() as logs:
        command = [python, "-c", CHECK, options.demos, options.task, options.method, str(options.scenes), logs]
        sys.exit(subprocess.run(command).returncode)


def environment(folder: Path) -> Path:
    """Interpreter of an environment with Inspect Robots and the plugin, created if it is missing."""
    python = folder / "bin" / "python"
    if not python.exists():
        venv.create(folder, with_pip=True)
    own = Path(sysconfig.get_path("purelib", vars={"base": str(folder)}))
    (own / "this_environment.pth").write_text(f"import site; site.addsitedir({sysconfig.get_path('purelib')!r})\n")
    if subprocess.run([python, "-c", "import inspect_robots"], capture_output=True).returncode:
        print(f"installing {PACKAGES[0]} into {folder}", flush=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", *PACKAGES], check=True)
    subprocess.run([python, "-m", "pip", "install", "--quiet", "--no-deps", str(PLUGIN)], check=True)
    return python


if __name__ == "__main__":
    main()
