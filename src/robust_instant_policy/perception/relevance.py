"""Which objects matter: those that the demonstrations' hand approaches, grasps, or moves relative to."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from robust_instant_policy.geometry import FloatArray, invert_pose, transform_points
from robust_instant_policy.perception.view import View
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX, Trajectory

CONTACT_M = 0.05  # distance of the fingertips at which an object counts 1/e
RELATED_M = 0.20  # the same for an object relative to which they move
MIN_SPREAD_M = 0.01  # of the hand's places over demonstrations; less tells nothing of what they depend on
CLOSED = 0.5  # gripper state
MIN_RELEVANCE = 0.2  # of the most relevant object's, or, of the most relevant one at an event, of the greatest possible
MIN_EXPLAINED = 0.8  # of the variance of a turning point, by what else does not matter
STILL_M = 0.010  # by which scenery seems to move between images


def relevances(objects: Sequence[Sequence[FloatArray | None]], trajectories: Sequence[Trajectory]) -> FloatArray:
    """Relevance ``(O,)`` of ``objects``, each given by its points ``(N, 3)`` in every demonstration, metres, world, or
    None in one that does not show it.

    Over the hand's events (`_events`) the sum of its nearness to the object or, if that is more, of the share of the
    variance of the hand's place that the object's place explains. It is 0 for an object that is neither the most
    relevant one at an event nor of `MIN_RELEVANCE` in all, unless it explains best where the hand turns (`_turns`):
    that is how a held tool is moved to a thing that the hand never comes near.
    """
    scenes = zip(*objects, strict=True)
    events = [
        _events([one for one in points if one is not None], path)
        for points, path in zip(scenes, trajectories, strict=True)
    ]
    hands = _corresponding(events)
    of_events = np.array([_relevances(points, hands) for points in objects])
    total = of_events.sum(axis=1)
    most_at_an_event = ((of_events == of_events.max(axis=0)) & (of_events >= MIN_RELEVANCE)).any(axis=1)
    relevant = np.where(most_at_an_event | (total >= MIN_RELEVANCE * total.max()), total, 0)
    turns = _corresponding([_turns(path) for path in trajectories])
    of_turns = np.array([_related(points, turns, MIN_EXPLAINED) for points in objects])
    best = of_turns * (of_turns == of_turns.max(axis=0)) * (of_turns >= MIN_RELEVANCE)
    return np.where(relevant > 0, relevant, best.max(axis=1))


def hand_places(views: Sequence[View], trajectories: Sequence[Trajectory]) -> FloatArray:
    """Places ``(I, E, 3)`` of the hand at the events of each demonstration, metres, in the worlds of its ``views``."""
    places = []
    for view, path in zip(views, trajectories, strict=True):
        world = transform_points(view.to_world, view.points)
        places.append(transform_points(invert_pose(view.to_world), _events([world], path)))
    return _corresponding(places)


def reference(views: Sequence[View], hands: FloatArray) -> int:
    """Number of the demonstration whose image the objects are taken from: the first, unless nothing is there where the
    hand (`hand_places`) takes something in most of the others; then the one that shows most there.
    """
    distances = np.array([cKDTree(view.points).query(places)[0] for view, places in zip(views, hands, strict=True)])
    event = int(np.median(distances, axis=0).argmin())
    taken = distances[:, event]
    typical = float(np.median(taken))
    if taken[0] < max(CONTACT_M, 2 * typical):
        return 0
    near = [
        np.linalg.norm(view.points - places[event], axis=1) < 2 * CONTACT_M
        for view, places in zip(views, hands, strict=True)
    ]
    return int(np.argmax([which.sum() * (distance <= typical) for which, distance in zip(near, taken, strict=True)]))


def _corresponding(events: Sequence[FloatArray]) -> FloatArray:
    """``(I, E, 3)``: the last events of all demonstrations correspond: a repeated attempt comes before them."""
    common = min(len(one) for one in events)
    return np.array([one[-common:] for one in events])


def still(points: Sequence[FloatArray]) -> bool:
    """Whether an object with ``points (N, 3)`` in every image is at the same place in all."""
    centres = np.array([one.mean(axis=0) for one in points])
    return bool(len(centres) > 1 and np.linalg.norm(centres - centres[0], axis=1).max() < STILL_M)


def shares(weights: FloatArray, count: int) -> list[int]:
    """``count`` keypoints for objects of ``weights (O,)``, by largest remainders; each of a positive weight has one
    while there are enough.
    """
    given = np.zeros(len(weights), dtype=int)
    given[np.argsort(-weights, kind="stable")[: min(count, int((weights > 0).sum()))]] = 1
    while given.sum() < count:
        given[np.argmax(weights / (given + 0.5))] += 1
    return given.tolist()


def _events(points: Sequence[FloatArray], path: Trajectory) -> FloatArray:
    """Midpoints of the fingertips ``(E, 3)`` in one demonstration, metres, world: where the hand first comes near an
    object's ``points (N, 3)``, where the gripper opens or closes, and at the end; of every arm.
    """
    nearest = cKDTree(np.concatenate([np.zeros((0, 3)), *points]))  # of nothing, where no object is shown
    places = []
    for arm in range(0, path.actions.shape[1], ACTION_DIM):
        tips = path.actions[:, arm + 3 : arm + 9].reshape(-1, 2, 3).mean(axis=1)
        distance = nearest.query(tips)[0]
        changes = np.flatnonzero(np.diff(path.actions[:, arm + STATE_INDEX] > CLOSED)) + 1
        near = np.flatnonzero(distance < CONTACT_M)
        first = near[0] if len(near) else int(distance.argmin())
        places += [tips[first], *tips[changes], tips[-1]]
    return np.array(places)


def _turns(path: Trajectory) -> FloatArray:
    """Midpoints of the fingertips ``(S, 3)``, metres, world, in each segment of constant gripper state of every arm
    where they are farthest from the line between its ends."""
    places = []
    for arm in range(0, path.actions.shape[1], ACTION_DIM):
        tips = path.actions[:, arm + 3 : arm + 9].reshape(-1, 2, 3).mean(axis=1)
        changes = np.flatnonzero(np.diff(path.actions[:, arm + STATE_INDEX] > CLOSED)) + 1
        for segment in np.split(tips, changes):
            way = segment[-1] - segment[0]
            away = segment - segment[0]
            along = way * (away @ way / max(way @ way, MIN_SPREAD_M**2))[:, None]
            places.append(segment[np.linalg.norm(away - along, axis=1).argmax()])
    return np.array(places)


def _relevances(points: Sequence[FloatArray | None], hands: FloatArray) -> FloatArray:
    """``(E,)`` of an object with ``points (N, 3)`` in each of I demonstrations, for the hand's ``hands (I, E, 3)``."""
    distances = _distances(*_where_shown(points, hands))
    near = np.exp(-((distances / CONTACT_M) ** 2)).mean(axis=0)  # what only some demonstrations grasp matters, too
    return np.maximum(near, _related(points, hands))


def _where_shown(points: Sequence[FloatArray | None], hands: FloatArray) -> tuple[list[FloatArray], FloatArray]:
    """The ``points`` of an object and the ``hands (I, E, 3)`` in the demonstrations that show it."""
    pairs = [(one, at) for one, at in zip(points, hands, strict=True) if one is not None]
    return [one for one, _ in pairs], np.array([at for _, at in pairs])


def _related(points: Sequence[FloatArray | None], hands: FloatArray, least: float = 0.0) -> FloatArray:
    """``(E,)``: share of the variance of ``hands (I, E, 3)`` that the object's place explains, if it is at ``least``
    so much, less the farther they are from it."""
    places, hands = _where_shown(points, hands)
    centres = np.array([one.mean(axis=0) for one in places])
    spread = hands.var(axis=0).sum(axis=-1)
    left = (hands - centres[:, None]).var(axis=0).sum(axis=-1)
    explained = np.where(spread > MIN_SPREAD_M**2, 1 - left / np.maximum(spread, MIN_SPREAD_M**2), 0)
    distance = np.median(_distances(places, hands), axis=0)
    return np.clip(explained, 0, 1) * (explained >= least) * np.exp(-((distance / RELATED_M) ** 2))


def _distances(points: Sequence[FloatArray], hands: FloatArray) -> FloatArray:
    """``(I, E)``, metres, of ``hands (I, E, 3)`` from the nearest of an object's points."""
    return np.array([cKDTree(one).query(at)[0] for one, at in zip(points, hands, strict=True)])
