"""The process of an emulated cell: its devices, and an HTTP address for its camera, its faults and its task.

``GET /observation.npz``, ``/commands.npy`` (what the arms executed), ``/times.npy`` (when), ``/state`` (JSON);
``POST /fault/ARM/FAULT``, ``/scene/SEED``.
"""

from __future__ import annotations

import io
import json
import sys
import threading
import time
from collections.abc import Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Protocol

import numpy as np

from robust_instant_policy.errors import CellError, RipError
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.emulation.controller import Controller
from robust_instant_policy.robots.emulation.faults import FaultSwitch
from robust_instant_policy.robots.emulation.servos import ServoBus
from robust_instant_policy.robots.emulation.twin import SharedTwin, Twin
from robust_instant_policy.robots.models import arm_of
from robust_instant_policy.robots.priority import DEVICE, take_real_time


class Device(Protocol):
    """An emulated arm. ``options`` are those by which its driver finds it; ``limp`` whether it ever let go."""

    fault: FaultSwitch
    limp: bool

    @property
    def options(self) -> Mapping[str, str | float]: ...
    def unplug(self) -> None: ...


def make_device(kind: str, twin: SharedTwin, index: int, finger_travel: float, pace: float) -> Device:
    if kind == "viperx":
        return ServoBus(twin, index, finger_travel)
    if kind == "ur5e":
        return Controller(twin, index, finger_travel, pace)
    raise CellError(f"an arm with the driver {kind!r} cannot be emulated")


def serve(config: CellConfig, twin: Twin) -> None:
    """Emulate the cell until standard input ends; the first line of standard output says where its devices are."""
    take_real_time(DEVICE)
    shared = SharedTwin(twin)
    devices = {
        one.name: make_device(
            one.driver.kind, shared, index, arm_of(one, config.path.parent).finger_travel, config.pace
        )
        for index, one in enumerate(config.arms)
    }
    server = ThreadingHTTPServer(("127.0.0.1", 0), _handler(shared, devices))
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    print(
        json.dumps(
            {
                "url": f"http://127.0.0.1:{server.server_address[1]}",
                "devices": {name: dict(device.options) for name, device in devices.items()},
            }
        ),
        flush=True,
    )
    sys.stdin.buffer.read()  # ends with the process that started this one


def _handler(shared: SharedTwin, devices: Mapping[str, Device]) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            try:
                if self.path == "/observation.npz":
                    self._send(200, shared.photograph().npz())
                elif self.path in ("/commands.npy", "/times.npy"):
                    buffer = io.BytesIO()
                    np.save(buffer, shared.commands if self.path == "/commands.npy" else shared.times)
                    self._send(200, buffer.getvalue())
                elif self.path == "/state":
                    limp = [name for name, device in devices.items() if device.limp]
                    self._send(200, json.dumps({"failure": shared.failure(), "limp": limp}).encode())
                else:
                    self._send(404, b"not here")
            except RipError as error:
                self._send(409, str(error).encode())

        def do_POST(self) -> None:
            _, what, name, fault = (self.path.split("/") + [""] * 3)[:4]
            if (what != "fault" or name not in devices) and (what != "scene" or not name.isdecimal()):
                self._send(404, b"not here")
                return
            began = time.monotonic()
            try:
                if what == "scene":
                    shared.reset(int(name))
                elif fault == "unplugged":
                    devices[name].unplug()
                else:
                    devices[name].fault.set(fault)
                self._send(200, str(began).encode())
            except RipError as error:
                self._send(409, str(error).encode())

        def _send(self, status: int, content: bytes) -> None:
            self.send_response(status)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *arguments: object) -> None:
            """Standard error stays free for errors."""

    return Handler
