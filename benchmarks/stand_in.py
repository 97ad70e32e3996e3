"""A stand-in for a language model: it regresses on the examples of the prompt, and agrees with itself as told.

It is no language model. It reads the text that one would read, and nothing else, so that plans can be made in a
fraction of a second and how far its answers agree is known.

`StandIn` answers the factorised layout inside the process: with ``spread`` 0 all answers are equal, which is what a
confident model that is wrong looks like; with 1 each comes from a bootstrap of the examples. A share ``hallucinated``
of the candidates is displaced as a whole.

`Server` answers the paper's layout (whole trajectories in the world frame) over HTTP, in OpenAI's protocol:

    python benchmarks/stand_in.py --port 8765
    rip eval --config paper --llm http://127.0.0.1:8765/v1#stand-in-20 …

A Gaussian process from the examples' keypoints to their trajectories infers the trajectory of the new keypoints. An
answer is that with the noise of `contaminated_trajectories.noisy`, and in 20% of the cases (the number behind the name;
each answer by itself) hallucinated as a whole, in one of the kinds of `contaminated_trajectories.KINDS`. Equal seeds
give equal answers, and with a lower rate a part of the same ones is hallucinated.
"""

from __future__ import annotations

import argparse
import json
import re
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np
from contaminated_trajectories import KINDS, NOTICEABLE_M, noisy

from robust_instant_policy.context.alignment import align
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.llm.endpoint import SHORT
from robust_instant_policy.llm.model import NOBODY, Listener, Sampling, Tally, estimate_tokens
from robust_instant_policy.policies.gp import GaussianProcess
from robust_instant_policy.query import Answer, Query
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX, Trajectory

HALLUCINATION_MM = 50.0  # standard deviation of the displacement of a hallucinated candidate
RIDGE_MM = 20.0  # variation of an input below which it explains nothing
MM = 1000.0  # per metre
REACH_M = 4.9  # answers with larger numbers are refused, and would not count
NAME = "stand-in"


class StandIn:
    """Answers a query of the factorised layout by ridge regression on its examples."""

    context_length = None

    def __init__(self, spread: float = 0.0, hallucinated: float = 0.0):
        self.spread, self.hallucinated = spread, hallucinated
        self.name = f"stand-in, no language model, spread {spread:g}, hallucinated {hallucinated:g}"

    def count_tokens(self, text: str) -> int:
        return estimate_tokens(text)

    def sample(self, queries: Sequence[Query], sampling: Sampling, listener: Listener = NOBODY) -> list[list[Answer]]:
        tally = Tally(len(queries), sampling, listener)
        scene = zlib.crc32("".join(query.text for query in queries).encode())
        for number, query in enumerate(queries):
            rows = [np.array(line.split(), dtype=float) for line in query.text.splitlines()]
            inputs, outputs, new = np.array(rows[0:-1:2]), np.array(rows[1:-1:2]), rows[-1]
            for index in sampling.indices:
                rng = np.random.default_rng([sampling.seed, number, index])
                chosen = np.arange(len(inputs))
                if self.spread and rng.random() < self.spread:
                    chosen = rng.choice(len(inputs), len(inputs))
                answer = regress(inputs[chosen], outputs[chosen], new)
                candidate = np.random.default_rng([scene, index])  # the same for all queries of a candidate
                if candidate.random() < self.hallucinated:
                    binary = np.isin(outputs, (-1, 0, 1)).all(axis=0)
                    answer = answer + np.where(binary, 0.0, candidate.normal(0, HALLUCINATION_MM))
                tally.add(number, index, Answer(" ".join(str(round(value)) for value in answer)))
        return tally.answers()

    def close(self) -> None: ...


def regress(inputs: np.ndarray, outputs: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Ridge regression of ``outputs (I, D)`` on ``inputs (I, P)`` at ``new (P,)``; gripper states stay whole."""
    centre, middle = inputs.mean(axis=0), outputs.mean(axis=0)
    x = inputs - centre
    slope = np.linalg.solve(x.T @ x + len(x) * RIDGE_MM**2 * np.eye(x.shape[1]), x.T @ (outputs - middle))
    found = middle + (new - centre) @ slope
    binary = np.isin(outputs, (-1, 0, 1)).all(axis=0)
    return np.where(binary, np.clip(np.rint(found), outputs.min(axis=0), outputs.max(axis=0)), found)


@dataclass(frozen=True, eq=False)
class Examples:
    """The examples of a prompt: their trajectories, and what is inferred from them."""

    trajectories: tuple[Trajectory, ...]
    process: GaussianProcess
    shape: tuple[int, ...]

    def infer(self, keypoints: FloatArray) -> Trajectory:
        """The trajectory for ``keypoints (3·K,)`` in millimetres."""
        actions = self.process.predict(keypoints[None] / MM)[0].reshape(self.shape)
        state = actions[:, STATE_INDEX::ACTION_DIM]
        actions[:, STATE_INDEX::ACTION_DIM] = state > 0.5
        lengths = [len(one) for one in self.trajectories]
        steps = int(np.clip(len(actions), min(lengths), max(lengths)))
        return Trajectory.from_actions(actions).resampled(np.linspace(0, 1, steps))


@dataclass(frozen=True, eq=False)
class Path:
    """One arm's ``actions (T, 10)`` at ``times (T,)`` as a `contaminated_trajectories.Motion`."""

    times: FloatArray
    actions: FloatArray

    def __call__(self, times: FloatArray) -> FloatArray:
        found = np.stack([np.interp(times, self.times, column) for column in self.actions.T], axis=1)
        found[:, STATE_INDEX] = found[:, STATE_INDEX] > 0.5
        return found


@lru_cache(maxsize=64)
def read_examples(text: str) -> Examples:
    """Blocks of a line of keypoints and a line for each step, with an empty line after each; see `SequencePrompt`.

    Raises `ValueError` for other text.
    """
    blocks = [block.splitlines() for block in text.strip().split("\n\n")]
    if not all(len(block) > 1 for block in blocks):
        raise ValueError("it shows no examples: blocks of a line of keypoints and a line for each step")
    keypoints = np.array([block[0].split() for block in blocks], dtype=float) / MM
    trajectories = []
    for block in blocks:
        rows = np.array([line.split() for line in block[1:]], dtype=float)
        states = rows[:, STATE_INDEX::ACTION_DIM].copy()
        rows /= MM
        rows[:, STATE_INDEX::ACTION_DIM] = states
        trajectories.append(Trajectory.from_actions(rows))
    aligned = align(trajectories)
    outputs = aligned.actions.reshape(len(aligned.kept), -1)
    process = GaussianProcess.fitted(keypoints[list(aligned.kept)], outputs)
    return Examples(tuple(trajectories), process, aligned.actions.shape[1:])


def answer(prompt: str, seed: int, rate: float) -> str:
    """One answer to ``prompt``, hallucinated with probability ``rate``. Raises `ValueError` without examples."""
    if prompt.strip() == SHORT.text:  # the check of an address before any plan
        return "4\n"
    shown, _, new = prompt.strip().rpartition("\n\n")
    examples = read_examples(shown)
    right = examples.infer(np.array(new.split(), dtype=float))
    rng = np.random.default_rng([zlib.crc32(prompt.encode()), seed])
    actions = right.actions.copy()
    if rng.random() < rate:
        kind = KINDS[list(KINDS)[rng.integers(len(KINDS))]]
        other = examples.trajectories[rng.integers(len(examples.trajectories))]
        actions = hallucinated(rng, kind, right, other)
    arms = np.split(actions, actions.shape[1] // ACTION_DIM, axis=1)
    rows = np.hstack([noisy(rng, arm, 1.0) for arm in arms])
    rows = np.where(np.arange(rows.shape[1]) % ACTION_DIM == STATE_INDEX, rows, MM * rows)
    return "".join(" ".join(str(round(number)) for number in row) + "\n" for row in rows)


def hallucinated(rng: np.random.Generator, kind: Callable[..., FloatArray], right: Trajectory, other: Trajectory):
    """Actions ``(T, 10·A)`` that are wrong in one ``kind`` of `KINDS`, by more than `NOTICEABLE_M` somewhere.

    ``other`` is the trajectory of an example.
    """
    while True:
        arms = []
        for start in range(0, right.actions.shape[1], ACTION_DIM):
            columns = slice(start, start + ACTION_DIM)
            of_arm = [Path(one.times, one.actions[:, columns]) for one in (right, other)]
            arms.append(kind(rng, of_arm[0], right.times, of_arm[1]))
        actions = np.hstack(arms)
        moved = np.abs(actions - right.actions)[:, np.arange(actions.shape[1]) % ACTION_DIM != STATE_INDEX]
        if moved.max() > NOTICEABLE_M and np.abs(actions).max() < REACH_M:
            return actions


class Server(ThreadingHTTPServer):
    """Serves `answer` at ``http://127.0.0.1:port/v1`` (a free port by default); models are called stand-in-RATE."""

    daemon_threads = True

    def __init__(self, port: int = 0):
        super().__init__(("127.0.0.1", port), _Handler)
        self.url = f"http://127.0.0.1:{self.server_address[1]}/v1"


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        known = self.path == "/v1/models"
        if known:
            self._send({"data": [{"id": f"{NAME}-{rate}"} for rate in range(0, 101, 10)]})
        else:
            self._refuse(404, "no such path; models are listed at /v1/models")

    def do_POST(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        named = re.fullmatch(rf"{NAME}-(\d+)", str(body.get("model")))
        if self.path not in ("/v1/chat/completions", "/v1/completions") or named is None or int(named[1]) > 100:
            self._refuse(404, f"no such model or path; models are {NAME}-0 to {NAME}-100")
            return
        chat = self.path == "/v1/chat/completions"
        prompt = body["messages"][-1]["content"] if chat else body["prompt"]
        try:
            texts = [answer(prompt, body.get("seed", 0) + k, int(named[1]) / 100) for k in range(body.get("n", 1))]
        except ValueError as error:
            self._refuse(400, f"the prompt cannot be answered: {error}")
            return
        choices = [
            {"index": k, "finish_reason": "stop"} | ({"message": {"content": text}} if chat else {"text": text})
            for k, text in enumerate(texts)
        ]
        usage = {
            "prompt_tokens": estimate_tokens(prompt),
            "completion_tokens": sum(estimate_tokens(text) for text in texts),
        }
        self._send({"choices": choices, "usage": usage})

    def _refuse(self, status: int, message: str) -> None:
        self._send({"error": {"message": message, "type": "invalid_request_error"}}, status)

    def _send(self, body: dict[str, Any], status: int = 200) -> None:
        content = json.dumps(body).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: object) -> None: ...


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--port", type=int, default=8765)
    server = Server(parser.parse_args().port)
    print(f"{server.url}#{NAME}-20", flush=True)
    server.serve_forever()


if __name__ == "__main__":
    main()
