"""Made-up scenes in which what demonstrations have in common is a relation: no simulator and no images.

A family draws scenes: things placed and turned at random on a table, ten keypoints on them, and the path of one or two
grippers. The gripper opens and closes at the places that matter, so that they are key steps, labelled exactly. What a
demonstrator aims at is displaced by `HAND_NOISE_M` and turned by `HAND_NOISE_RAD`; keypoints are measured with noise.
Shapes, grasps and offsets are those of a `Kit`, which a set of demonstrations and its new scenes share. Points that a
relation refers to are fixed in the things and are not the centroids of their keypoints.

To add a family, write a function as those below and list it in `FAMILIES`.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from pick_and_place import HAND_NOISE_M, HAND_NOISE_RAD, TRIANGLE, between
from scipy.spatial.transform import Rotation

from robust_instant_policy.geometry import FloatArray, make_pose
from robust_instant_policy.trajectory import Trajectory, downsample

TABLE_M = ([0.35, -0.25], [0.65, 0.25])  # where things are placed, x and y
APART_M = 0.15  # least distance of two things
TURN_RAD = 1.5  # a thing is turned by up to this to either side
CLEAR_M = 0.03  # by which "nearer", "left of" and the like are clear: what lies between is neither
CLEAR_RAD = np.radians(8)
HOVER_M = 0.10  # above a place where the gripper descends
STEP_M, PACES = 0.005, (0.8, 1.25)  # of a path in its recording, and the range of factors on its speed
HOMES = (
    make_pose(np.diag([1.0, -1.0, -1.0]), [0.30, 0.0, 0.35]),
    make_pose(np.diag([1.0, -1.0, -1.0]), [0.30, 0.4, 0.35]),
)
USUAL = "usual"
UNCOVERED = ("missing", "added", "twice as far", "exchanged")  # scenes that no demonstration covers, see `confused`


@dataclass(frozen=True, eq=False)
class Scene:
    """Measured ``keypoints (K, 3)``, metres, world; the demonstrated ``path``, and the ``trajectory`` thinned out."""

    keypoints: FloatArray
    path: Trajectory

    @property
    def trajectory(self) -> Trajectory:
        return downsample(self.path)


@dataclass(frozen=True, eq=False)
class Drawn:
    """What a family draws: exact keypoints of each thing, and the legs of the path.

    A leg is poses ``(N, A, 4, 4)`` that are passed at one speed, and the state in which the A grippers then are.
    """

    things: tuple[FloatArray, ...]
    legs: tuple[tuple[FloatArray, int], ...]


class Kit:
    """What all scenes of a set share: shapes ``(3, 10, 3)`` of three things, a grasp and a place in each one's frame,
    and a reference point ``(3, 3)`` in each."""

    def __init__(self, rng: np.random.Generator):
        self.shapes = rng.uniform([-0.04, -0.04, 0.0], [0.04, 0.04, 0.03], (3, 10, 3))
        self.grasps = [down(rng.uniform(-0.01, 0.01, 2), 0.02, rng.uniform(-0.5, 0.5)) for _ in range(3)]
        self.places = [down(rng.uniform(-0.01, 0.01, 2), 0.05, rng.uniform(-0.5, 0.5)) for _ in range(3)]
        self.points = np.column_stack([rng.uniform(-0.015, 0.015, (3, 2)), np.zeros(3)])
        self.shares = rng.uniform(0, 1, 10)  # of a length, where keypoints lie along it
        self.shares[:2] = 0.02, 0.98


class Layout:
    """Draws places and turns; ``stretch`` multiplies the distance of things from the first one."""

    def __init__(self, rng: np.random.Generator, stretch: float = 1.0):
        self.rng, self.stretch = rng, stretch

    def things(self, count: int, fits: Callable[[FloatArray], bool] = lambda places: True) -> list[FloatArray]:
        """Poses of ``count`` things, `APART_M` from each other, whose places ``(count, 2)`` fit."""
        while True:
            places = self.rng.uniform(*TABLE_M, (count, 2))
            apart = [np.linalg.norm(places[i] - places[j]) for i, j in combinations(range(count), 2)]
            if min(apart, default=np.inf) >= APART_M and fits(places):
                break
        places = places[0] + self.stretch * (places - places[0])
        turns = self.rng.uniform(-TURN_RAD, TURN_RAD, count)
        return [turned(place, angle) for place, angle in zip(places, turns, strict=True)]

    def number(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))


class Hand:
    """Aims at poses, with the errors of a demonstrator, or exactly without ``rng``."""

    def __init__(self, rng: np.random.Generator | None):
        self._rng = rng

    def __call__(self, pose: FloatArray) -> FloatArray:
        if self._rng is None:
            return pose
        turn = turned([0, 0], self._rng.normal(0, HAND_NOISE_RAD))[:3, :3]
        return make_pose(turn @ pose[:3, :3], pose[:3, 3] + self._rng.normal(0, HAND_NOISE_M, 3))


Draw = Callable[[Kit, Layout, Hand], Drawn]


@dataclass(frozen=True)
class Family:
    """``shown`` is in words what the demonstrations show; ``uncovered`` are those of `UNCOVERED` that make sense."""

    name: str
    shown: str
    draw: Draw
    uncovered: tuple[str, ...] = UNCOVERED

    def stream(self, split: str, set_number: int) -> list[int]:
        """Seed of what a set's scenes share."""
        return [zlib.crc32(split.encode()), zlib.crc32(self.name.encode()), set_number]

    def scenes(self, split: str, set_number: int, noise_m: float) -> Callable[..., Scene]:
        """Draws the scenes of a set of demonstrations: ``draw(number, exact=False, condition=USUAL)``.

        ``exact`` removes the demonstrator's errors; keypoints stay noisy. Splits share no random number.
        """
        stream = self.stream(split, set_number)
        kit = Kit(np.random.default_rng(stream))

        def draw(number: int, *, exact: bool = False, condition: str = USUAL) -> Scene:
            rng, noise, hand = (np.random.default_rng([*stream, number, part]) for part in (1, 2, 3))
            layout = Layout(rng, 2.0 if condition == "twice as far" else 1.0)
            drawn = self.draw(kit, layout, Hand(None if exact else hand))
            things = confused(drawn.things, condition, noise)
            keypoints = np.concatenate(things)
            return Scene(keypoints + noise.normal(0, noise_m, keypoints.shape), travelled(drawn.legs, hand))

        return draw


def confused(things: Sequence[FloatArray], condition: str, rng: np.random.Generator) -> list[FloatArray]:
    """Keypoints of ``things`` as they are found where the last one is missing, another like it was added, or the first
    and the last are mistaken for each other."""
    things = [np.array(points) for points in things]
    last = np.array(things[-1])
    elsewhere = np.append(rng.uniform(*TABLE_M), 0.0)
    if condition == "missing":  # found on whatever resembles them
        things[-1] = np.column_stack([rng.uniform(*TABLE_M, (len(last), 2)), rng.uniform(0, 0.05, len(last))])
    elif condition == "added":  # every other keypoint is found on the thing that is not the right one
        things[-1][::2] += elsewhere - last.mean(axis=0)
    elif condition == "exchanged":  # the keypoints of each are found on the other
        things[0], things[-1] = np.resize(last, things[0].shape), np.resize(things[0], last.shape)
    return things


def travelled(legs: Sequence[tuple[FloatArray, int]], rng: np.random.Generator) -> Trajectory:
    """From home along ``legs``, each at a speed of its own."""
    num_arms = legs[0][0].shape[1]
    at, closed = np.stack(HOMES[:num_arms]), 0
    poses, states = [at[None]], [closed]
    for targets, state in legs:
        pace = rng.uniform(*PACES)
        for target in targets:
            longest = np.linalg.norm(target[:, :3, 3] - at[:, :3, 3], axis=-1).max()
            count = max(2, round(longest / STEP_M * pace)) if len(targets) == 1 else max(1, round(longest / STEP_M))
            shares = np.arange(1, count + 1) / count
            poses.append(np.stack([between(at[arm], target[arm], shares) for arm in range(num_arms)], axis=1))
            states += [state] * count
            at = target
    closed_by_arm = np.tile(np.array(states)[:, None], (1, num_arms))
    return Trajectory.from_poses(np.concatenate(poses), closed_by_arm, TRIANGLE)


# Poses


def turned(place: Sequence[float] | FloatArray, angle: float) -> FloatArray:
    """Pose on the table at ``place (2,)``, turned about the vertical."""
    return make_pose(Rotation.from_rotvec([0, 0, angle]).as_matrix(), [*place, 0])


def down(place: Sequence[float] | FloatArray, height: float, angle: float) -> FloatArray:
    """A gripper that points down."""
    return make_pose(turned(place, angle)[:3, :3] @ np.diag([1.0, -1.0, -1.0]), [*place, height])


def raised(pose: FloatArray, height: float = HOVER_M) -> FloatArray:
    return make_pose(pose[:3, :3], pose[:3, 3] + [0, 0, height])


def backed(pose: FloatArray, distance: float = HOVER_M) -> FloatArray:
    """The gripper withdrawn against its approach."""
    return pose @ make_pose(np.eye(3), [0, 0, -distance])


def leaning(pose: FloatArray, angle: float, direction: float) -> FloatArray:
    """A gripper leaned by ``angle`` so that its palm moves in the world's ``direction`` (both rad)."""
    axis = np.array([-np.sin(direction), np.cos(direction), 0.0])
    return make_pose(Rotation.from_rotvec(angle * axis).as_matrix() @ pose[:3, :3], pose[:3, 3])


def at(pose: FloatArray, points: FloatArray) -> FloatArray:
    return points @ pose[:3, :3].T + pose[:3, 3]


def moved(points: FloatArray, x: float, y: float = 0.0, z: float = 0.0) -> FloatArray:
    return points + np.array([x, y, z])


def single(*legs: tuple[FloatArray | list[FloatArray], int]) -> tuple[tuple[FloatArray, int], ...]:
    """Legs of one arm, each a pose or a list of poses."""
    return tuple((np.reshape(poses, (-1, 1, 4, 4)), closed) for poses, closed in legs)


def carry(grasp: FloatArray, release: FloatArray, lift: Callable[[FloatArray], FloatArray] = raised) -> tuple:
    return single(
        (lift(grasp), 0),
        (grasp, 0),
        (grasp, 1),
        (lift(grasp), 1),
        (raised(release), 1),
        (release, 1),
        (release, 0),
        (raised(release), 0),
    )


def line(start: FloatArray, stop: FloatArray) -> tuple[FloatArray, float]:
    """Unit vector ``(2,)`` from ``start`` to ``stop`` in the plane, and its angle."""
    direction = (stop - start)[:2] / np.linalg.norm((stop - start)[:2])
    return direction, float(np.arctan2(direction[1], direction[0]))


# Families


def place(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    a, b = layout.things(2)
    return Drawn(
        (at(a, kit.shapes[0][:5]), at(b, kit.shapes[1][:5])),
        carry(hand(a @ kit.grasps[0]), hand(b @ kit.places[1])),
    )


def height(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    a, b = layout.things(2)
    tall, wide = layout.number(0.03, 0.15), layout.number(0.6, 1.6)
    shape = kit.shapes[1][:5] * [wide, wide, tall / 0.03]
    shape[:3, 2] = tall  # most keypoints lie on what a camera sees from above
    release = b @ down([0, 0], tall + 0.02, 0.3)
    return Drawn((at(a, kit.shapes[0][:5]), at(b, shape)), carry(hand(a @ kit.grasps[0]), hand(release)))


def door(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    (frame,) = layout.things(1)
    opening = layout.number(0.5, 1.9)
    leaf = frame @ turned([0, 0], opening)
    shape = moved(kit.shapes[1][:5], 0.04, 0.04, 0) * [2.2, 0.2, 3.0]
    handle = down([0.15, 0], 0.08, 0.4)
    grasp, closing = hand(leaf @ handle), np.linspace(opening, 0, 9)[1:-1]
    shut = hand(frame @ handle)
    arc = [frame @ turned([0, 0], angle) @ handle for angle in closing]
    return Drawn(
        (at(frame, moved(2 * kit.shapes[0][:5], -0.08)), at(leaf, shape)),
        single((raised(grasp), 0), (grasp, 0), (grasp, 1), ([*arc, shut], 1), (shut, 0), (raised(shut), 0)),
    )


def push_to(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    a, b = layout.things(2)
    start, goal = at(a, kit.points[0]), at(b, kit.points[1])
    direction, angle = line(start, goal)
    behind = hand(down(start[:2] - 0.06 * direction, 0.02, angle))
    end = hand(down(goal[:2] - 0.05 * direction, 0.02, angle))
    return Drawn(
        (at(a, kit.shapes[0][:5]), at(b, kit.shapes[1][:5])),
        single((raised(behind), 0), (behind, 0), (behind, 1), (end, 1), (end, 0), (raised(end), 0)),
    )


def point_to(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    a, b = layout.things(2)
    start, goal = at(a, kit.points[0]), at(b, kit.points[1])
    _, angle = line(start, goal)
    grasp = hand(a @ kit.grasps[0])
    pouring = hand(leaning(down(start[:2], 0.15, angle), np.radians(35), angle))
    return Drawn(
        (at(a, kit.shapes[0][:5]), at(b, kit.shapes[1][:5])),
        single((raised(grasp), 0), (grasp, 0), (grasp, 1), (raised(grasp), 1), (pouring, 1)),
    )


def perp(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    a, b = layout.things(2)
    start, goal = at(a, kit.points[0]), at(b, kit.points[1])
    direction, angle = line(start, goal)
    beside = (start + goal)[:2] / 2 + 0.10 * np.array([-direction[1], direction[0]])
    return Drawn(
        (at(a, kit.shapes[0][:5]), at(b, kit.shapes[1][:5])),
        carry(hand(a @ kit.grasps[0]), hand(down(beside, 0.03, angle))),
    )


def along(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    (middle,) = layout.things(1)
    length = layout.number(0.12, 0.40)
    shape = np.column_stack([(kit.shares - 0.5) * length, kit.shapes[0][:, 1] * 0.4, kit.shapes[0][:, 2] * 0.6])
    first, last = (hand(middle @ down([end * length, 0], 0.02, np.pi / 2)) for end in (-0.5, 0.5))
    return Drawn(
        (at(middle, shape),),
        single((raised(first), 0), (first, 0), (first, 1), (last, 1), (last, 0), (raised(last), 0)),
    )


def nearest(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    def clear(places: FloatArray) -> bool:
        return abs(np.diff(np.linalg.norm(places, axis=1))[0]) >= CLEAR_M

    things = layout.things(2, clear)
    nearer = min(things, key=lambda pose: np.linalg.norm(pose[:2, 3]))
    return Drawn(
        tuple(at(pose, kit.shapes[0][:5]) for pose in things),
        carry(hand(nearer @ kit.grasps[0]), hand(down([0.30, -0.35], 0.06, 0.0))),
    )


def side(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    a, b = layout.things(2, lambda places: abs(places[0, 1]) >= CLEAR_M)
    left = np.sign(a[1, 3])
    beside = moved(at(a, kit.points[0]), 0, 0.04 * left)
    grasp = hand(leaning(down(beside[:2], 0.03, 0.0), np.radians(30), left * np.pi / 2))
    return Drawn(
        (at(a, kit.shapes[0][:5]), at(b, kit.shapes[1][:5])),
        carry(grasp, hand(b @ kit.places[1]), lift=backed),
    )


def lid(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    (box,) = layout.things(1)
    opening = layout.number(np.radians(40), np.radians(110))
    hinge = box @ make_pose(np.eye(3), [0, 0, 0.08])

    def raised_lid(angle: float) -> FloatArray:
        return hinge @ make_pose(Rotation.from_rotvec([0, -angle, 0]).as_matrix(), [0, 0, 0])

    shape = moved(kit.shapes[1][:4], 0.05) * [1.8, 1.0, 0.1]
    edge = down([0.15, 0], 0.0, np.pi / 2)
    grasp, end = hand(raised_lid(opening) @ edge), hand(raised_lid(opening / 2) @ edge)
    arc = [raised_lid(angle) @ edge for angle in np.linspace(opening, opening / 2, 7)[1:-1]]
    return Drawn(
        (at(box, moved(2 * kit.shapes[0][:6], 0.08)), at(raised_lid(opening), shape)),
        single((backed(grasp), 0), (grasp, 0), (grasp, 1), ([*arc, end], 1), (end, 0), (backed(end), 0)),
    )


def rim(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    bowl, b = layout.things(2)
    size = layout.number(0.6, 1.6)
    edge = size * 0.05 * np.array([np.cos(0.8), np.sin(0.8)])
    grasp, release = down(edge, 0.06 * size, 0.8), down(edge, 0.06 * size + 0.02, 0.8)
    return Drawn(
        (at(bowl, kit.shapes[0][:5] * size * [1.2, 1.2, 2.0]), at(b, kit.shapes[1][:5])),
        carry(hand(bowl @ grasp), hand(b @ release)),
    )


def mirror(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    a, b = layout.things(2)
    left = 1 if layout.number(-1, 1) > 0 else -1
    grasp = a @ down([0.03, 0.04 * left], 0.03, 0.6 * left)
    return Drawn(
        (at(a, kit.shapes[0][:5] * [1, left, 1]), at(b, kit.shapes[1][:5])),
        carry(hand(grasp), hand(b @ kit.places[1])),
    )


def flip(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    a, b = layout.things(2)
    while True:
        angle = layout.number(-np.pi, np.pi)
        if abs(abs(angle) - np.pi / 2) >= CLEAR_RAD:
            break
    a = turned(a[:2, 3], angle)
    half_turn = 0.0 if abs(angle) < np.pi / 2 else np.pi
    return Drawn(
        (at(a, kit.shapes[0][:5]), at(b, kit.shapes[1][:5])),
        carry(hand(a @ down([0.02, 0.0], 0.02, half_turn)), hand(b @ kit.places[1])),
    )


def away(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    a, post, c = layout.things(3)
    middle = at(post, kit.points[1])
    direction, angle = line(at(c, kit.points[2]), middle)
    beside = hand(down(middle[:2] + 0.06 * direction, 0.04, angle))
    return Drawn(
        (at(a, kit.shapes[0][:3]), at(post, kit.shapes[1][:4]), at(c, kit.shapes[2][:3])),
        carry(hand(a @ kit.grasps[0]), beside),
    )


def order(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    def clear(places: FloatArray) -> bool:
        return np.diff(np.sort(places[:3, 1])).min() >= CLEAR_M

    *things, tray = layout.things(4, clear)
    middle = sorted(things, key=lambda pose: pose[1, 3])[1]
    release = down(tray[:2, 3], 0.06, 0.0)
    return Drawn(
        (*(at(pose, kit.shapes[0][:3]) for pose in things), tray[:3, 3][None]),
        carry(hand(middle @ kit.grasps[0]), hand(release)),
    )


def spacing(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    a, b, c = layout.things(3, lambda places: np.linalg.norm(places[0] - places[1]) < 0.25)
    first, second = at(a, kit.points[0]), at(b, kit.points[1])
    _, angle = line(first, second)
    return Drawn(
        (at(a, kit.shapes[0][:3]), at(b, kit.shapes[1][:3]), at(c, kit.shapes[2][:4])),
        carry(hand(c @ kit.grasps[2]), hand(down((2 * second - first)[:2], 0.03, angle))),
    )


def two_arms(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    a, b = layout.things(2)
    length = layout.number(0.15, 0.35)
    tray, goal = (turned(pose[:2, 3], np.pi / 2 + layout.number(-0.6, 0.6)) for pose in (a, b))
    shape = np.column_stack([(kit.shares - 0.5) * length, kit.shapes[0][:, 1], kit.shapes[0][:, 2]])[:6]
    ends = [down([end * length, 0], 0.03, np.pi / 2) for end in (-0.5, 0.5)]
    grasps = np.stack([hand(tray @ end) for end in ends])
    releases = np.stack([hand(goal @ raised(end, 0.03)) for end in ends])
    above, over = (np.stack([raised(pose) for pose in poses]) for poses in (grasps, releases))
    stops = ((above, 0), (grasps, 0), (grasps, 1), (above, 1), (over, 1), (releases, 1), (releases, 0), (over, 0))
    return Drawn((at(tray, shape), at(goal, kit.shapes[1][:4])), tuple((poses[None], state) for poses, state in stops))


def larger(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    a, b = layout.things(2)
    while True:
        sizes = layout.number(0.6, 1.6), layout.number(0.6, 1.6)
        if abs(sizes[0] - sizes[1]) >= 0.25:
            break
    shapes = [kit.shapes[0][:5] * size for size in sizes]
    grasp = (a, b)[int(np.argmax(sizes))] @ down([0, 0], 0.03, 0.3)
    return Drawn((at(a, shapes[0]), at(b, shapes[1])), carry(hand(grasp), hand(down([0.30, -0.35], 0.06, 0.0))))


def middle(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    poses = layout.things(3)
    centre = np.mean([at(pose, point) for pose, point in zip(poses, kit.points, strict=True)], axis=0)
    things = [at(pose, shape[:count]) for pose, shape, count in zip(poses, kit.shapes, (4, 3, 3), strict=True)]
    return Drawn(tuple(things), carry(hand(poses[0] @ kit.grasps[0]), hand(down(centre[:2], 0.12, 0.0))))


def row(kit: Kit, layout: Layout, hand: Hand) -> Drawn:
    a, b, c = layout.things(3)
    things = at(a, kit.shapes[0][:4]), at(b, kit.shapes[1][:3]), at(c, kit.shapes[2][:3])
    return Drawn(things, carry(hand(a @ kit.grasps[0]), hand(down([b[0, 3], c[1, 3]], 0.04, 0.0))))


FAMILIES = {
    family.name: family
    for family in (
        Family("place", "grasp in A's frame, release in B's", place),
        Family("height", "put on a thing of varying height and size", height),
        Family("door", "close a door from any opening angle", door, ("missing", "added")),
        Family("push-to", "go behind A on the line from A to B, hand along it, push to B", push_to),
        Family("point-to", "grasp A, turn towards B, tilt in B's direction", point_to),
        Family("perp", "release 10 cm to the left of the middle between A and B", perp),
        Family("along", "wipe a bar of any length from end to end", along, ()),
        Family("nearest", "of two things alike take the one nearer to the robot", nearest, ("twice as far",)),
        Family("side", "come from the left if it lies left, from the right if right", side),
        Family("lid", "close a lid to half of its angle: the hinge has to be inferred", lid, ("missing", "added")),
        Family("rim", "grasp the rim of a bowl of any size, put the bowl on B", rim),
        Family("mirror", "grasp the handle of a tool for left or right hands", mirror),
        Family("flip", "turn the grasp by 180° where the wrist would leave its range", flip),
        Family("away", "pass a post on the side away from C", away),
        Family("order", "of three things alike take the middle one from left to right", order, ("twice as far",)),
        Family("spacing", "put C on the line from A to B, as far behind B as A is before it", spacing),
        Family("two-arms", "lift a bar of any length at both ends, put its middle on B", two_arms),
        Family("larger", "of two things of one shape take the larger one", larger, ("twice as far",)),
        Family("middle", "release in the middle of three things", middle),
        Family("row", "release where the row of B meets the column of C", row),
    )
}
