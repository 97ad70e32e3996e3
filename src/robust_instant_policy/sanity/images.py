"""The images of a set of demonstrations against its paths."""

from collections.abc import Sequence

import numpy as np

from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.sanity.consistency import MIN_DEMONSTRATIONS
from robust_instant_policy.sanity.contact import Contact, GripperPath
from robust_instant_policy.sanity.finding import Finding, Severity, errors
from robust_instant_policy.sanity.geometry import (
    BELOW_TABLE_M,
    BURIED_M,
    CONSISTENT,
    EXPLAINED,
    FAR_M,
    MIN_SHARE,
    TOUCH_M,
    Evidence,
    Explanation,
    evidence,
    explain,
    is_above,
    pairing_scores,
)
from robust_instant_policy.sanity.view import View

OWN_BETTER = 0.2  # by which the own images' consistency must exceed that of other images,
ROOM = 0.5  # and less where these leave less than that to the greatest, 1: scenes of which little moves
DECISIVE, LEAST = 3.0, 0.1  # times other images' consistency, and at least, from which a low one tells them apart
SAME_EVERYWHERE = 0.95  # from which on what is around the gripper looks alike in all scenes, and nothing is told
CLOSE_M = 0.015  # gap from which a path is compared with other hypotheses, too
ONE_SCENE_M = 0.01  # spread of the objects below which all demonstrations show one scene
UNLIKE = 0.25  # likeness below which a demonstration contradicts the others,
ALIKE = 0.6  # where their median is at least this
FAR_FROM_ALL_M = 0.06  # gap of a path that alone touches nothing
MUCH_BETTER = 0.2  # by which the consistency under a hypothesis must be higher where the images nearly fit as they are
LESS_CONSISTENT = 0.05  # by which the consistency under a hypothesis may be lower


def check_contact(
    demonstrations: Sequence[Demonstration],
    views: Sequence[View],
    paths: Sequence[GripperPath],
    poses: Sequence[FloatArray],
    as_is: Evidence,
) -> list[Finding]:
    """Whether the paths meet what their images show; if not, why."""
    count, score = len(views), as_is.surroundings.score
    own, other = score, float("nan")
    if count > MIN_DEMONSTRATIONS and scene_spread(views) > ONE_SCENE_M:
        own, other = pairing_scores(views, poses)
    right = as_is.is_right and not _fit_others(own, other)
    near = np.mean([c.path < CLOSE_M for c in as_is.contacts]) >= MIN_SHARE
    if right and (near or count <= MIN_DEMONSTRATIONS):
        return _outliers(views, as_is)
    met = [index for index, c in enumerate(as_is.contacts) if c.path <= FAR_FROM_ALL_M]
    if MIN_SHARE * count < len(met) < count:  # are the others right without those that touch nothing?
        contradicting = _outliers(views, as_is)
        of_met = evidence([views[i] for i in met], [paths[i] for i in met], [poses[i] for i in met])
        if errors(contradicting) and of_met.is_right:
            return contradicting
    numbers = {
        "path_gap": as_is.path_gap,
        "grasp_gap": as_is.grasp_gap,
        "lowest": as_is.lowest,
        "consistency": score,
        "other_images": other,
        "touching": as_is.touching,
        "clear": as_is.clear,
    }
    explanation = explain(demonstrations, paths, poses)
    # a hypothesis under which the surroundings repeat less comes nearer by chance
    if explanation and not (right and explanation.evidence.surroundings.score < score - LESS_CONSISTENT):
        words = f"{_measured(as_is)}; {_explained(explanation)}"
        # Where the images do fit as they are, a hypothesis that fits better proves nothing. Things are also pushed with
        # another part of a hand than its fingertips, and what lies behind or under a surface may be free.
        better = explanation.evidence.surroundings.score - score
        clear = as_is.is_clear or (
            as_is.is_above and score >= CONSISTENT and (explanation.displaced or better < MUCH_BETTER)
        )
        nearly = as_is.path_gap < FAR_M and better < MUCH_BETTER
        fits_as_is = right or (clear and (nearly or (as_is.touches and (explanation.displaced or not as_is.is_clear))))
        return [Finding("contact", "warning" if fits_as_is else "error", words, numbers, explanation.cause)]
    if right:
        return _outliers(views, as_is)
    if (unexplained := _unexplained(views, as_is, own, other)) is None:
        return []
    severity, words, cause = unexplained
    return [Finding("contact", severity, words, numbers, cause)]


def _unexplained(views: Sequence[View], as_is: Evidence, own: float, other: float) -> tuple[Severity, str, str] | None:
    """Severity, words and cause where no hypothesis fits; consistency with the ``own`` and ``other`` images.

    None where all fits, only that the surroundings repeat little, but far more than with other images.
    """
    closes = any(len(c.grasps) for c in as_is.contacts)
    score = as_is.surroundings.score
    if not as_is.is_clear:
        severity: Severity = "warning" if as_is.is_above and as_is.touches and score >= CONSISTENT else "error"
        return severity, f"{_measured(as_is)}; check the camera's pose, the depth unit and the tool's offset", ""
    if not any(view.raised.any() for view in views):
        words = "nothing in the images stands above the table: whether images and paths belong together was not checked"
        return "warning" if closes else "unchecked", words, "flat depth: nothing raised"
    if not as_is.touches and closes and as_is.path_gap >= FAR_M:
        advice = "check the camera's pose, the tool's offset and which image belongs to which path"
        return "error", f"{_measured(as_is)}; {advice}", ""
    if not as_is.touches:
        closing = "the gripper closes near no surface" if closes else "nothing closes there"
        return "warning", f"{_measured(as_is)}; {closing}, so it was not checked further", ""
    if _fit_others(own, other):
        if own >= SAME_EVERYWHERE:
            words = f"what the images show around the gripper is alike in all scenes ({own:.2f} of 1)"
            return "unchecked", f"{words}: whether each path belongs to its image was not decided", ""
        words = f"the paths fit their own images no better than each other's ({own:.2f} against {other:.2f} of 1)"
        advice = "trajectories are shuffled against images, or the images are mirrored, or of another camera"
        return "error", f"{words}; {advice}", "other images"
    if own >= EXPLAINED and own > DECISIVE * other:
        return None
    words = f"what the images show around the gripper hardly repeats across the demonstrations ({score:.2f} of 1)"
    return "unchecked", f"{words}: whether the camera is right was not decided", ""


def _fit_others(own: float, other: float) -> bool:
    """Whether paths fit ``other`` images about as well as their ``own``; False where either is unknown.

    Clutter lowers both: then the ratio tells.
    """
    if own >= LEAST and own > DECISIVE * other:
        return False
    return own < other + OWN_BETTER * min(1.0, (1 - other) / ROOM)


def _measured(as_is: Evidence) -> str:
    """What is wrong with the evidence, worst first."""
    if as_is.lowest < -TOUCH_M:
        return f"fingertips reach {-as_is.lowest * 1e3:.0f} mm below the table that the images show"
    if not as_is.is_clear:
        buried = float(np.median([c.buried for c in as_is.contacts]))
        if buried < BURIED_M:
            lowest = float(np.median([min(c.lowest, c.lowest_gripper_point) for c in as_is.contacts]))
            return f"the gripper reaches {-lowest * 1e3:.0f} mm below the table that the images show"
        return f"the gripper point passes {buried * 1e3:.0f} mm deep through what the images show"
    if as_is.touching < MIN_SHARE:
        if np.isfinite(as_is.grasp_gap) and as_is.grasp_gap > TOUCH_M:
            grasps = f"grasp points lie {as_is.grasp_gap:.2f} m from any surface"
            return f"{grasps}, and no path comes nearer than {as_is.path_gap:.2f} m"
        return f"paths come no nearer than {as_is.path_gap:.2f} m to any surface"
    if (score := as_is.surroundings.score) < CONSISTENT:
        return f"what the images show around the gripper does not repeat across the demonstrations ({score:.2f} of 1)"
    if as_is.level > 0:
        return f"paths come within {as_is.path_gap * 1e3:.0f} mm of what the images show"
    return "the camera lies below the table that it sees"


def _explained(explanation: Explanation) -> str:
    found = explanation.evidence
    count = len(found.contacts)
    near = sum(c.path < TOUCH_M for c in found.contacts)
    words = f"with {explanation.cause} {near} of {count} come within {TOUCH_M * 1e3:.0f} mm"
    if np.isfinite(found.surroundings.score):
        words += f" and repeat by {found.surroundings.score:.2f}"
    return f"{words}: {explanation.remedy}"


def _outliers(views: Sequence[View], as_is: Evidence) -> list[Finding]:
    """Single demonstrations whose path does not fit their image while the others' do.

    What most do is no contradiction: one may reach as low as they do, as into a hole of which its image shows less.
    Where most reach below the table, as into a hole, one that reaches deeper is only told, and so is one of two.
    """
    if len(views) < MIN_DEMONSTRATIONS:
        return _one_of_two(views, as_is)
    likeness = as_is.surroundings.likeness
    usual = float(np.median(likeness))
    usual_height = float(np.median([c.least_height for c in as_is.contacts]))
    low, into_hole = usual_height - BELOW_TABLE_M, usual_height < -BELOW_TABLE_M
    deep = np.median([c.buried for c in as_is.contacts]) + BELOW_TABLE_M
    found = []
    for index, (c, view) in enumerate(zip(as_is.contacts, views, strict=True)):
        unlike = usual >= ALIKE and likeness[index] < UNLIKE
        apart = c.path > FAR_FROM_ALL_M and as_is.touching > 1 - MIN_SHARE
        below = c.least_height < low and not is_above(c, view)
        if not (unlike or apart or below or c.buried > max(BURIED_M, deep)):
            continue
        words = (
            f"demonstration {index} contradicts the others: {_gap(c, view)}, its lowest fingertip is "
            f"{c.lowest * 1e3:.0f} mm above the table, and it is "
            f"{likeness[index]:.2f} like the others ({usual:.2f}); look at it, and remove it if it is wrong"
        )
        severity: Severity = "error" if apart or (below and not into_hole and likeness[index] < ALIKE) else "warning"
        numbers = {"demonstration": float(index), "path_gap": c.path, "likeness": float(likeness[index])}
        found.append(Finding("contradiction", severity, words, numbers, f"demonstration {index}"))
    return found


def _one_of_two(views: Sequence[View], as_is: Evidence) -> list[Finding]:
    """The one of two demonstrations whose path meets nothing in its image while the other's does."""
    far = [index for index, c in enumerate(as_is.contacts) if c.path > FAR_FROM_ALL_M]
    if len(views) != 2 or len(far) != 1:
        return []
    (index,) = far
    c = as_is.contacts[index]
    words = f"demonstration {index} fits its image worse than the other one: {_gap(c, views[index])}; look at it"
    numbers = {"demonstration": float(index), "path_gap": c.path}
    return [Finding("contradiction", "warning", words, numbers, f"demonstration {index}")]


def _gap(contact: Contact, view: View) -> str:
    if not len(view.raised_points):
        return "its image shows nothing above the table"
    return f"its path comes no nearer than {contact.path * 1e3:.0f} mm to a surface"


def scene_spread(views: Sequence[View]) -> float:
    """Root mean square distance of what is raised from its mean over the scenes, metres; NaN where unknown."""
    centres = np.array([view.object_centre for view in views if len(view.raised_points)])
    if len(centres) < 2:
        return float("nan")
    return float(np.sqrt(((centres - centres.mean(axis=0)) ** 2).sum(axis=1).mean()))
