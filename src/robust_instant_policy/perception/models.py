"""What an object looks like, and where it was found in an image."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from robust_instant_policy.geometry import FloatArray, project, transform_points
from robust_instant_policy.perception.descriptors import Float32Array, IntArray
from robust_instant_policy.perception.registration import COLOUR_CAP_M, Similarity
from robust_instant_policy.perception.surroundings import Surroundings
from robust_instant_policy.perception.view import View, spread_out, subsample

MAX_TEMPLATE_POINTS = 250  # of an object in one image
MAX_TEMPLATE_CELLS = 80  # of its descriptors there
SAME_OBJECT_M = 0.025  # from a registered object's points: greatest distance of other points of the object
BEST_TEMPLATES = 3  # whose mean descriptor similarity rates a motion
MIN_FITNESS = 0.15  # of the registration in an image that shows the object
SAME_THING_FITNESS = 0.5  # things of one kind in other colours have 0.3, in the same 0.7
TYPICAL_FITNESS = 0.35  # of what is there, more than that of wrong things of about the size
MAX_MISSING = 0.3  # share of the images in which an object may be missing that is well recognised in the others
NO_MOTIONS = np.zeros((0, 4, 4))


@dataclass(frozen=True, eq=False)
class Registration:
    """An object in an image: ``pose (4, 4)`` from the reference image's world to the image's, after the change of size
    ``shape (4, 4)`` (`fit_shape`), together ``motion (4, 4)``; ``fitness`` of its
    points and ``similarity`` of its descriptors, in [0, 1]; ``template``: number of the one with the most similar ones;
    ``rivals (R, 4, 4)``: other poses, and the chances ``shares (1 + R,)`` of this one and of these.
    """

    pose: FloatArray
    fitness: float
    similarity: float
    template: int
    rivals: FloatArray = field(default_factory=lambda: NO_MOTIONS)
    shares: FloatArray = field(default_factory=lambda: np.ones(1))
    shape: FloatArray = field(default_factory=lambda: np.eye(4))

    @property
    def motion(self) -> FloatArray:
        return self.pose @ self.shape

    @property
    def score(self) -> float:
        return (self.fitness + self.similarity) / 2


IN_REFERENCE = Registration(np.eye(4), 1.0, 1.0, 0)
NOT_FOUND = Registration(np.eye(4), 0.0, 0.0, 0)


@dataclass(frozen=True, eq=False)
class Template:
    """An object in one image, in the reference image's frame: a sample ``xyzrgb (N, 6)`` of its points in metres (see
    `View`), its ``surface (S, 3)`` without gaps, and the ``view``'s ``cells (M,)`` with their ``points (M, 3)``.
    """

    view: View
    xyzrgb: Float32Array
    surface: Float32Array
    cells: IntArray
    points: FloatArray


@dataclass(frozen=True, eq=False)
class Model:
    """What an object looks like: its ``templates``, the reference image's first; ``parent``: for a part that moves
    against the rest of an object, the number of that, otherwise -1; ``family``: templates of an object with all its
    parts, which tell its turn where it alone is symmetric; whether it ``varies`` in size between images; its
    ``surroundings``, where the hand's places are known and it is no part; ``colour_cap``, see `icp`.
    """

    templates: tuple[Template, ...]
    parent: int = -1
    family: tuple[Template, ...] = ()
    varies: bool = False
    surroundings: Surroundings | None = None
    colour_cap: float = COLOUR_CAP_M

    @property
    def points(self) -> FloatArray:
        """``(N, 3)`` in the reference image, metres."""
        return self.templates[0].xyzrgb[:, :3].astype(np.float64)


@dataclass(frozen=True, eq=False)
class RigidObject:
    """An object of the reference image: its ``model``, and its ``registrations`` in all images."""

    model: Model
    registrations: tuple[Registration, ...]

    @property
    def points(self) -> FloatArray:
        """``(N, 3)`` in the reference image, metres."""
        return self.model.points

    @property
    def shown(self) -> NDArray[np.bool_]:
        """Which images ``(I,)`` show it: in the others it is missing, hidden, or looks different."""
        return np.array([one.fitness >= MIN_FITNESS for one in self.registrations])

    @property
    def shared(self) -> bool:
        """Whether all images show it, or all but a few where it is well recognised in the others."""
        shown = self.shown
        if shown.all():
            return True
        if (~shown).mean() > MAX_MISSING:
            return False
        return self.typical_fitness >= TYPICAL_FITNESS

    @property
    def typical_fitness(self) -> float:
        """Median over the images that show it, but the reference image: how well it can be recognised."""
        shown = [one.fitness for one in self.registrations if one.fitness >= MIN_FITNESS]
        return float(np.median(shown[1:] or shown))


def template_of(home: View, piece: IntArray, seed: int) -> Template:
    """Of the points ``piece`` of the reference image."""
    points = home.xyzrgb[piece]
    return _template(home, np.eye(4), points, points[subsample(np.arange(len(piece)), MAX_TEMPLATE_POINTS, seed)], seed)


def another_template(
    view: View, found: Registration, templates: Sequence[Template], others: FloatArray, seed: int
) -> list[Template]:
    """The object as ``view`` shows it, apart from what is nearer to ``others (T, 3)``, or nothing where it does not."""
    to_reference = np.asarray(np.linalg.inv(found.motion), dtype=np.float64)
    known = templates[found.template].xyzrgb
    points = transform_points(to_reference, view.target[:, :3])
    distance = cKDTree(known[:, :3]).query(points, distance_upper_bound=SAME_OBJECT_M)[0]
    same = distance < SAME_OBJECT_M
    if len(others):
        same[same] = distance[same] <= cKDTree(others).query(view.target[same, :3])[0]
    if not same.any():
        return []
    seen = np.concatenate([points, view.target[:, 3:]], axis=1)[same].astype(np.float32)
    return [_template(view, to_reference, seen, known, seed)]


def _template(view: View, to_reference: FloatArray, xyzrgb: Float32Array, known: Float32Array, seed: int) -> Template:
    """Of ``xyzrgb (N, 6)`` and of the cells near ``known (M, 6)``, both in the reference image's frame."""
    points = transform_points(to_reference, view.cell_points)
    distance = cKDTree(known[:, :3]).query(points)[0]
    # Beside a higher thing, the mean point of every cell of a small one may be that of the other.
    near = np.flatnonzero(distance <= max(SAME_OBJECT_M, distance.min()))
    near = subsample(near, MAX_TEMPLATE_CELLS, seed)
    kept = subsample(np.arange(len(xyzrgb)), MAX_TEMPLATE_POINTS, seed)
    surface = xyzrgb[spread_out(xyzrgb[:, :3])][:, :3]
    return Template(view, xyzrgb[kept], surface, view.cells[near], points[near])


def similarities(templates: Sequence[Template], view: View) -> list[Float32Array]:
    """Of the cells of each of ``templates`` and those of ``view``."""
    return [one.view.descriptors.similarities(one.cells, view.descriptors, view.cells) for one in templates]


def similarity_in(
    templates: Sequence[Template], view: View, similar: Sequence[Float32Array] | None = None
) -> Similarity:
    """A function of motions ``(C, 4, 4)``: the mean descriptor similarity ``(C,)`` at their places.

    ``similar``: for each template the `similarities` of its cells and the view's, where they are known.
    """
    similar = similarities(templates, view) if similar is None else similar
    points = np.concatenate([template.points for template in templates])
    # Column of each cell of the map; those far from all foreground share a last one of zeros.
    column = np.full(view.descriptors.features.shape[0] * view.descriptors.features.shape[1], len(view.cells))
    column[view.cells] = np.arange(len(view.cells))
    padded = np.pad(np.concatenate(similar), ((0, 0), (0, 1)))
    sizes = np.array([len(template.points) for template in templates])
    starts = np.cumsum(sizes) - sizes

    def similarity(motions: FloatArray) -> FloatArray:
        moved = points @ np.swapaxes(motions[:, :3, :3], 1, 2) + motions[:, None, :3, 3]
        pixels = project(moved.reshape(-1, 3), view.observation.intrinsics, view.observation.camera_pose)
        cells, shares = view.descriptors.around(pixels)
        rows = np.tile(np.arange(len(points)), len(motions))[:, None]
        values = (padded[rows, column[cells]] * shares).sum(axis=1).reshape(len(motions), -1)
        means = np.add.reduceat(values, starts, axis=1) / sizes
        return np.sort(means, axis=1)[:, -BEST_TEMPLATES:].mean(axis=1)

    return similarity
