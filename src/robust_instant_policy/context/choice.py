"""Which frame each step is written in: the one that predicts a demonstration best from the others.

1. `Candidates`: all combinations of axes and origins that the things allow.
2. `prediction_errors` of each at each step.
3. Where axes along a line suit a step best, the points in the things between which the line runs are fitted; then 2.
4. Where no candidate explains a key step, more origins are added; then 2.
5. Viterbi over the steps: the least sum of the errors' logarithms, with a cost for each change of frame.
6. The numbers of the chosen frames are fitted to all demonstrations, robustly.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from robust_instant_policy.context.candidates import GROWTH, NOISE_M, POINT_STD_M, POINTS, SHARES, Candidates, Origin
from robust_instant_policy.context.frames import Anchor, Axes, Frame
from robust_instant_policy.context.prediction import Errors, ShownHands, prediction_errors
from robust_instant_policy.context.things import DEMOS_TO_TELL_THINGS, WORLD, Scene, Thing
from robust_instant_policy.geometry import FloatArray

TRANSITION_COST = 1.0  # of a change of frame between two steps, in logarithms of the error
KEY_STEP_WEIGHT = 3.0  # of the first and last step and of gripper changes; 1 elsewhere
TURN_WEIGHT = 0.6  # of the gripper's points about its centre against the centre, where a line is fitted
UNEXPLAINED_M = 0.015  # error of a key step from which on more origins are tried
OTHER_SHARES = 0.3  # difference of shares along an axis from which on they have an origin of their own

IntArray = NDArray[np.intp]


def choose_frames(things: Sequence[Thing], scene: Scene, hands: ShownHands, key_steps: Sequence[int]) -> list[Frame]:
    """The frame of each step for one arm's ``hands`` in demonstrations with ``things`` in a ``scene``."""
    weight = np.ones(hands.points.shape[1])
    weight[list(key_steps)] = KEY_STEP_WEIGHT
    candidates = Candidates.of(things, scene)
    errors = prediction_errors(candidates, hands)
    if len(hands) >= DEMOS_TO_TELL_THINGS:
        candidates = _with_fitted_lines(candidates, errors, hands)
        errors = prediction_errors(candidates, hands)
        if errors.mean_squared[list(key_steps)].min(axis=(1, 2)).max() > UNEXPLAINED_M**2:
            candidates = candidates.with_more_origins(things)
            candidates = _with_weighted_points(candidates, prediction_errors(candidates, hands), hands)
            errors = prediction_errors(candidates, hands)
    chosen = _viterbi(errors.cost.reshape(len(weight), -1) * weight[:, None])
    return _fitted(candidates, errors, hands, np.transpose(np.unravel_index(chosen, errors.cost.shape[1:])))


def _viterbi(cost: FloatArray) -> list[int]:
    """The sequence of columns of ``cost (T, C)`` with the least sum, where each change costs the same."""
    total, origin = cost[0], []
    for own in cost[1:]:
        best = int(np.argmin(total))
        stays = total <= total[best] + TRANSITION_COST
        origin.append(np.where(stays, np.arange(len(total)), best))
        total = np.minimum(total, total[best] + TRANSITION_COST) + own
    chosen = [int(np.argmin(total))]
    for before in reversed(origin):
        chosen.append(int(before[chosen[-1]]))
    return chosen[::-1]


def _best(errors: Errors) -> IntArray:
    """Numbers ``(T, 2)`` of the axes and the origin that suit each step best."""
    cost = errors.cost
    return np.stack(np.unravel_index(cost.reshape(len(cost), -1).argmin(axis=1), cost.shape[1:]), axis=1)


def _with_weighted_points(candidates: Candidates, errors: Errors, hands: ShownHands) -> Candidates:
    """``candidates``, where origins by axis that suit some steps best have the shares that were fitted to these steps,
    each set of shares in an origin of its own.

    The place is not linear in shares and points together, so that points are fitted for given shares.
    """
    picks = _best(errors)
    frames = _fitted(candidates, errors, hands, picks)
    origins: list[Origin] = []
    for number, origin in enumerate(candidates.origins):
        different: list[FloatArray] = []
        steps = np.flatnonzero(picks[:, 1] == number) if origin.by_axis else ()
        for step in sorted(steps, key=errors.cost.min(axis=(1, 2)).__getitem__):
            shares = frames[step].shares[0]
            if all(np.abs(shares - known).max() > OTHER_SHARES for known in different):
                different.append(shares)
        origins += [replace(origin, shares=shares) for shares in different] or [origin]
    return replace(candidates, origins=tuple(origins))


def _with_fitted_lines(candidates: Candidates, errors: Errors, hands: ShownHands) -> Candidates:
    """``candidates`` with those lines fitted that suit some step best."""
    picks = _best(errors)
    axes = list(candidates.axes)
    for index in np.unique(picks[:, 0]):
        if len(axes[index].ends) == 2:
            steps = np.flatnonzero(picks[:, 0] == index)
            own = replace(hands, points=hands.points[:, steps])
            axes[index] = _fitted_line(candidates, axes[index], own, picks[steps, 1])
    return replace(candidates, axes=tuple(axes))


def _fitted_line(candidates: Candidates, axes: Axes, hands: ShownHands, origins: IntArray) -> Axes:
    """``axes`` with the ends between which the line predicts the ``hands`` best, each step's origin being one of
    ``origins (T,)``; by robust least squares, with the other numbers eliminated."""
    free = [end.thing.turns or end.thing is WORLD for end in axes.ends]
    width = 3 if axes.in_space else 2
    centre, about_centre = hands.centre, hands.shape

    def moved(x: FloatArray) -> Axes:
        offsets = iter(x.reshape(-1, width))
        ends = [
            Anchor(end.thing, np.pad(next(offsets), (0, 3 - width))) if own else end
            for end, own in zip(axes.ends, free, strict=True)
        ]
        return replace(axes, ends=tuple(ends))

    def residuals(x: FloatArray) -> FloatArray:
        line = replace(candidates, axes=(moved(x),))
        shape = np.einsum("iyx,itpy->tipx", line.rotations()[0], about_centre)
        parts = [hands.from_mean(shape) * TURN_WEIGHT]
        start, design, penalty = line.model(np.zeros(3), hands.second)
        for number, origin in enumerate(origins):
            flat = design[0, origin].reshape(-1, len(penalty))
            target = (centre[:, number] - start[origin]).ravel()
            w = np.linalg.solve(flat.T @ flat + np.diag(penalty), flat.T @ target)
            parts.append((target - flat @ w)[:, None])
        return np.concatenate([*(part.ravel() / NOISE_M for part in parts), x / POINT_STD_M])

    fit = least_squares(residuals, np.zeros(width * sum(free)), loss="soft_l1", max_nfev=12)
    return moved(fit.x)


def _fitted(candidates: Candidates, errors: Errors, hands: ShownHands, picks: IntArray) -> list[Frame]:
    """The frames of ``picks (T, 2)`` (axes, origin), with their numbers fitted robustly to the demonstrations."""
    start, design, penalty = candidates.model(hands.home, hands.second)
    centre = hands.centre
    frames = []
    for step, (m, n) in enumerate(picks):
        origin, x = candidates.origins[n], design[m, n]
        target = centre[:, step] - start[n]
        weight = np.ones(len(hands))
        for _ in range(5):
            gram = np.einsum("i,ixa,ixb->ab", weight, x, x) + np.diag(penalty)
            found = np.linalg.solve(gram, np.einsum("i,ixa,ix->a", weight, x, target))
            squared = ((x @ found - target) ** 2).sum(axis=1)
            weight = 1 / (1 + squared / max(float(np.median(squared)), NOISE_M**2) / 3)
        w = np.zeros(GROWTH.start + 3 * len(candidates.growing))
        w[candidates.numbers] = found[: len(candidates.numbers)]
        shares = w[SHARES].reshape(2, 3)[: len(origin.ends) - 1]
        frames.append(
            Frame(
                candidates.axes[m],
                origin.ends,
                tuple(w[POINTS].reshape(3, 3)[: len(origin.ends)]),
                tuple(shares if origin.by_axis else np.repeat(shares[:, :1], 3, axis=1)),
                origin.weights,
                tuple(zip(origin.growing, w[GROWTH].reshape(-1, 3), strict=False)),
                hands.home,
                float(np.sqrt(np.median(errors.squared[step, m, n]))),
            )
        )
    return frames
