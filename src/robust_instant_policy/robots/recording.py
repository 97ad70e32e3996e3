"""Demonstrations with a leader: soft start, coupled motion, and the episode that comes of it.

leaders ─read─▶ soft start ─▶ wanted ─▶ `Station.lead` (gate, followers) ─▶ measured states ─▶ journal, episode
"""

from collections.abc import Callable, Sequence

import numpy as np

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.motion.state import ArmState, Command
from robust_instant_policy.robots.journal import Episode, Journal
from robust_instant_policy.robots.leader import Leader
from robust_instant_policy.robots.operator import ENTER, Operator
from robust_instant_policy.robots.station import Station
from robust_instant_policy.trajectory import Trajectory

APPROACH_RAD_S = 0.5  # speed of a follower towards its leader before both are coupled
WAIT_S = 1.5  # without progress, until the person is told
PROGRESS_RAD = 1e-4  # in a step
COUPLED_RAD = 0.05  # difference of each joint, below which leader and follower are coupled
TRIGGER_CLOSES, TRIGGER_OPENS = 0.4, 0.6  # opening of the trigger; between them the gripper keeps its state
STILL_M = 0.003  # by which gripper points move at most while nothing is shown
STILL_KEPT_S = 0.1  # of rest that stays before the first and after the last motion
MIN_STEPS = 10  # of a demonstration

DISCARD, QUIT = "d", "q"
OnStep = Callable[[Sequence[Command], Sequence[float], Sequence[ArmState]], None]


class Following:
    """Commands for each step of `Station.lead`, from the leaders; an arm whose leader is None holds.

    ``key`` is the key that ended it, "" after a request to stop. Grippers open and close completely, as in the
    execution of a plan. While leaders and followers are coupled, ``on_step`` is called in each step with the last
    commands, the travel of each gripper (open or closed), and the states after them.
    """

    def __init__(
        self,
        station: Station,
        leaders: Sequence[Leader | None],
        operator: Operator,
        coupled: str,
        on_step: OnStep = lambda *_: None,
    ):
        self._station, self._leaders, self._operator, self._words = station, leaders, operator, coupled
        self._on_step = on_step
        self._travels: list[float] = []  # of each gripper, open or closed, from the first step on
        self._coupled, self._waited, self._gap = False, 0, np.inf
        self.key = ""
        for leader in leaders:
            if leader is not None:
                leader.start()

    def __call__(self, states: Sequence[ArmState]) -> list[Command] | None:
        self.key = self._operator.pressed(ENTER + DISCARD + QUIT)[:1]
        if self._operator.stop.reason:
            self.key = ""
            return None
        if self.key and (self._coupled or self.key != ENTER):
            return None
        last = self._station.gate.last
        if not self._travels:
            full = [arm.finger_travel for arm in self._station.arms]
            self._travels = [
                most if told.finger_travel > most / 2 else 0.0 for told, most in zip(last, full, strict=True)
            ]
        if self._coupled:
            self._on_step(last, self._travels, states)
        wanted = [
            told if leader is None else self._whole(arm, leader.read(state))
            for arm, (leader, state, told) in enumerate(zip(self._leaders, states, last, strict=True))
        ]
        return wanted if self._coupled else self._approach(last, wanted)

    def _whole(self, arm: int, told: Command) -> Command:
        """``told`` with the gripper open or closed."""
        full = self._station.arms[arm].finger_travel
        if told.finger_travel < TRIGGER_CLOSES * full:
            self._travels[arm] = 0.0
        elif told.finger_travel > TRIGGER_OPENS * full:
            self._travels[arm] = full
        return Command(told.joints, self._travels[arm])

    def _approach(self, last: Sequence[Command], wanted: Sequence[Command]) -> list[Command]:
        """A small step of each follower towards its leader, grippers as they are."""
        most = APPROACH_RAD_S / self._station.rate_hz
        gaps = [want.joints - told.joints for told, want in zip(last, wanted, strict=True)]
        gap = max(float(np.abs(one).max()) for one in gaps)
        if gap < COUPLED_RAD:
            self._coupled = True
            self._operator.say(self._words)
        self._waited = self._waited + 1 if gap > self._gap - PROGRESS_RAD else 0
        self._gap = gap
        if self._waited == round(WAIT_S * self._station.rate_hz):
            self._operator.say("the follower cannot come nearer within its limits: move the leader towards its pose")
        pairs = zip(last, gaps, strict=True)
        return [Command(told.joints + np.clip(gap, -most, most), told.finger_travel) for told, gap in pairs]


def teach(
    station: Station, leaders: Sequence[Leader], start: Observation, journal: Journal, operator: Operator
) -> tuple[Episode, str]:
    """Let the followers follow the leaders until the person ends it; returns the episode and the key that ended it.

    Raises `RobotError` where a device fails; the journal then holds the episode.
    """
    digest, shape = station.config.digest, (len(station.arms), 2, len(station.arms[0].home) + 1)
    steps: list[FloatArray] = []
    seconds: list[float] = []
    in_memory = False

    def keep(last: Sequence[Command], travels: Sequence[float], states: Sequence[ArmState]) -> None:
        nonlocal in_memory
        triples = zip(last, travels, states, strict=True)
        steps.append(np.array([[[*a.joints, travel], [*b.joints, b.finger_travel]] for a, travel, b in triples]))
        seconds.append(station.sent_at)
        if not in_memory:
            try:
                journal.add(seconds[-1], steps[-1])
            except OSError as error:  # the arms move: the disk can wait
                in_memory = True
                operator.say(f"the journal cannot be written ({error.strerror}); recording goes on in memory")

    journal.begin(start, digest, shape)
    words = "coupled, recording: Enter ends the demonstration, d discards it"
    following = Following(station, leaders, operator, words, keep)
    try:
        station.lead(following)
    finally:
        journal.end()
    return Episode(start, np.array(steps).reshape(-1, *shape), np.array(seconds), digest), following.key


def guide(station: Station, leaders: Sequence[Leader | None], operator: Operator, words: str) -> str:
    """Let the followers follow the leaders until the person presses a key, which is returned; then they hold."""
    following = Following(station, leaders, operator, words)
    station.lead(following)
    return following.key


def jitter_95_ms(seconds: FloatArray, rate_hz: float) -> float:
    """95th percentile, milliseconds, of the deviation of steps at ``seconds (T,)`` from the period of the rate."""
    return 1e3 * float(np.percentile(np.abs(np.diff(seconds) - 1 / rate_hz), 95))


def demonstration_of(
    episode: Episode, arms: Sequence[Arm], rate_hz: float, task: str, cell: str, seed: int | None = None
) -> Demonstration:
    """The demonstration: measured tool poses, commanded gripper states, without the rest at both ends.

    Raises `DatasetError` where nothing moved.
    """
    measured, travels = episode.steps[:, :, 1, :-1], episode.steps[:, :, 0, -1]
    poses = np.array([[arm.kinematics.tool_pose(row[i]) for i, arm in enumerate(arms)] for row in measured])
    closed = travels < np.array([arm.finger_travel for arm in arms]) / 2
    kept = _moving(poses, closed, rate_hz) if len(poses) else slice(0, 0)
    if kept.stop - kept.start < MIN_STEPS:
        raise DatasetError("nothing was shown: the arms did not move; record it again")
    single = [
        Trajectory.from_poses(poses[kept, i], closed[kept, i], arm.triangle).actions for i, arm in enumerate(arms)
    ]
    trajectory = Trajectory.from_actions(np.concatenate(single, axis=1))
    facts: dict[str, str | float | int] = {
        "cell": cell,
        "calibration": episode.calibration,
        "jitter_95_ms": round(jitter_95_ms(episode.seconds, rate_hz), 2),
    }
    return Demonstration(episode.start, trajectory, rate_hz, task, seed, facts)


def _moving(poses: FloatArray, closed: np.ndarray, rate_hz: float) -> slice:
    """The steps from the first motion to the last, with a short rest around."""

    def away(index: int) -> np.ndarray:
        gap = np.linalg.norm(poses[..., :3, 3] - poses[index, ..., :3, 3], axis=-1).max(axis=1)
        return np.flatnonzero((gap > STILL_M) | (closed != closed[index]).any(axis=1))

    left, arriving = away(0), away(-1)
    if not len(left):
        return slice(0, 0)
    rest = round(STILL_KEPT_S * rate_hz)
    return slice(max(int(left[0]) - rest, 0), min(int(arriving[-1]) + 1 + rest, len(poses)))
