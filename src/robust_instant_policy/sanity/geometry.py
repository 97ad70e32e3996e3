"""Whether images, cameras and gripper paths of a set of demonstrations belong together, and if not, why."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.sanity.consistency import MIN_DEMONSTRATIONS, Consistency, repetition
from robust_instant_policy.sanity.contact import Contact, GripperPath, contact
from robust_instant_policy.sanity.hypotheses import ALL, DISPLACED, Hypothesis
from robust_instant_policy.sanity.view import View, coarse

TOUCH_M = 0.03  # gap below which a path, or a closing gripper, touches a surface: fingers beside a thin thing
TOUCH_DEVIATIONS = 4.0  # of the depth's noise, added to that
BELOW_TABLE_M = 0.015  # that a fingertip may lie below the table's plane: fingers press on tables
BURIED_M = 0.03  # that a gripper point may lie behind a surface of the start image
MIN_SHARE = 0.5  # of the demonstrations that must agree with their images
FAR_M = 0.06  # gap from which a path does not touch at all, when hypotheses are compared
REPEATED = 1.5  # weight of consistency beside those shares
BETTER = 0.45  # by which the sum of the shares of a hypothesis must exceed that of the data as they are
CONSISTENT = 0.42  # score from which surroundings repeat; the ten simulated tasks have 0.50 to 0.98
EXPLAINED = 0.35  # consistency that a hypothesis must reach, and
MOSTLY = 0.7  # share of the paths, or of the closing grippers, that must touch under it
LESS_LEVEL = 0.05  # by which the share of readings on the table may be lower under a hypothesis
COARSE_PX = 112  # longer edge of the grid on which hypotheses are compared
TESTED = 6  # demonstrations on which hypotheses are compared
PAIRED = 20  # demonstrations among which images are exchanged
PAIRINGS = 3  # wrong pairings of images and paths that the right one is compared with


@dataclass(frozen=True, eq=False)
class Evidence:
    """How well paths and images fit, as shares of the demonstrations (0 to 1).

    ``touching``: the path meets a raised surface; ``grasping``: so does the gripper where it closes (share of all
    closings); ``clear``: no fingertip is below the table and no gripper point inside a surface; ``above``: the former
    alone; ``level``: the camera is above the table and the readings lie on one plane.
    """

    contacts: tuple[Contact, ...]
    surroundings: Consistency
    touching: float
    grasping: float
    clear: float
    above: float
    level: float

    @property
    def touches(self) -> bool:
        return self.touching >= MIN_SHARE or self.grasping >= MIN_SHARE

    @property
    def is_clear(self) -> bool:
        return self.clear >= MIN_SHARE

    @property
    def is_above(self) -> bool:
        return self.above >= MIN_SHARE

    @property
    def is_right(self) -> bool:
        """Whether nothing of it speaks against images and paths; what repeats may be unknown."""
        repeats = not self.surroundings.score < CONSISTENT
        return self.is_clear and self.touches and repeats and self.level > 0

    @property
    def total(self) -> float:
        """What hypotheses are compared by: the shares, gaps counted gradually, and consistency."""
        paths = _near(np.array([c.path for c in self.contacts]))
        grasps = _near(np.concatenate([c.grasps for c in self.contacts]))
        repeated = np.nan_to_num(self.surroundings.score)
        return paths + grasps + self.clear + self.level + REPEATED * float(repeated)

    @property
    def path_gap(self) -> float:
        """Median over the demonstrations, metres."""
        return float(np.median([c.path for c in self.contacts]))

    @property
    def grasp_gap(self) -> float:
        """Median over all closings, metres; NaN where no gripper closes."""
        every = np.concatenate([c.grasps for c in self.contacts])
        return float(np.median(every)) if len(every) else float("nan")

    @property
    def lowest(self) -> float:
        """Median over the demonstrations of the lowest fingertip's height above the table, metres."""
        return float(np.median([c.lowest for c in self.contacts]))


def _near(gaps: FloatArray) -> float:
    return float(np.clip(1 - gaps / FAR_M, 0, 1).mean()) if len(gaps) else 0.0


def touch_distance(view: View) -> float:
    """Gap below which a path touches what ``view`` shows, metres; noise hides thin things."""
    return TOUCH_M + TOUCH_DEVIATIONS * view.noise


def is_above(contact: Contact, view: View) -> bool:
    """Whether a path stays above the table."""
    lowest = min(contact.lowest, contact.lowest_gripper_point)
    return lowest > -(BELOW_TABLE_M + 2 * view.noise) or not view.is_support


def fits(contact: Contact, view: View) -> bool:
    """Whether a path stays above the table and outside of what the image shows."""
    return is_above(contact, view) and contact.buried < BURIED_M


def evidence(views: Sequence[View], paths: Sequence[GripperPath], poses: Sequence[FloatArray]) -> Evidence:
    """Of ``views``, and the `GripperPath` and tool poses that belong to each."""
    contacts = tuple(contact(view, path) for view, path in zip(views, paths, strict=True))
    reach = [touch_distance(view) for view in views]
    closings = np.concatenate([c.grasps < near for c, near in zip(contacts, reach, strict=True)])
    return Evidence(
        contacts=contacts,
        surroundings=repetition(views, poses),
        touching=float(np.mean([c.path < near for c, near in zip(contacts, reach, strict=True)])),
        grasping=float(closings.mean()) if len(closings) else 0.0,
        clear=float(np.mean([fits(c, view) for c, view in zip(contacts, views, strict=True)])),
        above=float(np.mean([is_above(c, view) for c, view in zip(contacts, views, strict=True)])),
        level=float(np.mean([view.share_on_plane * (view.camera_height > 0) for view in views])),
    )


@dataclass(frozen=True)
class Explanation:
    """A hypothesis that fits, and the evidence with its correction applied.

    ``displaced``: the camera beside its place, which is no known mistake and may fit by chance.
    """

    cause: str
    remedy: str
    evidence: Evidence
    displaced: bool = False


def explain(
    demonstrations: Sequence[Demonstration], paths: Sequence[GripperPath], poses: Sequence[FloatArray]
) -> Explanation | None:
    """The hypothesis under which images and paths fit best, if clearly better than as they are."""
    chosen = np.unique(np.round(np.linspace(0, len(demonstrations) - 1, TESTED)).astype(np.intp))
    some = [coarse(demonstrations[i].observation, COARSE_PX) for i in chosen]
    own_paths, own_poses = [paths[i] for i in chosen], [poses[i] for i in chosen]

    def under(hypothesis: Hypothesis | None) -> Evidence:
        views = [View.of(hypothesis.correct(o) if hypothesis else o, repaired=True) for o in some]
        return evidence(views, own_paths, own_poses)

    as_is = under(None)
    found = [Explanation(h.cause, h.remedy, under(h)) for h in ALL]
    found += _other_pairing(demonstrations[:PAIRED], paths[:PAIRED], poses[:PAIRED])
    found = [e for e in found if e.evidence.level > as_is.level - LESS_LEVEL]
    best = max(found, key=lambda e: e.evidence.total, default=Explanation("", "", as_is))
    if best.evidence.total <= as_is.total + BETTER:  # no known mistake: is the camera beside where it should be?
        best = max(
            (Explanation(h.cause, h.remedy, under(h), displaced=True) for h in DISPLACED),
            key=lambda e: e.evidence.total,
        )
    clear = best.evidence.touching >= MOSTLY or best.evidence.grasping >= MOSTLY
    score = best.evidence.surroundings.score
    clear = clear and (not np.isfinite(score) or score >= EXPLAINED)
    return best if clear and best.evidence.total > as_is.total + BETTER else None


def _other_pairing(
    demonstrations: Sequence[Demonstration], paths: Sequence[GripperPath], poses: Sequence[FloatArray]
) -> list[Explanation]:
    """The assignment of images to paths with the smallest gaps, where it is not the given one."""
    if len(demonstrations) < MIN_DEMONSTRATIONS:
        return []
    views = [View.of(coarse(d.observation, COARSE_PX), repaired=True) for d in demonstrations]
    costs = np.array([[_gap(contact(view, path)) for view in views] for path in paths])
    _, order = linear_sum_assignment(costs)
    moved = int((order != np.arange(len(order))).sum())
    if moved < len(order) / 2:
        return []
    return [
        Explanation(
            f"other images ({moved} of {len(order)} paths exchanged)",
            "the trajectories are shuffled against the images: pair each with the image of its own episode",
            evidence([views[i] for i in order], paths, poses),
        )
    ]


def _gap(found: Contact) -> float:
    return found.path + float(found.grasps.sum()) + max(-found.lowest, 0.0)


def pairing_scores(views: Sequence[View], poses: Sequence[FloatArray]) -> tuple[float, float]:
    """Consistency of images with their own paths, and the mean over cyclic wrong pairings."""
    count = len(views)
    own = repetition(views, poses).score
    shifts = sorted({round(shift) for shift in np.linspace(1, count - 1, PAIRINGS)}) if count > 1 else []
    wrong = [repetition([views[(i + shift) % count] for i in range(count)], poses).score for shift in shifts]
    return own, float(np.mean(wrong)) if wrong else float("nan")
