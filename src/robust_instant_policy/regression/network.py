"""The paper's own estimator: a mean and a scale network trained on Eq. 2 (Oh et al. 2025, Eq. 1-4 and Table II).

Two networks with two hidden layers of 64 map the time to μ(t) and σ(t). The paper leaves open the activation (here
ReLU), the output of the variance network (softplus) and the scaling of the data (standardised by dimension).

Two ways of training minimise the same loss over the same networks: the paper's, Adam on mini-batches with the step
count of Table II; and a faster one, full batches with Adam and then L-BFGS, from a start at which the kinks of the
first layer are spread over the trajectory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaln

from robust_instant_policy.checks import check_name, checked_array, checked_positive, checked_whole
from robust_instant_policy.errors import InvalidValueError, MissingExtraError, UsageError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.regression.candidates import Candidates
from robust_instant_policy.regression.em import DEFAULT_DOF, expected_precision
from robust_instant_policy.regression.likelihood import effective_count

HIDDEN = (64, 64)  # units, Table II
BATCH = 64  # samples, Table II
SCALE_FLOOR = 1e-3  # standard deviations of a dimension: keeps the loss finite where candidates coincide
WARM_STEPS = 2000  # of Adam in full batches
WARM_RATE = 1e-2  # learning rate of these
QUASI_NEWTON_STEPS = 1000  # of L-BFGS afterwards, at most
QUASI_NEWTON_CHUNK = 50  # steps between checks of the loss
QUASI_NEWTON_GAIN = 2e-3  # loss gained in a chunk below which training ends
QUASI_NEWTON_MEMORY = 20  # past steps that L-BFGS keeps
FIRST_SLOPES = (2.0, 6.0)  # of the first layer at the fast start: a kink acts over a fraction of the trajectory
MAX_SEED = 2**63  # torch's generator takes no more


@dataclass(frozen=True)
class Recipe:
    """One column of the paper's Table II."""

    steps: int
    learning_rate: float


RECIPES = {"sim": Recipe(steps=40_000, learning_rate=1e-2), "real": Recipe(steps=100_000, learning_rate=5e-2)}


class StudentTNetwork:
    """The paper's Student's t-regression by two networks, with the interface of `StudentTRegression`.

    ``recipe`` is "sim" or "real", the columns of the paper's Table II, trained exactly as there; or "fast", the same
    networks and loss with better steps. ``seed`` fixes initial parameters and batches. ``target`` stops the
    training as soon as the loss over all samples reaches it (checked every hundred steps).

    After `fit`: ``loss``, the mean of Eq. 2 over all numbers at the end; ``num_iterations``; ``weights``; ``knots``.
    Needs the extra "train" (torch).
    """

    def __init__(self, dof: float = DEFAULT_DOF, recipe: str = "fast", seed: int = 0, target: float | None = None):
        check_name("recipe", recipe, (*RECIPES, "fast"))
        if target is not None and (isinstance(target, bool) or not isinstance(target, Real) or np.isnan(target)):
            raise InvalidValueError(f"target must be a number or None, got {target!r} ({type(target).__name__})")
        self.dof = checked_positive("dof", dof, infinite=True)
        self.recipe, self.seed, self.target = recipe, checked_whole("seed", seed), target

    def fit(self, candidates: Sequence[ArrayLike], times: Sequence[ArrayLike] | None = None) -> StudentTNetwork:
        """Fit to ``candidates``, each ``(T_q, D)``, at ``times``, each ``(T_q,)`` in [0, 1] (evenly spread if None)."""
        torch = _torch()
        data = Candidates.from_arrays(candidates, times)
        self.knots = data.grid()
        self._center = data.values.mean(axis=0)
        unit = data.values.std(axis=0)
        self._unit = np.where(unit > 0, unit, 1.0)
        inputs = torch.tensor(data.times[:, None], dtype=torch.float32)
        targets = torch.tensor((data.values - self._center) / self._unit, dtype=torch.float32)
        generator = torch.Generator().manual_seed(self.seed % MAX_SEED)
        self._networks = [_network(torch, data.num_dimensions, generator) for _ in range(2)]
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # networks this small are slower on several threads
        try:
            if self.recipe == "fast":
                self.num_iterations = self._train_fast(inputs, targets, generator)
            else:
                self.num_iterations = self._train_adam(inputs, targets, RECIPES[self.recipe], generator)
            with torch.no_grad():
                self.loss = float(self._loss(inputs, targets))
        finally:
            torch.set_num_threads(threads)
        residuals = (data.values - self.mean(data.times)) / self.scale(data.times)
        weights = np.minimum(expected_precision((residuals**2).mean(axis=1), self.dof), 1.0)
        self.weights = data.split(weights)
        at_knots = [np.interp(self.knots, c, w) for c, w in zip(data.split(data.times), self.weights, strict=True)]
        self._deciding = effective_count(np.stack(at_knots))
        return self

    def mean(self, times: ArrayLike | None = None) -> FloatArray:
        """The robust trajectory μ ``(T, D)`` at ``times (T,)``, by default at the knots (Oh et al. 2025, Eq. 4)."""
        values = self._evaluate(lambda inputs: self._networks[0](inputs), times)
        return values * self._unit + self._center

    def scale(self, times: ArrayLike | None = None) -> FloatArray:
        """The scale σ ``(T, D)`` of trustworthy candidates about the mean at ``times (T,)``."""
        values = self._evaluate(self._scale, times)
        return values * self._unit

    def standard_error(self, times: ArrayLike | None = None) -> FloatArray:
        """How far ``(T, D)`` the mean may be off: the scale over the root of the candidates that decide it."""
        at = self._at(times)
        if len(self.weights) == 1:
            return np.full((len(at), len(self._unit)), np.inf)
        return self.scale(at) / np.sqrt(np.interp(at, self.knots, self._deciding))[:, None]

    def _at(self, times: ArrayLike | None) -> FloatArray:
        if not hasattr(self, "knots"):
            raise UsageError("nothing is fitted yet; call fit(candidates) first")
        return self.knots if times is None else checked_array("times", times, "(T,)")

    def _evaluate(self, function: Callable[[Any], Any], times: ArrayLike | None) -> FloatArray:
        torch, at = _torch(), self._at(times)
        with torch.no_grad():
            return function(torch.tensor(at[:, None], dtype=torch.float32)).numpy().astype(np.float64)

    def _scale(self, inputs: Any) -> Any:
        return _torch().nn.functional.softplus(self._networks[1](inputs)) + SCALE_FLOOR

    def _loss(self, inputs: Any, targets: Any) -> Any:
        """-log S of Eq. 1, mean over all numbers: Eq. 2 over its count (see `em.log_density`)."""
        scale = self._scale(inputs)
        squares = ((targets - self._networks[0](inputs)) / scale) ** 2
        if np.isinf(self.dof):
            return (0.5 * squares + scale.log()).mean() + 0.5 * np.log(2 * np.pi)
        constant = gammaln((self.dof + 1) / 2) - gammaln(self.dof / 2) - 0.5 * np.log(self.dof * np.pi)
        return (0.5 * (self.dof + 1) * (squares / self.dof).log1p() + scale.log()).mean() - constant

    def _train_adam(self, inputs: Any, targets: Any, recipe: Recipe, generator: Any) -> int:
        torch = _torch()
        optimiser = torch.optim.Adam(self._parameters(), lr=recipe.learning_rate)
        for step in range(recipe.steps):
            batch = torch.randint(len(inputs), (BATCH,), generator=generator)
            optimiser.zero_grad()
            self._loss(inputs[batch], targets[batch]).backward()
            optimiser.step()
            if self.target is not None and step % 100 == 0:
                with torch.no_grad():
                    if self._loss(inputs, targets) <= self.target:
                        return step + 1
        return recipe.steps

    def _train_fast(self, inputs: Any, targets: Any, generator: Any) -> int:
        torch = _torch()
        for network in self._networks:
            _spread_kinks(torch, network[0], generator)
        adam = torch.optim.Adam(self._parameters(), lr=WARM_RATE)
        for step in range(WARM_STEPS):
            adam.zero_grad()
            loss = self._loss(inputs, targets)
            if self.target is not None and loss.detach() <= self.target:
                return step
            loss.backward()
            adam.step()
        return WARM_STEPS + self._train_quasi_newton(inputs, targets)

    def _train_quasi_newton(self, inputs: Any, targets: Any) -> int:
        optimiser = _torch().optim.LBFGS(
            self._parameters(),
            max_iter=QUASI_NEWTON_CHUNK,
            max_eval=2 * QUASI_NEWTON_CHUNK,
            tolerance_grad=0.0,
            tolerance_change=0.0,
            history_size=QUASI_NEWTON_MEMORY,
            line_search_fn="strong_wolfe",
        )

        def closure() -> Any:
            optimiser.zero_grad()
            loss = self._loss(inputs, targets)
            loss.backward()
            return loss

        reached = np.inf
        steps = 0
        while steps < QUASI_NEWTON_STEPS:
            optimiser.step(closure)
            steps += QUASI_NEWTON_CHUNK
            previous, reached = reached, float(closure().detach())
            if self.target is not None and reached <= self.target:
                break
            if self.target is None and previous - reached < QUASI_NEWTON_GAIN:
                break
        return steps

    def _parameters(self) -> list[Any]:
        return [parameter for network in self._networks for parameter in network.parameters()]


def _network(torch: Any, outputs: int, generator: Any) -> Any:
    """Network from time to ``outputs``, initialised as torch does but from ``generator``, not from the global seed."""
    widths = (1, *HIDDEN, outputs)
    layers: list[Any] = []
    for inward, outward in pairwise(widths):
        layer = torch.nn.utils.skip_init(torch.nn.Linear, inward, outward)
        with torch.no_grad():
            for parameter in layer.parameters():
                parameter.uniform_(-(inward**-0.5), inward**-0.5, generator=generator)
        layers += [layer, torch.nn.ReLU()]
    return torch.nn.Sequential(*layers[:-1])


def _spread_kinks(torch: Any, layer: Any, generator: Any) -> None:
    """Draw the time at which each unit of the first layer switches on uniformly from [0, 1]."""
    slopes = torch.empty(len(layer.bias)).uniform_(*FIRST_SLOPES, generator=generator)
    with torch.no_grad():
        layer.weight.copy_((torch.sign(layer.weight[:, 0]) * slopes)[:, None])
        layer.bias.copy_(-layer.weight[:, 0] * torch.rand(len(slopes), generator=generator))


def _torch() -> Any:
    try:
        import torch
    except ImportError:
        raise MissingExtraError("torch", "train") from None
    return torch
