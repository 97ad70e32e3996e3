"""A session of recording: one demonstration after another into a dataset folder.

park ─▶ start image ─▶ soft start ─▶ demonstration ─▶ kept or discarded ─▶ park …
"""

import os
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from robust_instant_policy.datasets import DatasetWriter, load_demonstrations
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import DatasetError, StoppedError, UnreachableError
from robust_instant_policy.files import read_regular, write_whole
from robust_instant_policy.robots.camera import Camera
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.execution import has_open_grippers, is_parked, observe, open_grippers, park
from robust_instant_policy.robots.journal import Episode, Journal
from robust_instant_policy.robots.leader import Leader
from robust_instant_policy.robots.operator import ENTER, Operator
from robust_instant_policy.robots.recording import DISCARD, QUIT, demonstration_of, guide, teach
from robust_instant_policy.robots.station import Station
from robust_instant_policy.sanity import check_demonstrations

COUPLES = "hold the leader near its follower's pose; Enter couples both, q ends"
LATE_S = 5e-3  # deviation of a step that 95% of the steps must keep within


@dataclass(frozen=True, eq=False)
class Session:
    """Records demonstrations of a task; all devices are connected.

    ``writer`` is of the folder; ``show(observation)`` shows a start image and the keypoints found in it;
    ``next_scene()`` prepares an emulated scene and returns its seed, None where a person arranges it.
    """

    station: Station
    leaders: Sequence[Leader]
    camera: Camera
    writer: DatasetWriter
    operator: Operator
    show: Callable[[Observation], object]
    next_scene: Callable[[], int] | None = None

    def record(self, count: int) -> None:
        """Record until the folder holds ``count`` demonstrations, or the person ends it.

        Raises `RobotError` or `StoppedError` where an arm or a device stops; the episode under way is kept.
        """
        keep_calibration(self.station.config, self.writer.path)
        journal = Journal(self.writer.path)
        self._take_up(journal)
        while self.writer.num_episodes < count:
            self._park()
            self._open_grippers()
            with self.operator.stop.ends_waiting():
                seed = None if self.next_scene is None else self.next_scene()
            start = self._start(f"demonstration {self.writer.num_episodes + 1} of {count}")
            if start is None:
                return
            episode, key = teach(self.station, self.leaders, start, journal, self.operator)
            if not key:
                raise StoppedError(
                    f"{self.operator.stop.reason}; the arms hold; the episode of {len(episode.steps)} steps is kept"
                )
            if key == ENTER:
                self._store(episode, journal, seed)
            else:
                self._discard(journal, seed)
            if key == QUIT:
                return

    def _start(self, words: str) -> Observation | None:
        """The start image, once the person is ready to lead; None to end."""
        arrange = f"{words}: arrange the scene, hands out of the image; Enter photographs it, q ends"
        if self._ask(arrange, ENTER + QUIT) == QUIT:
            return None
        with self.operator.stop.ends_waiting():
            start = observe(self.station.config, self.camera)
        self.show(start)
        return start if self._ask(COUPLES, ENTER + QUIT) == ENTER else None

    def _ask(self, line: str, keys: str) -> str:
        """The key that the person pressed; raises `StoppedError` once a stop was requested."""
        key = self.operator.ask(line, keys)
        if not key:
            raise self.operator.stop.error()
        return key

    def _store(self, episode: Episode, journal: Journal, seed: int | None) -> None:
        """Add the episode if the person wants it, and say at once what `rip check` finds."""
        operator, station, config = self.operator, self.station, self.station.config
        paced = replace(episode, seconds=episode.seconds * config.pace)
        try:
            demonstration = demonstration_of(paced, station.arms, config.rate_hz, self.writer.task, config.name, seed)
        except DatasetError as error:
            operator.say(f"  {error}")
            self._discard(journal, seed)
            return
        late = float(demonstration.info["jitter_95_ms"])
        timing = "" if late <= 1e3 * LATE_S else ": this computer is too busy, close other programs"
        operator.say(f"  {demonstration.seconds:.1f} s; 95% of the steps within {late:.2f} ms of their time{timing}")
        key = operator.ask("Enter keeps it, d discards it", ENTER + DISCARD)
        while key == ENTER:
            try:
                self.writer.add(demonstration)
                journal.discard()
                break
            except DatasetError as error:
                operator.say(f"  {error}")
                key = operator.ask("Enter tries again, d discards it", ENTER + DISCARD)
        if not key:
            raise StoppedError(f"{operator.stop.reason}; the arms hold; the episode is kept")
        if key == DISCARD:
            self._discard(journal, seed)
            return
        operator.say(f"  kept: {self.writer.num_episodes} in {self.writer.path}")
        findings = check_demonstrations(load_demonstrations(self.writer.path)).findings
        for finding in findings:
            operator.say(f"    {finding}")
        if not findings:
            operator.say(f"    checked against the other demonstrations of {config.name}: no problem found")

    def _discard(self, journal: Journal, seed: int | None) -> None:
        journal.discard()
        self.writer.discard(seed)
        self.operator.say(f"  discarded; {self.writer.num_episodes} are kept")

    def _take_up(self, journal: Journal) -> None:
        """Offer the episode that a process left behind."""
        episode = journal.read()
        if episode is None:
            return
        self.operator.say(f"an interrupted episode of {len(episode.steps)} steps was found")
        if episode.calibration != self.station.config.digest:
            self.operator.say("  it is of another calibration and is discarded")
            self._discard(journal, None)
            return
        self._store(episode, journal, None)

    def _open_grippers(self) -> None:
        """A demonstration begins with open grippers; the person takes what is still held."""
        if has_open_grippers(self.station):
            return
        self._ask("a gripper is closed: hold what it has; Enter opens it", ENTER)
        open_grippers(self.station, self.operator.stop)

    def _park(self) -> None:
        """Move the arms to their park poses; where the way is refused, the person leads them nearer."""
        operator, station = self.operator, self.station
        while not is_parked(station):
            try:
                played = park(station, operator.stop, station.config.first_run_speed)
            except UnreachableError as refused:
                operator.say(f"  {refused}")
                if self._ask(COUPLES, ENTER + QUIT) == QUIT:
                    raise StoppedError("the arms are not parked; they hold their position") from None
                guide(station, self.leaders, operator, "coupled: lead the arm towards its park pose; Enter lets go")
                continue
            played.require_end()


def keep_calibration(config: CellConfig, folder: Path) -> None:
    """Copy the cell's file and its calibration files into the dataset, one folder a calibration."""
    kept, home = folder / "meta" / f"cell-{config.digest}", config.path.parent
    tables = tomllib.loads(read_regular(config.path).decode())
    names = [tables.get("camera", {}).get("calibration")]
    for arm in tables["arms"]:
        names += [arm.get("gripper"), arm.get("leader", {}).get("calibration")]
    for name in filter(None, names):
        inside = (home / name).resolve().is_relative_to(home.resolve())  # two arms' files may have one name
        write_whole(
            kept / (os.path.relpath(home / name, home) if inside else Path(name).name), read_regular(home / name)
        )
    write_whole(kept / config.path.name, read_regular(config.path))
