"""Demonstrations as a set, without their images: states, lengths, units, copies, and who differs."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.sanity.envelope import gripper_changes, step_turns, triangle_sides
from robust_instant_policy.sanity.finding import Finding, Severity

STATE_TOLERANCE = 1e-3  # of a gripper state around 0 and 1
MIN_STEPS = 2
LONGER_ERROR, LONGER_WARNING = 20.0, 4.0  # times the median number of steps
SHORTER_WARNING = 0.25
LARGEST_GRIPPER_M = 0.6  # sides of a gripper's triangle beyond this are not in metres
SMALLEST_GRIPPER_M = 0.004
FARTHEST_REACH_M = 10.0  # from the world's origin
UNITS = (("millimetres", 1000.0), ("centimetres", 100.0), ("inches", 39.37))
SHAPE_CHANGE = 0.1  # relative difference of the gripper's triangle between demonstrations
FASTEST_TURN_RAD_S = 2 * np.pi  # of the gripper, in most demonstrations
FASTEST_M_S = 5.0  # of the gripper, from one step to the next
LONGEST_S = 900.0  # of most demonstrations
MIN_MOTION_M = 0.005  # over a demonstration
COMMON = 0.7  # share of the demonstrations that makes a rule


def check_episodes(demonstrations: Sequence[Demonstration]) -> list[Finding]:
    """What is wrong with the trajectories, each by itself and beside the others."""
    found = _lengths(demonstrations)
    arms = {demonstration.trajectory.num_arms for demonstration in demonstrations}
    if len(arms) > 1:
        return [
            *found,
            _error("arms", f"demonstrations move {' or '.join(map(str, sorted(arms)))} arms; keep one kind"),
        ]
    tasks = Counter(demonstration.task for demonstration in demonstrations)
    if len(tasks) > 1:
        named = ", ".join(f"{count} of {task or 'no task'!r}" for task, count in tasks.most_common(4))
        found.append(_error("tasks", f"demonstrations of several tasks are mixed: {named}; fit one task at a time"))
    if max(arms) > 1:
        words = "which arm is which was not checked: paths with exchanged arms look alike"
        found.append(Finding("arms", "unchecked", words))
    found += _states(demonstrations) + _copies(demonstrations) + _turns(demonstrations)
    found += _units(demonstrations) or _speeds(demonstrations)
    return found + _grasps(demonstrations) + _order_of_changes(demonstrations)


def _lengths(demonstrations: Sequence[Demonstration]) -> list[Finding]:
    steps = np.array([len(demonstration.trajectory) for demonstration in demonstrations])
    usual = float(np.median(steps))
    found = []
    if len(short := np.flatnonzero(steps < MIN_STEPS)):
        words = f"{_these(short)} holds {steps[short[0]]} step only; a path needs at least {MIN_STEPS}"
        found.append(_error("length", words, steps=int(steps[short[0]])))
    if len(long := np.flatnonzero(steps > LONGER_WARNING * usual)):
        worst = int(steps[long].max())
        words = f"{_these(long)} is {worst / usual:.0f} times as long as the others ({worst} steps against {usual:.0f})"
        severity: Severity = "error" if worst > LONGER_ERROR * usual else "warning"
        numbers = {"steps": worst, "median_steps": usual}
        found.append(Finding("length", severity, f"{words}; remove it, or record all at one rate", numbers))
    brief = np.flatnonzero((steps < SHORTER_WARNING * usual) & (steps >= MIN_STEPS))
    if len(brief):
        words = f"{_these(brief)} has {steps[brief[0]]} steps, the others {usual:.0f}: too short, was it cut off?"
        found.append(Finding("length", "warning", words, {"steps": int(steps[brief[0]]), "median_steps": usual}))
    for index, demonstration in enumerate(demonstrations):
        extent = np.ptp(demonstration.trajectory.triplets, axis=0).max()
        if len(demonstration.trajectory) >= MIN_STEPS and extent < MIN_MOTION_M:
            words = f"the gripper of demonstration {index} stays within {extent * 1e3:.1f} mm: nothing is shown"
            found.append(_error("motion", words, extent=float(extent)))
    return found


def _states(demonstrations: Sequence[Demonstration]) -> list[Finding]:
    found: list[tuple[int, float]] = []
    for index, demonstration in enumerate(demonstrations):
        states = demonstration.trajectory.gripper_state
        off = np.minimum(np.abs(states), np.abs(states - 1)) > STATE_TOLERANCE
        if off.any():
            found.append((index, float(states[off][np.abs(states[off] - 0.5).argmax()])))
    if not found:
        return []
    words = f"gripper states must be 0 or 1 (open, closed), {_these([i for i, _ in found])} holds {found[0][1]:g}; "
    advice = "record what is commanded, or threshold the measured opening (closed below half of it)"
    return [_error("gripper state", words + advice, state=found[0][1])]


def _grasps(demonstrations: Sequence[Demonstration]) -> list[Finding]:
    if any(np.ptp(demonstration.trajectory.gripper_state, axis=0).any() for demonstration in demonstrations):
        return []
    words = "no gripper opens or closes in any demonstration: neither grasps nor inverted states were checked"
    return [Finding("gripper state", "warning", f"{words}; if the task needs a grasp, its state was not recorded")]


def _units(demonstrations: Sequence[Demonstration]) -> list[Finding]:
    sides = np.array([np.median(triangle_sides(d.trajectory.triplets), axis=0) for d in demonstrations])  # (I, A, 3)
    side = float(np.median(sides.max(axis=-1)))
    farthest = float(max(np.abs(d.trajectory.triplets).max() for d in demonstrations))
    found = []
    if side > LARGEST_GRIPPER_M or side < SMALLEST_GRIPPER_M or farthest > FARTHEST_REACH_M:
        fit = [name for name, factor in UNITS if 0.02 <= side / factor <= 0.4 and farthest / factor < FARTHEST_REACH_M]
        cause = fit[0] if side > LARGEST_GRIPPER_M and fit else ""
        words = f"the gripper's triangle measures {side:.3g} m and its path reaches {farthest:.3g} m from the origin"
        advice = f"; are the actions in {cause}? They must be in metres" if cause else "; actions must be in metres"
        found.append(Finding("unit", "error", words + advice, {"side": side, "farthest": farthest}, cause))
    elif len(demonstrations) > 1:
        usual = np.median(sides, axis=0)
        off = np.flatnonzero((np.abs(sides - usual) > SHAPE_CHANGE * usual + 0.003).any(axis=(1, 2)))
        if len(off):
            words = f"the gripper of {_these(off)} has another shape than the others'; was another tool recorded?"
            found.append(Finding("gripper shape", "warning", words, {"demonstration": float(off[0])}))
    return found


def _turns(demonstrations: Sequence[Demonstration]) -> list[Finding]:
    fastest = [float(step_turns(d.trajectory).max(initial=0.0)) * d.rate_hz for d in demonstrations]
    usual = float(np.median(fastest))
    if usual < FASTEST_TURN_RAD_S:
        return []
    words = (
        f"grippers turn by up to {np.rad2deg(usual):.0f} degrees a second, which no arm does: rotations are read "
        "wrongly, such as Euler angles in degrees taken for radians"
    )
    return [Finding("rotation", "error", words, {"turn_rad_s": usual}, "degrees read as radians")]


def _speeds(demonstrations: Sequence[Demonstration]) -> list[Finding]:
    found, fast = [], {}
    for index, demonstration in enumerate(demonstrations):
        positions = demonstration.trajectory.triplets[:, :, 0]
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=-1).max(axis=1, initial=0.0)
        if steps.max(initial=0.0) * demonstration.rate_hz > FASTEST_M_S:
            fast[index] = steps
    if fast:
        index, steps = next(iter(fast.items()))
        others = f" (and of {len(fast) - 1} others)" if len(fast) > 1 else ""
        longest, step = float(steps.max()), int(steps.argmax())
        words = f"the gripper of demonstration {index}{others} moves by {longest:.2g} m from step {step} to the next"
        advice = "faster than any arm: its tracking was lost, or the rate is wrong; record it again"
        speed = longest * demonstrations[index].rate_hz
        found.append(_error("speed", f"{words}, {advice}", speed=speed))
    lasting = float(np.median([len(one.trajectory) / one.rate_hz for one in demonstrations]))
    if lasting > LONGEST_S:
        words = (
            f"demonstrations last {lasting / 60:.0f} minutes at {demonstrations[0].rate_hz:g} Hz: is the rate right?"
        )
        found.append(Finding("rate", "warning", words, {"seconds": lasting}))
    return found


def _copies(demonstrations: Sequence[Demonstration]) -> list[Finding]:
    first: dict[bytes, int] = {}
    copies = []
    for index, demonstration in enumerate(demonstrations):
        key = demonstration.trajectory.actions.tobytes() + demonstration.observation.rgb.tobytes()
        if key in first:
            copies.append(index)
        first.setdefault(key, index)
    if not copies:
        return []
    words = f"{_these(copies)} is the same recording as an earlier one: duplicates teach nothing and count twice"
    return [Finding("duplicates", "warning", words, {"duplicates": float(len(copies))})]


def _order_of_changes(demonstrations: Sequence[Demonstration]) -> list[Finding]:
    orders = [gripper_changes(demonstration.trajectory) for demonstration in demonstrations]
    usual, count = Counter(orders).most_common(1)[0]
    others = [index for index, order in enumerate(orders) if order != usual]
    if not others or count < COMMON * len(orders) or len(orders) < 4:
        return []
    words = (
        f"{_these(others)} opens and closes the gripper in another order than the other {count}: it contradicts them"
    )
    return [Finding("gripper changes", "warning", words, {"demonstration": float(others[0])})]


def _these(indices: Sequence[int] | np.ndarray) -> str:
    numbers = [str(int(index)) for index in indices]
    if len(numbers) == 1:
        return f"demonstration {numbers[0]}"
    return f"each of demonstrations {', '.join(numbers[:6])}{' …' if len(numbers) > 6 else ''}"


def _error(kind: str, message: str, **numbers: float) -> Finding:
    return Finding(kind, "error", message, numbers)
