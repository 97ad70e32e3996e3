"""How well frames predict a demonstration from the others.

Ridge regression gives the numbers w of each candidate (`candidates`), and its hat matrix H the residuals of each
demonstration when it is left out,

    (I - H_ii)⁻¹ r_i        (Allen 1974)

for all candidates and steps at once (the keypoints of the one that is left out are noisy, too). The hand's turn is
predicted by the mean of the others' in the axes.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.context.candidates import NOISE_M, Candidates
from robust_instant_policy.context.things import DEMOS_TO_TELL_THINGS, WORLD
from robust_instant_policy.geometry import FloatArray

PARAMETER_COST = 0.04  # of a fitted number, in logarithms of the error
USUAL_DEMOS = 10  # for which that cost holds; it is higher for fewer
# Expected error of a single demonstration, a metre to a thing that is seen in its own axes, and to one that has none.
DISTANCE_SHARE, UNTURNED_SHARE = 0.05, 0.3


@dataclass(frozen=True, eq=False)
class ShownHands:
    """One arm's hand as I demonstrations show it: ``points (I, T, 3, 3)``, the gripper's three points at T steps.

    Those of a ``second (I,)`` way, where there are two, have an offset and a turn of their own in the same frames.
    """

    points: FloatArray
    second: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.points)

    @property
    def centre(self) -> FloatArray:
        """``(I, T, 3)``."""
        return self.points.mean(axis=2)

    @property
    def home(self) -> FloatArray:
        """The mean place ``(3,)`` at the first step."""
        return self.centre[:, 0].mean(axis=0)

    @property
    def shape(self) -> FloatArray:
        """The points about the centre ``(I, T, 3, 3)``."""
        return self.points - self.centre[:, :, None]

    def from_mean(self, values: FloatArray, others: bool = False) -> FloatArray:
        """``values (M, I, ...)`` less the mean of the demonstrations of the same way, or of the ``others`` of it."""
        rest = np.empty_like(values)
        for way in (slice(None),) if self.second is None else (~self.second, self.second):
            own = values[:, way]
            count = own.shape[1]
            rest[:, way] = (own - own.mean(axis=1, keepdims=True)) * (count / max(count - 1, 1) if others else 1.0)
        return rest


@dataclass(frozen=True, eq=False)
class Errors:
    """What each combination predicts: ``squared (T, M, N, I)``, square metres, is the error of each demonstration from
    the others, ``penalty (M, N)`` the cost of its fitted numbers, in logarithms of the error."""

    squared: FloatArray
    penalty: FloatArray

    @property
    def cost(self) -> FloatArray:
        """``(T, M, N)``: the mean logarithm of the error, on which a single bad demonstration has little influence."""
        few = max(1.0, USUAL_DEMOS / self.squared.shape[-1])  # a number fitted to few demonstrations misleads more
        return 0.5 * np.log(self.squared + NOISE_M**2).mean(axis=-1) + few * self.penalty

    @property
    def mean_squared(self) -> FloatArray:
        """``(T, M, N)``, square metres, raised by the cost: every demonstration has to be explained."""
        return self.squared.mean(axis=-1) * np.exp(2 * self.penalty)


def prediction_errors(candidates: Candidates, hands: ShownHands) -> Errors:
    """Leave-one-out errors of all ``candidates`` for one arm's ``hands``."""
    demos = len(hands)
    start, design, penalty = candidates.model(hands.home, hands.second)
    m, n, _, _, p = design.shape
    flat = design.reshape(m, n, 3 * demos, p)
    gram = np.swapaxes(flat, -1, -2) @ flat + np.diag(penalty)
    hat = flat @ np.linalg.solve(gram, np.swapaxes(flat, -1, -2))
    offset = (hands.centre[None] - start[:, :, None]).transpose(0, 1, 3, 2)  # (N, I, 3, T)
    target = offset.reshape(n, 3 * demos, -1)
    residual: np.ndarray = (target - hat @ target).reshape(m, n, demos, 3, -1)
    if demos >= DEMOS_TO_TELL_THINGS - 1:
        own = hat.reshape(m, n, demos, 3, demos, 3)[:, :, np.arange(demos), :, np.arange(demos)]  # (I, M, N, 3, 3)
        residual = np.linalg.solve(np.eye(3) - np.moveaxis(own, 0, 2), residual)
    place = np.moveaxis((residual**2).sum(axis=3), -1, 0)  # (T, M, N, I)
    rest = hands.from_mean(np.einsum("miyx,itpy->mitpx", candidates.rotations(), hands.shape), others=True)
    turn = np.moveaxis((rest**2).sum(axis=-1).mean(axis=-1), -1, 0)  # (T, M, I)
    squared = place + turn[:, :, None]
    if demos < DEMOS_TO_TELL_THINGS:
        return Errors(squared * (demos > 1) + _guess(candidates, offset, demos), np.zeros((m, n)))
    fitted = np.trace(hat, axis1=-2, axis2=-1) + 2 * np.array([[len(axes.ends) - 1] for axes in candidates.axes])
    fitted = fitted + np.array([[axes.ends[0].thing is not WORLD] for axes in candidates.axes])
    return Errors(squared, PARAMETER_COST * (fitted + (0 if hands.second is None else 3)))


def _guess(candidates: Candidates, offset: FloatArray, demos: int) -> FloatArray:
    """Expected squared error ``(T, M, N, I)`` where demonstrations are too few to tell.

    The keypoints' noise, carried to the hand at ``offset (N, I, 3, T)``, and a share of its distance. A thing is seen
    in its own axes.
    """
    distance = np.linalg.norm(offset, axis=2)  # (N, I, T)
    noise = np.full(distance.shape, NOISE_M**2)
    suits = np.zeros((len(candidates.axes), len(candidates.origins)))
    for index, origin in enumerate(candidates.origins):
        thing = origin.ends[0]
        if thing.shape is not None:
            radius = max(((thing.shape - thing.shape.mean(axis=0)) ** 2).sum(), NOISE_M**2)
            noise[index] = NOISE_M**2 * (1 / len(thing.shape) + distance[index] ** 2 / radius)
        for row, axes in enumerate(candidates.axes):
            own = axes.ends[0].thing
            suits[row, index] = 0.0 if own is thing or (own is WORLD and not thing.turns) else np.inf
    turning = np.array([origin.ends[0].turns or origin.ends[0] is WORLD for origin in candidates.origins])
    share = np.where(turning, DISTANCE_SHARE, UNTURNED_SHARE)[:, None, None]
    guess = noise + (share * distance / demos) ** 2
    return np.moveaxis(guess, -1, 0)[:, None] + suits[None, :, :, None]
