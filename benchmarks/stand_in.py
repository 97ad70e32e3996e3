"""A stand-in for a language model: it regresses on the examples of the prompt, and agrees with itself as told.

It is no language model. It reads the text that one would read, so that plans can be made in a fraction of a second and
how far its answers agree is known: with ``spread`` 0 all of them are equal, which is what a confident model that is
wrong looks like; with 1 each answer comes from a bootstrap of the examples. A share ``hallucinated`` of the candidates
is displaced as a whole.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np

from robust_instant_policy.llm.model import NOBODY, Listener, Sampling, Tally, estimate_tokens
from robust_instant_policy.query import Answer, Query

HALLUCINATION_MM = 50.0  # standard deviation of the displacement of a hallucinated candidate
RIDGE_MM = 20.0  # variation of an input below which it explains nothing


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
