"""Runs the commands of docs/lerobot.md for the simulator, as written, in an environment with LeRobot and the plugins.

    python scripts/lerobot_end_to_end.py --lerobot ENV [--work DIR] [--record-only]

ENV comes from `plugins/setup.sh`. The commands run in a terminal in which the key n is pressed when the leader says so,
and Ctrl-C when the policy says that the motion has ended.
The recording must hold all episodes, and the policy must do the task. ``--record-only`` is for LeRobot 0.4.4, whose
robots have no depth streams and which has no `lerobot-rollout`: it records an episode with coded depth, continues with
a second one, and imports both.
"""

from __future__ import annotations

import argparse
import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "lerobot.md"
LIMIT_S = 1500.0  # of a command
PROMPT, ENDED = b"press n", b"the motion has ended"  # answered by the key n, and by Ctrl-C
CODED = (
    "lerobot-record --robot.type=rip_twin --robot.depth=coded --robot.seed={seed} --teleop.type=rip_twin_leader "
    "--teleop.pause_s=60 --dataset.repo_id=me/banana --dataset.root=data/banana-coded --dataset.num_episodes=1 "
    "--dataset.fps=5 --dataset.episode_time_s=25 --dataset.single_task='pick up the banana' "
    "--dataset.push_to_hub=false --play_sounds=false --resume={resume}"
)
IMPORT = "rip import data/banana-coded --rig rig.json --task banana"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lerobot", type=Path, required=True)
    parser.add_argument("--work", type=Path)
    parser.add_argument("--record-only", action="store_true")
    options = parser.parse_args()
    work = options.work or Path(tempfile.mkdtemp(prefix="lerobot-"))
    work.mkdir(parents=True, exist_ok=True)
    path = f"{(options.lerobot / 'bin').resolve()}:{os.environ['PATH']}"
    env = {**os.environ, "PATH": path, "MUJOCO_GL": "egl", "HF_HUB_OFFLINE": "1"}
    name, content, commands = simulator_section()
    if options.record_only:
        rig = json.loads(content) | {"depth_key": "observation.images.top_depth"}
        (work / name).write_text(json.dumps(rig))
        for index in range(2):
            run(CODED.format(seed=index, resume="true" if index else "false"), work, env)
        check_recording(work / "data/banana-coded", 2)
        if "2 demonstrations" not in (said := run(IMPORT, work, env)):
            sys.exit(f"not both episodes were imported:\n{said[-2000:]}")
    else:
        (work / name).write_text(content)
        output = [run(command, work, env) for command in commands]
        check_recording(work / "data/banana-lerobot", 5)
        if not re.search(r"twin: scene \d+: done", output[-1]):
            sys.exit("the policy did not do the task:\n" + output[-1][-2000:])
    print(f"all commands did what they should; their files are in {work}")


def simulator_section() -> tuple[str, str, list[str]]:
    """Name and content of the page's JSON file, and its commands, without the first one, which makes ENV."""
    text = PAGE.read_text().split("## In the simulator", 1)[1].split("\n## ", 1)[0]
    (name,) = re.findall(r"`(\S+\.json)`", text)
    (content,) = re.findall(r"^```json\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    json.loads(content)
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    return name, content, [block.strip() for block in blocks][1:]


def run(command: str, work: Path, env: dict[str, str]) -> str:
    """The output of a shell command in a terminal; ends the script if it fails."""
    print(f"$ {command}", flush=True)
    terminal, end = pty.openpty()
    start = time.monotonic()
    process = subprocess.Popen(
        ["bash", "-ec", command], stdin=end, stdout=end, stderr=end, cwd=work, env=env, start_new_session=True
    )
    os.close(end)
    output, pressed, interrupted = b"", 0, False
    while time.monotonic() - start < LIMIT_S:
        if not select.select([terminal], [], [], 1.0)[0]:
            continue
        try:
            output += os.read(terminal, 1 << 16)
        except OSError:  # the command has ended
            break
        while output.count(PROMPT) > pressed:
            pressed += 1
            os.write(terminal, b"n")
        if ENDED in output and not interrupted:
            interrupted = True
            os.killpg(process.pid, signal.SIGINT)
    else:
        process.kill()
    if process.wait():
        sys.exit(f"exit code {process.returncode}:\n{output.decode(errors='replace')[-4000:]}")
    os.close(terminal)
    print(f"  {time.monotonic() - start:.0f} s", flush=True)
    return output.decode(errors="replace")


def check_recording(folder: Path, episodes: int) -> None:
    info = json.loads((folder / "meta/info.json").read_text())
    features = info["features"]
    if info["total_episodes"] != episodes or info["robot_type"] != "rip_twin":
        sys.exit(f"{folder} holds {info['total_episodes']} episodes of {info['robot_type']}, not {episodes}")
    if "observation.images.top_depth" not in features or "shoulder.pos" not in features["action"]["names"]:
        sys.exit(f"{folder} lacks depth or joints: {sorted(features)}")


if __name__ == "__main__":
    main()
