"""The paper's own recipe: a mean network and a variance network trained with Adam (Oh et al. 2025, Eq. 2-3)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from robust_instant_policy.errors import MissingExtraError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.regression.alignment import Candidates, checked_dof
from robust_instant_policy.regression.student_t import DEFAULT_DOF, expected_precision

HIDDEN = 64
BATCH = 64


class StudentTNetwork:
    def __init__(self, dof: float = DEFAULT_DOF, steps: int = 40_000, learning_rate: float = 1e-2, seed: int = 0):
        self.dof = checked_dof(dof)
        self.steps, self.learning_rate, self.seed = steps, learning_rate, seed

    def fit(self, candidates: Sequence[ArrayLike], times: Sequence[ArrayLike] | None = None) -> StudentTNetwork:
        torch = _torch()
        data = Candidates.from_arrays(candidates, times)
        generator = torch.Generator().manual_seed(self.seed)
        self._center = data.values.mean(axis=0)
        self._unit = np.maximum(data.values.std(axis=0), 1e-9)
        inputs = torch.tensor(data.times[:, None], dtype=torch.float32)
        targets = torch.tensor((data.values - self._center) / self._unit, dtype=torch.float32)
        with torch.random.fork_rng():
            torch.manual_seed(self.seed)
            self._nets = [
                torch.nn.Sequential(
                    torch.nn.Linear(1, HIDDEN),
                    torch.nn.ReLU(),
                    torch.nn.Linear(HIDDEN, HIDDEN),
                    torch.nn.ReLU(),
                    torch.nn.Linear(HIDDEN, data.num_dimensions),
                )
                for _ in range(2)
            ]
        optimiser = torch.optim.Adam([p for net in self._nets for p in net.parameters()], lr=self.learning_rate)
        for _ in range(self.steps):
            batch = torch.randint(len(inputs), (BATCH,), generator=generator)
            loss = self._loss(inputs[batch], targets[batch])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        self.knots = data.grid()
        residual = (data.values - self.mean(data.times)) / self.scale(data.times)
        weights = expected_precision(residual**2, self.dof).mean(axis=1)
        self.weights = data.split(np.minimum(weights, 1.0))
        return self

    def _loss(self, inputs: Any, targets: Any) -> Any:
        torch = _torch()
        mean = self._nets[0](inputs)
        scale = torch.nn.functional.softplus(self._nets[1](inputs)) + 1e-4
        if np.isinf(self.dof):
            return -torch.distributions.Normal(mean, scale).log_prob(targets).mean()
        return -torch.distributions.StudentT(self.dof, mean, scale).log_prob(targets).mean()

    def mean(self, times: ArrayLike | None = None) -> FloatArray:
        torch = _torch()
        with torch.no_grad():
            raw = self._nets[0](torch.tensor(self._times(times)[:, None], dtype=torch.float32)).numpy()
        return raw * self._unit + self._center

    def scale(self, times: ArrayLike | None = None) -> FloatArray:
        torch = _torch()
        with torch.no_grad():
            raw = self._nets[1](torch.tensor(self._times(times)[:, None], dtype=torch.float32))
            return (torch.nn.functional.softplus(raw) + 1e-4).numpy() * self._unit

    def _times(self, times: ArrayLike | None) -> FloatArray:
        return self.knots if times is None else np.asarray(times, dtype=np.float64)


def _torch() -> Any:
    try:
        import torch
    except ImportError:
        raise MissingExtraError("torch", "train") from None
    return torch
