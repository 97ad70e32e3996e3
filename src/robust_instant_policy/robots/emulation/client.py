"""Starts the process of an emulated cell, and reads its state."""

import io
import json
import select
import subprocess
import sys
import tempfile
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import RobotError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.robots.camera import Frame
from robust_instant_policy.robots.cell import CellConfig, DeviceConfig

TIMEOUT_S = 30.0  # of a request; a scene is rendered within seconds
STARTING_S = 300.0  # of the process; a simulator takes some ten


@dataclass(frozen=True)
class Emulation:
    """An emulated cell that runs at ``url`` in the process ``pid``; ``config`` is the cell with its devices' ports."""

    url: str
    pid: int
    config: CellConfig

    def observation(self) -> Observation:
        return _photograph(self.url)

    def commands(self) -> FloatArray:
        """Commands ``(N, A, J + 1)`` that the arms executed."""
        return np.load(io.BytesIO(request(f"{self.url}/commands.npy")), allow_pickle=False)

    def times(self) -> FloatArray:
        """Times of these commands ``(N,)``, seconds of `time.monotonic`."""
        return np.load(io.BytesIO(request(f"{self.url}/times.npy")), allow_pickle=False)

    def failure(self) -> str:
        """Reason why the task is not done, empty if it is."""
        return str(json.loads(request(f"{self.url}/state"))["failure"])

    def limp(self) -> list[str]:
        """Names of the arms whose torque was switched off."""
        return list(json.loads(request(f"{self.url}/state"))["limp"])

    def scene(self, seed: int) -> None:
        """Build the scene with a ``seed``; the arms are at home, as if parked."""
        request(f"{self.url}/scene/{seed}", b"")

    def fault(self, arm: str, fault: str) -> float:
        """Give an arm a fault of `faults.FAULTS`, or none with an empty name; returns when, on the clock of `times`."""
        return float(request(f"{self.url}/fault/{arm}/{fault}", b""))


@contextmanager
def devices_of(config: CellConfig) -> Iterator[tuple[CellConfig, Emulation | None]]:
    """The cell with the addresses of its devices: its own, or those of an emulation that runs while the context lasts.

    Every command that opens a cell's devices goes through here, so that all can be rehearsed.
    """
    if config.emulation is None:
        yield config, None
        return
    with emulated(config) as emulation:
        yield emulation.config, emulation


@contextmanager
def emulated(config: CellConfig) -> Iterator[Emulation]:
    """Run an emulated cell in a process of its own while the context lasts."""
    command = [sys.executable, "-m", "robust_instant_policy.cli", "robot", "emulate", "--robot", str(config.path)]
    with (
        tempfile.TemporaryFile() as errors,
        subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, start_new_session=True
        ) as process,
    ):
        assert process.stdin is not None
        assert process.stdout is not None
        if not select.select([process.stdout], [], [], STARTING_S)[0]:
            process.kill()
            raise RobotError(f"the emulated cell did not start within {STARTING_S:g} s; is this computer too busy?")
        line = process.stdout.readline()
        if not line:
            errors.seek(0)
            words = errors.read().decode(errors="replace").strip().splitlines()
            reason = words[-1].removeprefix("rip: ") if words else "it ended at once"
            raise RobotError(f"the emulated cell does not start: {reason}")
        started = json.loads(line)
        arms = tuple(
            replace(arm, driver=replace(arm.driver, options=MappingProxyType(started["devices"][arm.name])))
            for arm in config.arms
        )
        camera = DeviceConfig("emulated", MappingProxyType({"url": started["url"]}), f"{config.path}: camera")
        try:
            yield Emulation(started["url"], process.pid, replace(config, arms=arms, camera=camera))
        finally:
            process.stdin.close()  # it ends then
            try:
                process.wait(5.0)
            except subprocess.TimeoutExpired:
                process.kill()


class EmulatedCamera:
    """See `robots.camera.Camera`."""

    name = "emulated"

    def __init__(self, url: str):
        self._url, self._frames = url, 0

    def connect(self) -> None:
        request(f"{self._url}/state")

    def read(self) -> Frame:
        seen = _photograph(self._url)
        self._frames += 1
        return Frame(seen.rgb, seen.depth, seen.intrinsics, float(self._frames))

    def preview(self) -> NDArray[np.uint8]:
        return self.read().rgb

    def disconnect(self) -> None:
        """Nothing to close."""


def _photograph(url: str) -> Observation:
    return Observation.read(io.BytesIO(request(f"{url}/observation.npz")), url)


def request(url: str, data: bytes | None = None) -> bytes:
    """The content at ``url``; raises `RobotError` where the emulated cell does not answer."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, data=data), timeout=TIMEOUT_S) as answer:
            return bytes(answer.read())
    except urllib.error.HTTPError as error:
        raise RobotError(error.read().decode(errors="replace")) from None
    except (OSError, urllib.error.URLError) as error:
        raise RobotError(f"the emulated cell at {url} does not answer ({error}); start it again") from None
