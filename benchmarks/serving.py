"""Load test of `rip serve`: many clients for minutes, some of which misbehave; nothing may grow.

    python benchmarks/serving.py --demos data/push-cube --observation observation.npz --clients 32 --minutes 5

Each client connects, asks, and hangs up, again and again, over openpi's protocol. One in eight sends garbage, one in
eight an oversized message, one in eight hangs up before the answer; the others must get a chunk. The server plans with
`neighbours` (no language model), so that it is the server that is measured; other options after `--` go to `rip serve`.
Memory, threads and open files of the server are taken every 5 s. Exits with 1 if a client got another answer than
it should, or if the last third of the run needs more than the second one. The result goes to results/serving.json.
"""

from __future__ import annotations

import argparse
import json
import re
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import psutil
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from robust_instant_policy.demonstration import ARRAYS, Observation
from robust_instant_policy.serving.messages import pack, unpack

OUT = Path(__file__).parents[1] / "results" / "serving.json"
SAMPLE_S = 5.0  # between two looks at the server
TIMEOUT_S = 300.0  # for one answer
OVERSIZED_BYTES = 65 << 20
MAX_GROWTH_MIB, MAX_MORE_THREADS, MAX_MORE_FILES = 30.0, 2, 4  # of the last third over the second one


@contextmanager
def running_server(demos: Path, *options: str) -> Iterator[tuple[str, int]]:
    """`rip serve` as a process of its own; gives its address and process id, and ends it with Ctrl-C."""
    command = [sys.executable, "-m", "robust_instant_policy.cli", "serve", "--demos", str(demos), "--port", "0"]
    with subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        lines = iter(process.stdout.readline, "")
        address = next((found[1] for line in lines if (found := re.search(r"ws://(\S+)", line))), None)
        if address is None:
            sys.exit("rip serve did not start")
        try:
            yield address, process.pid
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(60)


class Client(threading.Thread):
    """Asks until ``end``; what it got is counted in ``outcomes``, with the latencies of good answers in seconds."""

    def __init__(self, number: int, address: str, observation: Observation, end: float):
        super().__init__(daemon=True)
        self.address, self.end = address, end
        self.good = pack({name: getattr(observation, name) for name in ARRAYS})
        self.outcomes: Counter[str] = Counter()
        self.latencies: list[float] = []
        self.rng = np.random.default_rng(number)

    def run(self) -> None:
        while time.monotonic() < self.end:
            manner = self.rng.choice(["garbage", "oversized", "hangs up", *["good"] * 5])
            try:
                self.outcomes[f"{manner}: {self.ask(manner)}"] += 1
            except (OSError, ConnectionClosed, TimeoutError, ValueError) as error:
                self.outcomes[f"{manner}: {type(error).__name__}"] += 1

    def ask(self, manner: str) -> str:
        message = {"garbage": b"\xc1garbage", "oversized": bytes(OVERSIZED_BYTES)}.get(manner, self.good)
        with connect(f"ws://{self.address}", max_size=None, compression=None, open_timeout=60) as client:
            client.recv(timeout=TIMEOUT_S)
            start = time.monotonic()
            client.send(message)
            if manner == "hangs up":
                return "hung up"
            answer = client.recv(timeout=TIMEOUT_S)
            if isinstance(answer, str):
                return "error in one line" if len(answer.splitlines()) == 1 else "error in several lines"
            if unpack(answer)["actions"].ndim != 2:
                return "no chunk"
            self.latencies.append(time.monotonic() - start)
            return "chunk"


EXPECTED = {"good: chunk", "garbage: error in one line", "oversized: error in one line", "hangs up: hung up"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--demos", type=Path, required=True)
    parser.add_argument("--observation", type=Path, required=True)
    parser.add_argument("--clients", type=int, default=32)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("serve", nargs="*", help="options of rip serve, after --")
    options = parser.parse_args()
    observation = Observation.load(options.observation)
    serve = options.serve or ["--method", "neighbours", "--min-confidence", "0"]
    with running_server(options.demos, *serve) as (address, pid):
        end = time.monotonic() + 60 * options.minutes
        clients = [Client(number, address, observation, end) for number in range(options.clients)]
        for client in clients:
            client.start()
        server, samples = psutil.Process(pid), []
        while any(client.is_alive() for client in clients):
            time.sleep(SAMPLE_S)
            samples.append((server.memory_info().rss / 2**20, server.num_threads(), server.num_fds()))
    outcomes = sum((client.outcomes for client in clients), Counter())
    latencies = np.array([seconds for client in clients for seconds in client.latencies])
    thirds = np.array_split(np.array(samples), 3)
    peaks = [third.max(axis=0).tolist() for third in thirds]
    growth = (np.median(thirds[2], axis=0) - np.median(thirds[1], axis=0)).tolist()
    limits = (MAX_GROWTH_MIB, MAX_MORE_THREADS, MAX_MORE_FILES)
    grown = [
        name for name, more, limit in zip(("memory", "threads", "files"), growth, limits, strict=True) if more > limit
    ]
    wrong = {outcome: count for outcome, count in outcomes.items() if outcome not in EXPECTED}
    result = {
        "clients": options.clients,
        "minutes": options.minutes,
        "outcomes": dict(sorted(outcomes.items())),
        "wrong": wrong,
        "latency_s": {str(q): round(float(np.quantile(latencies, q / 100)), 3) for q in (50, 95, 100)},
        "peaks_of_thirds": {"MiB, threads, files": peaks},
        "growth_of_median": {"MiB, threads, files": growth},
    }
    print(json.dumps(result, indent=2))
    OUT.write_text(json.dumps(result, indent=2) + "\n")
    if grown or wrong:
        sys.exit(f"grown: {', '.join(grown) or 'nothing'}; unexpected answers: {wrong or 'none'}")


if __name__ == "__main__":
    main()
