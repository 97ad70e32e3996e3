"""Were gripper states, tool frames, rotations and times recorded rightly? The images contain the proof."""

from collections.abc import Sequence

import numpy as np

from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.sanity.consistency import MIN_DEMONSTRATIONS
from robust_instant_policy.sanity.contact import closings, gaps
from robust_instant_policy.sanity.envelope import approaches
from robust_instant_policy.sanity.finding import Finding
from robust_instant_policy.sanity.geometry import MIN_SHARE, TOUCH_M, Evidence, touch_distance
from robust_instant_policy.sanity.hypotheses import rotations_read_otherwise
from robust_instant_policy.sanity.view import View

LOWEST_GRIPPER_POINT_M = 0.02  # above the table
SAME_PLACE_M = 0.02  # largest distance between positions that are called one place
ALONG_FINGERS = np.linspace(-0.5, 1.5, 41)  # points of the line through the fingertips, these at 0 and 1
REACHED_M = 0.05  # the last part of the way to a grasp
SIDEWAYS_RAD = np.deg2rad(70.0)  # to the approach axis, in which no grasp of the simulated tasks is reached
STRAIGHT_RAD, CROOKED_RAD = np.deg2rad([3.5, 10.0])  # spread of the approach with quaternions in order, or not
MOSTLY = 0.8  # share of the demonstrations


def check_tool_frame(demonstrations: Sequence[Demonstration], views: Sequence[View], as_is: Evidence) -> list[Finding]:
    """A gripper point that touches the table, or grippers that reach what they grasp sideways, belong to a tool frame
    whose axes or offset are wrong."""
    numbers, words = {}, []
    if (lowest := _lowest_gripper_point(as_is)) <= LOWEST_GRIPPER_POINT_M:
        numbers["lowest_gripper_point"] = lowest
        words.append(f"the gripper point comes within {lowest * 1e3:.0f} mm of the table")
    sideways = [angle for d, view in zip(demonstrations, views, strict=True) for angle in _reaching_angles(d, view)]
    if len(sideways) >= MIN_SHARE * len(views) and (angle := float(np.median(sideways))) > SIDEWAYS_RAD:
        numbers["sideways"] = angle
        words.append(f"grippers reach what they grasp at {np.rad2deg(angle):.0f} degrees to their approach axis")
    if not words:
        return []
    advice = ": the gripper lies on its side; check the tool frame (z out of the gripper) and how rotations are written"
    return [Finding("rotation", "warning", " and ".join(words) + advice, numbers, "tool frame")]


def _reaching_angles(demonstration: Demonstration, view: View) -> list[float]:
    """Angle, rad, between the last `REACHED_M` of the way to each grasp and the gripper's approach axis there."""
    trajectory = demonstration.trajectory
    middles, forward = trajectory.triplets[:, :, 1:].mean(axis=2), approaches(trajectory)
    found = []
    for step, arm in closings(trajectory):
        way = middles[step, arm] - middles[:step, arm]
        before = np.flatnonzero(np.linalg.norm(way, axis=1) > REACHED_M)
        if len(before) and _gap(view, middles[step, arm]) < touch_distance(view):
            last = way[before[-1]]
            found.append(float(np.arccos(np.clip(last @ forward[step, arm] / np.linalg.norm(last), -1, 1))))
    return found


def _gap(view: View, point: FloatArray) -> float:
    """From ``point (3,)`` to the table or to what stands on it, metres."""
    return min(float(gaps(view, point[None])[0]), float(view.above_plane(point)))


def _lowest_gripper_point(as_is: Evidence) -> float:
    """Median over the demonstrations, metres above the table."""
    return float(np.median([c.lowest_gripper_point for c in as_is.contacts]))


def check_openings(demonstrations: Sequence[Demonstration], views: Sequence[View]) -> list[Finding]:
    """Grippers that begin closed, and open at something to grasp or for nothing, may have inverted states."""
    inverted = 0
    for demonstration, view in zip(demonstrations, views, strict=True):
        closed = demonstration.trajectory.gripper_state[:, 0] > 0.5
        if not closed[0] or closed.all():
            continue
        first = int((~closed).argmax())
        middle = demonstration.trajectory.triplets[first, 0, 1:].mean(axis=0)
        inverted += bool(_gap(view, middle) < touch_distance(view) or not closed[first:].any())
    if inverted < MOSTLY * len(views):
        return []
    words = f"in {inverted} of {len(views)} demonstrations the gripper begins closed and opens at a surface"
    advice = ", or for nothing: are its states inverted? 0 is open, 1 is closed"
    return [Finding("gripper state", "warning", words + advice, {"inverted": float(inverted)}, "states inverted")]


def check_fingers(demonstrations: Sequence[Demonstration], views: Sequence[View]) -> list[Finding]:
    """Where grippers close, their open fingertips are beside the object, not in it."""
    inside, above, offsets = 0, [], []
    for demonstration, view in zip(demonstrations, views, strict=True):
        for step, arm in closings(demonstration.trajectory):
            left, right = demonstration.trajectory.triplets[step, arm, 1:]
            line = left + ALONG_FINGERS[:, None] * (right - left)
            covered = view.covered(line)
            if covered.any():
                inside += bool(view.covered(np.stack([left, right])).any())
                offsets.append(abs(ALONG_FINGERS[covered].mean() - 0.5) * float(np.linalg.norm(right - left)))
            else:
                above.append(float(gaps(view, ((left + right) / 2)[None])[0]))
    missed = [gap for gap in above if 0 < gap < TOUCH_M]
    if missed and len(missed) >= MOSTLY * (len(offsets) + len(above)):
        words = f"grippers close {np.median(missed) * 1e3:.0f} mm above or beside a surface, and on nothing"
        advice = "; check the camera's height, the tool's offset and the depth"
        return [Finding("grasp", "warning", words + advice, {"gap": float(np.median(missed))}, "paths displaced")]
    if not offsets or inside < MOSTLY * len(offsets):
        return []
    off = float(np.median(offsets))
    words = (
        f"in {inside} of {len(offsets)} grasps a fingertip closes inside what the image shows, whose middle lies "
        f"{off * 1e3:.0f} mm beside the gripper's: paths and images are displaced by about that"
    )
    advice = "; check the camera's pose, the tool's offset, and the principal point if the image was cropped"
    return [Finding("grasp", "warning", words + advice, {"offset": off}, "paths displaced")]


def check_direction(demonstrations: Sequence[Demonstration], views: Sequence[View]) -> list[Finding]:
    """Paths that begin apart and end at one place, beginning in a picture that does not show the gripper, run
    backwards."""
    starts, ends = (np.array([d.trajectory.triplets[step].reshape(-1) for d in demonstrations]) for step in (0, -1))
    if len(starts) < MIN_DEMONSTRATIONS or not np.ptp(ends, axis=0).max() < SAME_PLACE_M < np.ptp(starts, axis=0).max():
        return []
    unseen = 0
    for demonstration, view in zip(demonstrations, views, strict=True):
        behind, _ = view.behind_surface(demonstration.trajectory.triplets[0].reshape(-1, 3))
        unseen += bool((behind < -SAME_PLACE_M).any())
    if unseen < MOSTLY * len(views):
        return []
    words = (
        f"all paths end at one place and begin at others, {unseen} of {len(views)} of them in view of the camera, "
        "whose images show no gripper there: they run backwards in time"
    )
    return [Finding("time", "error", words, {"unseen": float(unseen)}, "reversed in time")]


def check_rotations(demonstrations: Sequence[Demonstration], as_is: Evidence) -> list[Finding]:
    """Grippers that lean to all sides or lie on the table, and all approach in one direction with their rotations read
    in another way."""
    directions = [approaches(d.trajectory).reshape(-1, 3) for d in demonstrations]
    now = _spread(np.concatenate(directions))
    lying = _lowest_gripper_point(as_is) < LOWEST_GRIPPER_POINT_M
    if now < CROOKED_RAD and not lying:
        return []
    # one order for all arms: the triangle is the same
    triplets = np.concatenate([d.trajectory.triplets.reshape(-1, 3, 3) for d in demonstrations])
    for words, other in rotations_read_otherwise(triplets):
        forward = other[:, 1:].mean(axis=1) - other[:, 0]
        forward /= np.linalg.norm(forward, axis=1, keepdims=True)
        if (then := _spread(forward)) < STRAIGHT_RAD and (now >= CROOKED_RAD or words.startswith("Euler")):
            message = (
                f"grippers lean by {np.rad2deg(now):.0f} degrees from their mean approach; with {words} all approach "
                f"within {np.rad2deg(then):.1f} degrees: check how the rotation's numbers are written"
            )
            return [Finding("rotation", "error", message, {"spread": now, "spread_otherwise": then}, words)]
    return []


def _spread(directions: FloatArray) -> float:
    """90th percentile of the angle to the mean direction, rad."""
    mean = directions.mean(axis=0)
    mean /= max(float(np.linalg.norm(mean)), 1e-9)
    return float(np.percentile(np.arccos(np.clip(directions @ mean, -1, 1)), 90))
