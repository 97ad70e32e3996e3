"""Which frame each step is written in: the one that predicts a demonstration best from the others.

A candidate is a choice of axes R and of the one to three things on which the origin depends. In a scene, the hand's
centre is

    y = o + X w,   X = [o' - o … | B | B' … | R | (s - 1) R …]

with o, o' the things' positions, B, B' their axes, and s the sizes of things that have one: share of the way, points
fixed in the things, offset in the axes and its growth are all linear. Where the way counts along each axis, o' - o is
its three parts along R, and points in the things count along each axis by the share of the way that a first fit found.
Ridge regression gives w, and its hat matrix H the residuals of each demonstration when it is left out,
(I - H_ii)⁻¹ r_i, for all candidates and steps at once (the keypoints of the one that is left out are noisy, too). The
hand's turn is predicted by the mean of the others' in the axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from robust_instant_policy.context.frames import Anchor, Axes, Frame
from robust_instant_policy.context.things import (
    DEMOS_TO_TELL_THINGS,
    WORLD,
    Scene,
    Thing,
)
from robust_instant_policy.geometry import FloatArray

NOISE_M = 0.003  # of demonstrated points in a frame that suits them
# Standard deviations a priori of what is fitted: share of the way; a point in a thing, an offset, its growth in metres.
SHARE_STD, POINT_STD_M, OFFSET_STD_M, GROWTH_STD_M = 0.7, 0.02, 0.5, 0.1
PARAMETER_COST = 0.04  # of a fitted number, in logarithms of the error
USUAL_DEMOS = 10  # for which that cost holds; it is higher for fewer
TRANSITION_COST = 1.0  # of a change of frame between two steps, in logarithms of the error
KEY_STEP_WEIGHT = 3.0  # of the first and last step and of gripper changes; 1 elsewhere
# Expected error of a single demonstration, a metre to a thing that is seen in its own axes, and to one that has none.
DISTANCE_SHARE, UNTURNED_SHARE = 0.05, 0.3
TURN_WEIGHT = 0.6  # of the gripper's points about its centre against the centre, where a line is fitted
MAX_LOOSE = 4  # keypoints of their own, between which lines are drawn
UNEXPLAINED_M = 0.015  # error of a key step from which on more origins are tried
OTHER_SHARES, MAX_SHARES = 0.3, 4  # difference of shares along an axis for an origin of their own, and how many of one
# Where the numbers w stand: shares, three for each further end; points in the ends; offset; its growth with each size.
SHARES, POINTS, OFFSET, GROWTH = slice(0, 6), slice(6, 15), slice(15, 18), slice(18, None)

ZERO = np.zeros(3)
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Origin:
    """On which things an origin depends: the ``ends``, one to three, and those with whose size it moves. ``by_axis`` it
    is at a share of the way of its own along each axis; along each the points in both ends count by the ``shares (3,)``
    of that way, where these are known."""

    ends: tuple[Thing, ...]
    growing: tuple[Thing, ...] = ()
    by_axis: bool = False
    shares: FloatArray | None = None

    @property
    def weights(self) -> tuple[FloatArray, ...]:
        """``(3,)``, of the point in each of the ends along each axis."""
        return tuple(np.ones((len(self.ends), 3)) if self.shares is None else np.array([1 - self.shares, self.shares]))


@dataclass(frozen=True, eq=False)
class Candidates:
    """All combinations of ``axes`` and ``origins`` for demonstrations in ``scene``."""

    scene: Scene
    axes: tuple[Axes, ...]
    origins: tuple[Origin, ...]
    growing: tuple[Thing, ...]

    @classmethod
    def of(cls, things: Sequence[Thing], scene: Scene) -> Candidates:
        ends, points = _ends(things)
        few = len(scene[WORLD].size) < DEMOS_TO_TELL_THINGS
        pairs = [] if few else list(combinations(ends, 2))
        axes = [Axes((Anchor(thing, ZERO),)) for thing in (WORLD, *things) if thing is WORLD or thing.turns]
        for pair in pairs:
            line = Axes(tuple(Anchor(thing, ZERO) for thing in pair))
            axes.append(line)
            rise = np.ptp(scene[pair[1]].position[:, 2] - scene[pair[0]].position[:, 2])
            if rise > 10 * NOISE_M and WORLD not in pair:
                axes.append(replace(line, in_space=True))
        hinged = [thing for thing in things if thing.kind == "hinged"]
        singles = [(thing,) for thing in dict.fromkeys([*ends, *points, *hinged])]
        growing = tuple(thing for thing in things if thing.kind == "scaled")
        origins = [Origin(own, grows) for own in (*singles, *pairs) for grows in dict.fromkeys(((), growing))]
        return cls(scene, tuple(axes), tuple(origins), growing)

    def with_more_origins(self, things: Sequence[Thing]) -> Candidates:
        """With shares along each axis of the way between two things, and shares of the ways between three."""
        ends, _ = _ends(things)
        more = [Origin(pair, by_axis=True) for pair in combinations(ends, 2)]
        more += [Origin(three) for three in combinations(ends, 3)]
        return replace(self, origins=(*self.origins, *more))

    def nearest(self, squared: FloatArray) -> tuple[int, ...]:
        """The keypoints of the one thing whose frames explain a step with errors ``squared (M, N)`` best."""
        single = [n for n, origin in enumerate(self.origins) if len(origin.ends) == 1]
        return self.origins[single[int(squared[:, single].min(axis=0).argmin())]].ends[0].members

    def start(self, home: FloatArray) -> FloatArray:
        """o ``(N, I, 3)`` of each origin; the world's is ``home (3,)``."""
        return np.stack([self._position(origin.ends[0], home) for origin in self.origins])

    def _position(self, end: Thing, home: FloatArray) -> FloatArray:
        return self.scene[end].position + (home if end is WORLD else 0.0)

    @property
    def numbers(self) -> np.ndarray:
        """Which of all numbers w any of the origins has."""
        most = max(len(origin.ends) for origin in self.origins)
        by_axis = any(origin.by_axis for origin in self.origins)
        shares = [[0, 1, 2] if by_axis else [0], [3]]
        ends = [number for own in shares[: most - 1] for number in own] + list(
            range(POINTS.start, POINTS.start + 3 * most)
        )
        return np.array([*ends, *range(OFFSET.start, OFFSET.stop + 3 * len(self.growing))])

    def design(self, home: FloatArray, second: NDArray[np.bool_] | None = None) -> tuple[FloatArray, FloatArray]:
        """X ``(M, N, I, 3, P)`` of all combinations, and the P ridge penalties, of the `numbers` alone; last, the
        offset by which demonstrations of a ``second (I,)`` way differ."""
        scene, rotation = self.scene, self.rotations()
        deviations = np.array(
            [SHARE_STD] * 6 + [POINT_STD_M] * 9 + [OFFSET_STD_M] * 3 + [GROWTH_STD_M] * (3 * len(self.growing))
        )
        demos = rotation.shape[1]
        design = np.zeros((len(rotation), len(self.origins), demos, 3, len(deviations)))
        sizes = [(scene[thing].size - 1)[:, None, None] * rotation for thing in self.growing]
        design[..., OFFSET.start :] = np.concatenate([rotation, *sizes], axis=-1)[:, None]
        for index, origin in enumerate(self.origins):
            own = design[:, index]  # (M, I, 3, P)
            if not origin.growing:
                own[..., GROWTH] = 0.0
            first = self._position(origin.ends[0], home)
            for number, (end, weight) in enumerate(zip(origin.ends, origin.weights, strict=True)):
                if end.turns:
                    turned = scene[end].rotation
                    if origin.shares is not None:
                        turned = (rotation * weight) @ np.swapaxes(rotation, -1, -2) @ turned
                    own[..., POINTS.start + 3 * number :][..., :3] = turned
                if number:
                    away = (self._position(end, home) - first)[..., None]
                    parts = (
                        rotation * (np.swapaxes(rotation, -1, -2) @ away).swapaxes(-1, -2) if origin.by_axis else away
                    )
                    own[..., 3 * (number - 1) :][..., : parts.shape[-1]] = parts
        numbers = self.numbers
        design, penalty = design[..., numbers], (NOISE_M / deviations[numbers]) ** 2
        if second is None:
            return design, penalty
        offset = np.broadcast_to((second[:, None, None] * rotation)[:, None], (*design.shape[:-1], 3))
        return np.concatenate([design, offset], axis=-1), np.append(penalty, [(NOISE_M / OFFSET_STD_M) ** 2] * 3)

    def rotations(self) -> FloatArray:
        """``(M, I, 3, 3)``."""
        return np.stack([axes.rotation(self.scene) for axes in self.axes])


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


def prediction_errors(candidates: Candidates, hands: FloatArray, second: NDArray[np.bool_] | None = None) -> Errors:
    """Leave-one-out errors of all ``candidates`` for one arm's ``hands (I, T, 3, 3)`` (three points a step).

    Demonstrations of a ``second (I,)`` way have an offset and a turn of their own in the same frame.
    """
    demos = len(hands)
    centre = hands.mean(axis=2)  # (I, T, 3)
    home = centre[:, 0].mean(axis=0)
    start, (design, penalty) = candidates.start(home), candidates.design(home, second)
    m, n, _, _, p = design.shape
    flat = design.reshape(m, n, 3 * demos, p)
    gram = np.swapaxes(flat, -1, -2) @ flat + np.diag(penalty)
    hat = flat @ np.linalg.solve(gram, np.swapaxes(flat, -1, -2))
    offset = (centre[None] - start[:, :, None]).transpose(0, 1, 3, 2)  # (N, I, 3, T)
    target = offset.reshape(n, 3 * demos, -1)
    residual = (target - hat @ target).reshape(m, n, demos, 3, -1)
    if demos >= DEMOS_TO_TELL_THINGS - 1:
        own = hat.reshape(m, n, demos, 3, demos, 3)[:, :, np.arange(demos), :, np.arange(demos)]  # (I, M, N, 3, 3)
        own = np.moveaxis(own, 0, 2)
        residual = np.linalg.solve(np.eye(3) - own, residual)
    place = np.moveaxis((residual**2).sum(axis=3), -1, 0)  # (T, M, N, I)
    rotation = candidates.rotations()
    shape = np.einsum("miyx,itpy->mitpx", rotation, hands - centre[:, :, None])
    rest = _from_mean(shape, second, others=True)
    turn = np.moveaxis((rest**2).sum(axis=-1).mean(axis=-1), -1, 0)  # (T, M, I)
    squared = place + turn[:, :, None]
    expected = np.zeros((m, n))
    if demos < DEMOS_TO_TELL_THINGS:
        squared = squared * (demos > 1) + _guess(candidates, target.reshape(n, demos, 3, -1), demos)
    else:
        expected = np.trace(hat, axis1=-2, axis2=-1) + 2 * np.array([[len(axes.ends) - 1] for axes in candidates.axes])
        expected = expected + np.array([[axes.ends[0].thing is not WORLD] for axes in candidates.axes])
        expected = expected + (0 if second is None else 3)
    return Errors(squared, PARAMETER_COST * expected)


def _from_mean(shape: FloatArray, second: NDArray[np.bool_] | None, others: bool = False) -> FloatArray:
    """``shape (M, I, ...)`` less the mean over the demonstrations of the same way, or over the ``others`` of it."""
    rest = np.empty_like(shape)
    for way in (slice(None),) if second is None else (~second, second):
        own = shape[:, way]
        count = own.shape[1]
        rest[:, way] = (own - own.mean(axis=1, keepdims=True)) * (count / max(count - 1, 1) if others else 1.0)
    return rest


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


def choose_frames(
    things: Sequence[Thing],
    scene: Scene,
    hands: FloatArray,
    key_steps: Sequence[int],
    second: NDArray[np.bool_] | None = None,
) -> list[Frame]:
    """The frame of each step for one arm's ``hands (I, T, 3, 3)``, the gripper's three points in each demonstration.

    Demonstrations of a ``second (I,)`` way share the frames with the others, see `prediction_errors`.

    Viterbi over the steps: leave-one-out error plus a cost for each change. Where lines suit, the points between which
    they run are fitted, and all is judged again; where a key step is not explained, with more origins.
    """
    weight = np.ones(hands.shape[1])
    weight[list(key_steps)] = KEY_STEP_WEIGHT
    candidates = Candidates.of(things, scene)
    errors = prediction_errors(candidates, hands, second)
    if len(hands) >= DEMOS_TO_TELL_THINGS:
        candidates = _with_fitted_lines(candidates, errors, hands, second)
        errors = prediction_errors(candidates, hands, second)
        if errors.mean_squared[list(key_steps)].min(axis=(1, 2)).max() > UNEXPLAINED_M**2:
            candidates = candidates.with_more_origins(things)
            errors = prediction_errors(candidates, hands, second)
            candidates = _with_weighted_points(candidates, errors, hands, second)
            errors = prediction_errors(candidates, hands, second)
    chosen = _viterbi(errors.cost.reshape(len(weight), -1) * weight[:, None])
    return _fitted(candidates, errors, hands, second, np.transpose(np.unravel_index(chosen, errors.cost.shape[1:])))


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


def _with_weighted_points(
    candidates: Candidates, errors: Errors, hands: FloatArray, second: NDArray[np.bool_] | None
) -> Candidates:
    """``candidates``, where origins by axis that suit some steps best have the shares that were fitted to these steps,
    each set of shares in an origin of its own.

    The place is not linear in shares and points together, so that points are fitted for given shares.
    """
    picks = _best(errors)
    frames = _fitted(candidates, errors, hands, second, picks)
    origins: list[Origin] = []
    for number, origin in enumerate(candidates.origins):
        different: list[FloatArray] = []
        steps = np.flatnonzero(picks[:, 1] == number) if origin.by_axis else ()
        for step in sorted(steps, key=errors.cost.min(axis=(1, 2)).__getitem__):
            shares = frames[step].shares[0]
            is_new = all(np.abs(shares - known).max() > OTHER_SHARES for known in different)
            if is_new and len(different) < MAX_SHARES:
                different.append(shares)
        origins += [replace(origin, shares=shares) for shares in different] or [origin]
    return replace(candidates, origins=tuple(origins))


def _with_fitted_lines(
    candidates: Candidates, errors: Errors, hands: FloatArray, second: NDArray[np.bool_] | None
) -> Candidates:
    """``candidates`` with those lines fitted that suit some step best."""
    picks = _best(errors)
    axes = list(candidates.axes)
    for index in np.unique(picks[:, 0]):
        if len(axes[index].ends) == 2:
            steps = np.flatnonzero(picks[:, 0] == index)
            axes[index] = _fitted_line(candidates, int(index), hands[:, steps], picks[steps, 1], second)
    return replace(candidates, axes=tuple(axes))


def _fitted_line(
    candidates: Candidates,
    index: int,
    hands: FloatArray,
    origins: FloatArray,
    second: NDArray[np.bool_] | None,
) -> Axes:
    """Axes ``index`` with the ends between which the line predicts the ``hands (I, T, 3, 3)`` best, each step's origin
    being one of ``origins (T,)``; by robust least squares, with the other numbers eliminated."""
    axes = candidates.axes[index]
    free = [end.thing.turns or end.thing is WORLD for end in axes.ends]
    width = 3 if axes.in_space else 2
    centre = hands.mean(axis=2)
    home = np.zeros(3)

    def moved(x: FloatArray) -> Axes:
        offsets = iter(x.reshape(-1, width))
        ends = [
            Anchor(end.thing, np.pad(next(offsets), (0, 3 - width))) if own else end
            for end, own in zip(axes.ends, free, strict=True)
        ]
        return replace(axes, ends=tuple(ends))

    def residuals(x: FloatArray) -> FloatArray:
        line = replace(candidates, axes=(moved(x),))
        rotation = line.rotations()[0]
        shape = np.einsum("iyx,itpy->tipx", rotation, hands - centre[:, :, None])
        parts = [_from_mean(shape, second) * TURN_WEIGHT]
        start, (design, penalty) = line.start(home), line.design(home, second)
        for number, origin in enumerate(origins):
            flat = design[0, origin].reshape(-1, len(penalty))
            target = (centre[:, number] - start[origin]).ravel()
            w = np.linalg.solve(flat.T @ flat + np.diag(penalty), flat.T @ target)
            parts.append((target - flat @ w)[:, None])
        return np.concatenate([*(part.ravel() / NOISE_M for part in parts), x / POINT_STD_M])

    fit = least_squares(residuals, np.zeros(width * sum(free)), loss="soft_l1", max_nfev=12)
    return moved(fit.x)


def _fitted(
    candidates: Candidates,
    errors: Errors,
    hands: FloatArray,
    second: NDArray[np.bool_] | None,
    picks: IntArray,
) -> list[Frame]:
    """The frames of ``picks (T, 2)`` (axes, origin), with their numbers fitted robustly to the demonstrations."""
    centre = hands.mean(axis=2)
    home = centre[:, 0].mean(axis=0)
    start, (design, penalty) = candidates.start(home), candidates.design(home, second)
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
                home,
                float(np.sqrt(np.median(errors.squared[step, m, n]))),
            )
        )
    return frames


def _ends(things: Sequence[Thing]) -> tuple[list[Thing], list[Thing]]:
    """The things between which an origin may lie, and all loose points."""
    still = [WORLD, *(thing for thing in things if thing.kind in ("upright", "scaled"))]
    points = [thing for thing in things if thing.kind == "point"]
    sized = {member for thing in things if thing.kind == "scaled" for member in thing.members}
    loose = [point for point in points if sized.isdisjoint(point.members)]
    return still + (loose if len(loose) <= MAX_LOOSE else []), points
