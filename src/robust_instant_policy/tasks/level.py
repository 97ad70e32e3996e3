"""How hard a task's scenes are: what every task varies beside its own objects.

`PAPER` draws the scenes of the paper. `NOISE` draws the same, seen by a noisy depth camera. `HARD` adds what a real
table has: a noisy camera, objects rotated by up to half a turn, distractors, other tables and light, a rod that hides a
part of the objects, and another start pose of the arm.
A cell draws everything from the `Layout` of one episode, so a task only says where its objects are and what they need.
"""

import colorsys
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from robust_instant_policy.checks import check_name
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray, make_pose, transform_points
from robust_instant_policy.tasks.camera_noise import CameraNoise
from robust_instant_policy.tasks.textures import Color

FREE_M = 0.05  # around what a task needs, without distractors: half the width of an open hand
APART_M = 0.01  # between two distractors
DISTRACTOR_WIDTH_M, DISTRACTOR_HEIGHT_M = (0.025, 0.05), (0.02, 0.05)
ROD_SHARE = 0.15  # of the way from the camera to the table, where the rod is
HIDDEN_M = 0.02  # width of the strip of the table that the rod hides
BRIGHTNESS = (0.75, 1.25)  # of the light
TABLES: tuple[Color, ...] = (
    (0.80, 0.80, 0.78),
    (0.62, 0.47, 0.32),
    (0.38, 0.28, 0.20),
    (0.30, 0.33, 0.36),
    (0.52, 0.60, 0.52),
    (0.60, 0.64, 0.72),
)
TRIES = 1000


@dataclass(frozen=True)
class Level:
    """What is varied. The defaults are those of the paper: nothing but what the task itself varies.

    ``camera`` is the noise of the images; ``turn`` the largest additional rotation of objects, rad; ``distractors`` the
    fewest and the most; ``furnishing`` whether table and light vary; ``hides`` whether a rod hides a part of an
    object; ``start`` the largest change of a joint of the start pose, rad; ``objects`` the set of the test scenes'
    objects where a task has two.
    """

    name: str
    camera: CameraNoise | None = None
    turn: float = 0.0
    distractors: tuple[int, int] = (0, 0)
    furnishing: bool = False
    hides: bool = False
    start: float = 0.0
    objects: str = "seen"

    def photographed(self, scene: Observation, seed: int, number: int) -> Observation:
        """Image ``number`` of a ``scene``, with the noise of the camera; it depends on the scene's ``seed``, too."""
        if self.camera is None:
            return scene
        return self.camera.photograph(scene, int(np.random.SeedSequence([seed, number]).generate_state(1)[0]))


PAPER = Level("paper")
HARD = Level("hard", CameraNoise(), np.pi, (2, 5), furnishing=True, hides=True, start=0.08, objects="unseen")
NOISE = Level("noise", CameraNoise())
LEVELS = {level.name: level for level in (PAPER, NOISE, HARD)}
CAMERA_LEVELS = (PAPER.name, NOISE.name)  # of scenes that a benchmark draws: only the camera varies


def make_level(name: str) -> Level:
    """The level called ``name``; raises `UnknownNameError`."""
    check_name("level", name, LEVELS)
    return LEVELS[name]


@dataclass(frozen=True)
class Region:
    """Where an arm can work: within ``nearest`` and ``farthest`` metres of its ``base (x, y)``, fingers pointing down,
    and inside of the rectangle ``view`` ((x, y), (x, y)) that the camera sees."""

    base: tuple[float, float]
    nearest: float
    farthest: float
    view: tuple[tuple[float, float], tuple[float, float]]

    def reaches(self, points: FloatArray) -> bool:
        """Whether the arm reaches all of ``points (N, 2)``."""
        distance = np.linalg.norm(points - np.array(self.base), axis=1)
        return bool((distance >= self.nearest).all() and (distance <= self.farthest).all())

    def shows(self, points: FloatArray) -> bool:
        """Whether all of ``points (N, 2)`` are in view."""
        low, high = self.view
        return bool((points >= low).all() and (points <= high).all())


@dataclass(frozen=True)
class Distractor:
    """A "box" or "cylinder" that belongs to no task: full ``width`` and ``height`` in metres, on the table at ``pose
    (4, 4)``, the frame of its middle."""

    kind: str
    width: float
    height: float
    color: Color
    pose: FloatArray

    @property
    def radius(self) -> float:
        """Of the circle around its footprint."""
        return self.width / 2 * (np.sqrt(2) if self.kind == "box" else 1.0)


@dataclass(frozen=True)
class Furnishing:
    """``table`` its colour, with wood ``grain`` or plain; light of relative ``brightness (3,)`` a colour channel, its
    directions rotated by ``azimuth`` rad about the vertical."""

    table: Color
    grain: bool
    brightness: FloatArray
    azimuth: float

    def direction(self, usual: ArrayLike) -> list[float]:
        """The direction of a lamp that ``usual``-ly shines in direction ``(3,)``."""
        return [float(part) for part in Rotation.from_euler("z", self.azimuth).apply(usual)]


@dataclass(frozen=True)
class Rod:
    """A rod from ``start (3,)`` to ``stop (3,)`` with ``radius``, metres; nothing touches it."""

    start: FloatArray
    stop: FloatArray
    radius: float


class Layout:
    """The draws of one episode at ``level``, determined by its ``seed``; objects are placed one after the other."""

    def __init__(self, level: Level, seed: int, region: Region):
        self._level, self._seed, self._region = level, seed, region
        self._needed: list[FloatArray] = []  # points (N, 2) of each object, world

    def place(self, pose: FloatArray, reach: ArrayLike, body: ArrayLike = (), turn: float = np.pi) -> FloatArray:
        """Where an object is that the task puts at ``pose (4, 4)``.

        The arm works at the points ``reach (N, 2)`` of the object's frame, and the object covers the hull of ``body
        (M, 2)``. At a level that turns objects it is rotated about the middle of these points by up to ``turn`` rad to
        either side, and moved where the arm would not reach it.
        """
        reach = np.asarray(reach, dtype=np.float64).reshape(-1, 2)
        points = np.concatenate([reach, np.asarray(body, dtype=np.float64).reshape(-1, 2)])
        placed = pose
        most = min(turn, self._level.turn)
        if most > 0:
            rng = self._rng(f"place-{len(self._needed)}")
            middle = np.append((points.min(axis=0) + points.max(axis=0)) / 2, 0.0)
            for tried in range(TRIES):
                rotation = Rotation.from_euler("z", rng.uniform(-most, most)).as_matrix()
                about = make_pose(rotation, middle - rotation @ middle)
                shift = make_pose(np.eye(3), [*rng.normal(0.0, 0.2 * tried / TRIES, 2), 0.0])
                placed = shift @ pose @ about
                if self._region.reaches(_flat(placed, reach)) and self._region.shows(_flat(placed, points)):
                    break
            else:
                placed = pose
        self._needed.append(_flat(placed, points))
        return placed

    def home(self, usual: FloatArray) -> FloatArray:
        """Start pose of arms whose joint angles are ``usual (A, J)``, rad."""
        if not self._level.start:
            return usual
        return usual + self._rng("home").uniform(-self._level.start, self._level.start, usual.shape)

    def furnishing(self) -> Furnishing | None:
        """Table and light; None for the usual ones."""
        if not self._level.furnishing:
            return None
        rng = self._rng("surroundings")
        tint = rng.uniform(*BRIGHTNESS) * np.array([1.0, 1.0, 1.0]) * rng.uniform(0.92, 1.08, 3)
        table = TABLES[int(rng.integers(len(TABLES)))]
        return Furnishing(table, bool(rng.random() < 0.5), tint, float(rng.uniform(-np.pi, np.pi)))

    def distractors(self) -> list[Distractor]:
        """Objects that belong to no task, beside what has been placed."""
        rng = self._rng("distractors")
        found: list[Distractor] = []
        low, high = (np.array(corner) for corner in self._region.view)
        for _ in range(int(rng.integers(self._level.distractors[0], self._level.distractors[1] + 1))):
            width, height = rng.uniform(*DISTRACTOR_WIDTH_M), rng.uniform(*DISTRACTOR_HEIGHT_M)
            red, green, blue = colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.4, 0.9), rng.uniform(0.4, 0.9))
            kind, turned = ("box", "cylinder")[int(rng.integers(2))], rng.uniform(-np.pi, np.pi)
            for _ in range(TRIES):
                at = rng.uniform(low + width, high - width)
                pose = make_pose(Rotation.from_euler("z", turned).as_matrix(), [*at, height / 2])
                new = Distractor(kind, width, height, (red, green, blue), pose)
                if self._is_free(at, new.radius, found):
                    found.append(new)
                    break
        return found

    def rod(self, camera: ArrayLike) -> Rod | None:
        """What hides a part of the first object from a camera at ``camera (3,)``; None where nothing does."""
        if not self._level.hides or not self._needed:
            return None
        rng = self._rng("rod")
        points, eye = self._needed[0], np.asarray(camera, dtype=np.float64)
        share = rng.uniform(0.2, 0.8)
        angle = rng.uniform(0.0, np.pi)
        # The edge of the strip goes through the object, so that small ones are not hidden altogether.
        aside = HIDDEN_M / 2 * np.array([-np.sin(angle), np.cos(angle)])
        target = np.append(share * points.min(axis=0) + (1 - share) * points.max(axis=0) + aside, 0.0)
        middle = eye + ROD_SHARE * (target - eye)
        half = ROD_SHARE * np.array([np.cos(angle), np.sin(angle), 0.0])  # as long as the view is wide, and more
        return Rod(middle - half, middle + half, ROD_SHARE * HIDDEN_M / 2)

    def _is_free(self, at: FloatArray, radius: float, others: list[Distractor]) -> bool:
        apart = [np.linalg.norm(at - one.pose[:2, 3]) - one.radius for one in others]
        if any(distance < radius + APART_M for distance in apart):
            return False
        around = np.linspace(0.0, 2 * np.pi, 12, endpoint=False)
        circle = (radius + FREE_M) * np.stack([np.cos(around), np.sin(around)], axis=1)
        for points in self._needed:
            hull = ConvexHull((points[:, None] + circle).reshape(-1, 2))
            if (hull.equations[:, :2] @ at + hull.equations[:, 2] <= 0).all():
                return False
        return True

    def _rng(self, what: str) -> np.random.Generator:
        return np.random.default_rng([self._seed, *b"level", *what.encode()])


def _flat(pose: FloatArray, points: FloatArray) -> FloatArray:
    """``points (N, 2)`` of the frame ``pose`` on the table, in the world."""
    return transform_points(pose, np.column_stack([points, np.zeros(len(points))]))[:, :2]
