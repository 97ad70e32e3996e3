"""The images of a set of demonstrations against its paths, and against each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.sanity.agreement import CLEARLY, Agreement, exchanged
from robust_instant_policy.sanity.consistency import MIN_DEMONSTRATIONS
from robust_instant_policy.sanity.contact import Path, gaps
from robust_instant_policy.sanity.envelope import approaches
from robust_instant_policy.sanity.finding import Finding, Severity
from robust_instant_policy.sanity.geometry import (
    BURIED_M,
    CONSISTENT,
    MIN_SHARE,
    TOUCH_M,
    Evidence,
    Explanation,
    explain,
    fits,
    pairing_scores,
    touch_distance,
)
from robust_instant_policy.sanity.hypotheses import reordered_quaternions
from robust_instant_policy.sanity.image import check_image
from robust_instant_policy.sanity.view import View

PAIRED = 0.2  # by which the own images' consistency must exceed that of other images
CLOSE_M = 0.015  # gap from which a path is compared with other hypotheses, too
LOWEST_PALM_M = 0.02  # above the table
MOSTLY = 0.8  # share of the demonstrations
ONE_SCENE_M = 0.01  # spread of the objects below which all demonstrations show one scene
UNLIKE = 0.25  # likeness below which a demonstration contradicts the others,
ALIKE = 0.6  # where their median is at least this
FAR_FROM_ALL_M = 0.06  # gap of a path that alone touches nothing
LESS_CONSISTENT = 0.05  # by which the consistency under a hypothesis may be lower
STRAIGHT_RAD, CROOKED_RAD = (
    np.deg2rad(3.5),
    np.deg2rad(10.0),
)  # spread of the approach with quaternions in order, or not


def check_each_image(views: Sequence[View]) -> list[Finding]:
    """`check_image` of every view, the same finding told once."""
    told: dict[tuple[str, Severity], list[tuple[int, Finding]]] = {}
    for index, view in enumerate(views):
        for finding in check_image(view):
            told.setdefault((finding.kind, finding.severity), []).append((index, finding))
    result = []
    for (kind, severity), cases in told.items():
        index, first = cases[0]
        where = "all demonstrations" if len(cases) == len(views) else f"{len(cases)} of {len(views)} demonstrations"
        where = f"demonstration {index}" if len(cases) == 1 else f"{where}, such as {index}"
        result.append(Finding(kind, severity, f"{where}: {first.message}", first.numbers, first.cause))
    return result


def check_contact(
    demonstrations: Sequence[Demonstration],
    views: Sequence[View],
    paths: Sequence[Path],
    poses: Sequence[FloatArray],
    today: Evidence,
) -> list[Finding]:
    """Whether the paths meet what their images show; if not, why."""
    count, score = len(views), today.surroundings.score
    touches = today.touching >= MIN_SHARE or today.grasping >= MIN_SHARE
    repeats = not np.isfinite(score) or score >= CONSISTENT
    own, other = score, float("nan")
    if count > MIN_DEMONSTRATIONS and scene_spread(views) > ONE_SCENE_M:
        own, other = pairing_scores(views, poses)
    exchangeable = own < other + PAIRED
    right = today.clear >= MIN_SHARE and touches and repeats and today.level > 0 and not exchangeable
    if right and np.mean([c.path < CLOSE_M for c in today.contacts]) >= MIN_SHARE:
        return _outliers(views, today)
    numbers = {
        "path_gap": today.path_gap,
        "grasp_gap": today.grasp_gap,
        "lowest": today.lowest,
        "consistency": score,
        "other_images": other,
        "touching": today.touching,
        "clear": today.clear,
    }
    explanation = None if right and count <= MIN_DEMONSTRATIONS else explain(demonstrations, paths, poses)
    if explanation and right and explanation.evidence.surroundings.score < score - LESS_CONSISTENT:
        explanation = None  # nearer by chance: what it shows around the gripper repeats less
    if explanation:
        words = f"{_measured(today)}; {_explained(explanation)}"
        # where the images do fit as they are, a hypothesis that fits better proves nothing
        meets = touches and today.clear >= MIN_SHARE
        severity: Severity = "warning" if right or (meets and explanation.displaced) else "error"
        return [Finding("contact", severity, words, numbers, explanation.cause)]
    if right:
        return _outliers(views, today)
    if not any(view.raised.any() for view in views) and today.clear >= MIN_SHARE:
        words = "nothing in the images stands above the table: whether images and paths belong together was not checked"
        closes = any(len(c.grasps) for c in today.contacts)
        return [Finding("contact", "warning" if closes else "unchecked", words, numbers, "flat depth: nothing raised")]
    if today.clear < MIN_SHARE:
        advice = "; check the camera's pose, the depth unit and the tool's offset"
        return [Finding("contact", "error", _measured(today) + advice, numbers)]
    if not touches:
        closes = any(len(c.grasps) for c in today.contacts)
        advice = "; check the camera's pose, the tool's offset and which image belongs to which path"
        words = _measured(today) + (advice if closes else "; nothing closes there, so it was not checked further")
        return [Finding("contact", "error" if closes else "warning", words, numbers)]
    if exchangeable:
        words = f"the paths fit their own images no better than each other's ({own:.2f} against {other:.2f} of 1)"
        advice = "; trajectories are shuffled against images, or the images are mirrored, or of another camera"
        return [Finding("contact", "error", words + advice, numbers, "other images")]
    words = f"what the images show around the gripper hardly repeats across the demonstrations ({score:.2f} of 1)"
    return [Finding("contact", "unchecked", f"{words}: whether the camera is right was not decided", numbers)]


def _measured(today: Evidence) -> str:
    """What is wrong with the evidence, worst first."""
    if today.lowest < -TOUCH_M:
        return f"fingertips reach {-today.lowest * 1e3:.0f} mm below the table that the images show"
    if today.clear < MIN_SHARE:
        buried = float(np.median([c.buried for c in today.contacts]))
        if buried < BURIED_M:
            lowest = float(np.median([min(c.lowest, c.lowest_palm) for c in today.contacts]))
            return f"the gripper reaches {-lowest * 1e3:.0f} mm below the table that the images show"
        return f"the palm passes {buried * 1e3:.0f} mm deep through what the images show"
    if today.touching < MIN_SHARE:
        if np.isfinite(today.grasp_gap) and today.grasp_gap > TOUCH_M:
            grasps = f"grasp points lie {today.grasp_gap:.2f} m from any surface"
            return f"{grasps}, and no path comes nearer than {today.path_gap:.2f} m"
        return f"paths come no nearer than {today.path_gap:.2f} m to any surface"
    score = today.surroundings.score
    if np.isfinite(score) and score < CONSISTENT:
        return f"what the images show around the gripper does not repeat across the demonstrations ({score:.2f} of 1)"
    if today.level > 0:
        return f"paths come within {today.path_gap * 1e3:.0f} mm of what the images show"
    return "the camera lies below the table that it sees"


def _explained(explanation: Explanation) -> str:
    found = explanation.evidence
    count = len(found.contacts)
    near = sum(c.path < TOUCH_M for c in found.contacts)
    words = f"with {explanation.cause} {near} of {count} come within {TOUCH_M * 1e3:.0f} mm"
    if np.isfinite(found.surroundings.score):
        words += f" and repeat by {found.surroundings.score:.2f}"
    return f"{words}: {explanation.remedy}"


def check_palms(today: Evidence) -> list[Finding]:
    """A palm that touches the table belongs to a tool frame whose axes or offset are wrong."""
    lowest = float(np.median([c.lowest_palm for c in today.contacts]))
    if lowest > LOWEST_PALM_M:
        return []
    words = f"the palm comes within {lowest * 1e3:.0f} mm of the table: the gripper lies on its side or upside down"
    advice = "; check the tool frame (z out of the gripper) and the order of quaternions"
    return [Finding("rotation", "warning", words + advice, {"lowest_palm": lowest}, "tool frame")]


def check_openings(demonstrations: Sequence[Demonstration], views: Sequence[View]) -> list[Finding]:
    """Grippers that begin closed and open where there is something to grasp may have their states inverted."""
    inverted = 0
    for demonstration, view in zip(demonstrations, views, strict=True):
        closed = demonstration.trajectory.gripper_state[:, 0] > 0.5
        if not closed[0] or closed.all():
            continue
        first = int((~closed).argmax())
        middle = demonstration.trajectory.triplets[first, 0, 1:].mean(axis=0)
        inverted += bool(gaps(view, middle[None])[0] < touch_distance(view))
    if inverted < MOSTLY * len(views):
        return []
    words = f"in {inverted} of {len(views)} demonstrations the gripper begins closed and opens at a surface"
    advice = ": are its states inverted? 0 is open, 1 is closed"
    return [Finding("gripper state", "warning", words + advice, {"inverted": float(inverted)}, "states inverted")]


def _outliers(views: Sequence[View], today: Evidence) -> list[Finding]:
    """Single demonstrations whose path does not fit their image while the others' do."""
    if len(views) < MIN_DEMONSTRATIONS + 1:
        return []
    likeness = today.surroundings.likeness
    usual = float(np.median(likeness))
    found = []
    for index, (c, view) in enumerate(zip(today.contacts, views, strict=True)):
        unlike = usual >= ALIKE and likeness[index] < UNLIKE
        apart = c.path > FAR_FROM_ALL_M and today.touching > 1 - MIN_SHARE
        if not (unlike or apart or not fits(c, view)):
            continue
        words = (
            f"demonstration {index} contradicts the others: its path comes within {c.path * 1e3:.0f} mm of a surface, "
            f"its lowest fingertip is {c.lowest * 1e3:.0f} mm above the table, and it is {likeness[index]:.2f} like "
            f"the others ({usual:.2f}); look at it, and remove it if it is wrong"
        )
        severity: Severity = "error" if apart or not fits(c, view) else "warning"
        numbers = {"demonstration": float(index), "path_gap": c.path, "likeness": float(likeness[index])}
        found.append(Finding("contradiction", severity, words, numbers, f"demonstration {index}"))
    return found


def check_quaternions(demonstrations: Sequence[Demonstration]) -> list[Finding]:
    """Grippers that lean to all sides, and would all approach in one direction with quaternions in the other order."""
    directions = [approaches(d.trajectory).reshape(-1, 3) for d in demonstrations]
    now = _spread(np.concatenate(directions))
    if now < CROOKED_RAD:
        return []
    # one order for all arms: the triangle is the same
    triplets = np.concatenate([d.trajectory.triplets.reshape(-1, 3, 3) for d in demonstrations])
    for words, other in reordered_quaternions(triplets):
        forward = other[:, 1:].mean(axis=1) - other[:, 0]
        if (then := _spread(forward / np.linalg.norm(forward, axis=1, keepdims=True))) < STRAIGHT_RAD:
            message = (
                f"grippers lean by {np.rad2deg(now):.0f} degrees from their mean approach; with {words} all approach "
                f"within {np.rad2deg(then):.1f} degrees: check the order of the quaternion's numbers"
            )
            return [Finding("rotation", "error", message, {"spread": now, "spread_reordered": then}, words)]
    return []


def _spread(directions: FloatArray) -> float:
    """90th percentile of the angle to the mean direction, rad."""
    mean = directions.mean(axis=0)
    mean /= max(float(np.linalg.norm(mean)), 1e-9)
    return float(np.percentile(np.arccos(np.clip(directions @ mean, -1, 1)), 90))


def check_agreement(views: Sequence[View], found: Sequence[Agreement]) -> list[Finding]:
    """Whether colour and depth of the demonstrations show the same scenes."""
    ratios = np.array([one.ratio for one in found])
    if not np.isfinite(ratios).any():
        return []
    usual = float(np.nanmedian(ratios))
    numbers = {"edges": usual}
    if usual >= CLEARLY:
        low = [i for i, one in enumerate(found) if one.ratio < 1 + (usual - 1) / 4]
        words = f"colour and depth of demonstration {low[0]} show different scenes" if low else ""
        return [Finding("colour and depth", "warning", words, numbers)] if low else []
    if len({view.depth.shape for view in views}) == 1:
        moved, best, today = exchanged(views)
        if moved > len(views) / 2 and best > CLEARLY * today:
            words = (
                f"edges of depth are no edges of colour; with other colour images ({moved} of {len(views)}) they are"
            )
            advice = f" ({best / max(today, 1e-9):.1f} times stronger): pair each depth image with its own colour image"
            cause = "colour and depth of different episodes"
            return [Finding("colour and depth", "error", words + advice, numbers, cause)]
    causes = [one.cause for one in found if one.cause]
    kinds = [cause.split(" (")[0] for cause in causes]
    common = max(set(kinds), key=kinds.count, default="")
    if common and kinds.count(common) >= MIN_SHARE * len(found):
        words = f"edges of depth are no edges of colour ({usual:.1f} times chance); with {common} they are"
        return [Finding("colour and depth", "error", words, numbers, f"colour and depth: {common}")]
    words = f"edges of depth are no edges of colour ({usual:.1f} times chance)"
    advice = ": colour and depth are of different scenes or streams, or the objects look like the table"
    return [Finding("colour and depth", "warning", words + advice, numbers, "colour and depth of different scenes")]


def object_centre(view: View) -> FloatArray:
    """Mean ``(3,)`` of the raised points, metres; NaN where there are none."""
    points = view.points[view.raised & np.isfinite(view.depth)]
    return points.mean(axis=0) if len(points) else np.full(3, np.nan)


def scene_spread(views: Sequence[View]) -> float:
    """Root mean square distance of what is raised from its mean over the scenes, metres; NaN where unknown."""
    centres = np.array([object_centre(view) for view in views])
    centres = centres[np.isfinite(centres).all(axis=1)]
    if len(centres) < 2:
        return float("nan")
    return float(np.sqrt(((centres - centres.mean(axis=0)) ** 2).sum(axis=1).mean()))
