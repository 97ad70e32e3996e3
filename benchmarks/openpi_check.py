"""A client of openpi itself gets a chunk from `rip serve`.

    python benchmarks/openpi_check.py --demos data/push-cube --observation observation.npz

`openpi-client` needs numpy before 2, so it is installed in an environment of its own, at --venv. The client is its
unchanged `WebsocketClientPolicy`; the chunk must equal the plan that this package makes in this process. It is asked
twice, with a key and without a server restart, then with garbage, whose error it must show. Options after `--` go to
`rip serve`; without any, it plans with `neighbours`, which needs no language model.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

import numpy as np
from serving import running_server

from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.policies import Neighbours

PACKAGES = ("openpi-client==0.1.2", "typing_extensions")  # it imports the second without asking for it
KEY = "a-key-for-this-check"
CLIENT = """
import sys

import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy

address, key, observation, out = sys.argv[1:]
policy = WebsocketClientPolicy(f"ws://{address}", api_key=key)
print("metadata:", {name: policy.get_server_metadata()[name] for name in ("policy", "task", "num_demonstrations")})
with np.load(observation) as arrays:
    seen = {f"observation/{name}": array for name, array in arrays.items()}
for _ in range(2):
    answer = policy.infer({**seen, "prompt": "push the cube to the goal"})
    print("actions", answer["actions"].shape, "confidence", answer["confidence"], answer["server_timing"])
np.save(out, answer["actions"])
try:
    policy.infer({"prompt": "no image"})
except RuntimeError as error:
    print("refused:", str(error).splitlines()[-1])
else:
    sys.exit("an observation without an image was answered")
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--demos", type=Path, required=True)
    parser.add_argument("--observation", type=Path, required=True)
    parser.add_argument("--venv", type=Path, default=Path(tempfile.gettempdir()) / "openpi-venv")
    parser.add_argument("serve", nargs="*", help="options of rip serve, after --")
    options = parser.parse_args()
    python = environment(options.venv)
    os.environ["RIP_SERVE_KEY"] = KEY
    serve = options.serve or ["--method", "neighbours", "--min-confidence", "0"]
    with tempfile.TemporaryDirectory() as scratch, running_server(options.demos, *serve) as (address, _):
        chunk = Path(scratch) / "chunk.npy"
        subprocess.run([python, "-c", CLIENT, address, KEY, options.observation, chunk], check=True)
        received = np.load(chunk)
    if not options.serve:
        own = Neighbours().fit(load_demonstrations(options.demos)).plan(Observation.load(options.observation))
        if not np.array_equal(received, own.trajectory.actions):
            sys.exit("the chunk is not the plan that this package makes itself")
    print(f"{PACKAGES[0]} got the chunk")


def environment(folder: Path) -> Path:
    """Interpreter of an environment with openpi's client, created if it is missing."""
    python = folder / "bin" / "python"
    if not python.exists():
        venv.create(folder, with_pip=True)
    if subprocess.run([python, "-c", "import openpi_client.websocket_client_policy"], capture_output=True).returncode:
        print(f"installing {PACKAGES[0]} into {folder}", flush=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", *PACKAGES], check=True)
    return python


if __name__ == "__main__":
    main()
