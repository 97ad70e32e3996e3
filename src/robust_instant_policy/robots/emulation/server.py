"""The process of an emulated cell: its devices, and an HTTP address for its camera, its faults and its task.

``GET /observation.npz``, ``/commands.npy`` (what the arms executed), ``/times.npy`` (when), ``/state`` (JSON);
``POST /fault/ARM/FAULT``, ``/scene/SEED``.
"""

import io
import json
import sys
import time
from collections.abc import Mapping
from functools import partial
from http.server import BaseHTTPRequestHandler

import numpy as np

from robust_instant_policy.errors import CellError, RipError
from robust_instant_policy.network import Answer, serve_loopback
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.emulation.controller import Controller
from robust_instant_policy.robots.emulation.servos import ServoBus
from robust_instant_policy.robots.emulation.twin import SharedTwin, Twin
from robust_instant_policy.robots.models import arm_of
from robust_instant_policy.robots.priority import DEVICE, take_real_time

Device = ServoBus | Controller  # ``options``: by which the driver finds it; ``limp``: whether it ever let go


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
    url = serve_loopback(partial(_answer, shared, devices))
    options = {name: dict(device.options) for name, device in devices.items()}
    print(json.dumps({"url": url, "devices": options}), flush=True)
    sys.stdin.buffer.read()  # ends with the process that started this one


def _answer(shared: SharedTwin, devices: Mapping[str, Device], request: BaseHTTPRequestHandler) -> Answer:
    serve = _look if request.command == "GET" else _change
    try:
        content = serve(shared, devices, request.path)
    except RipError as error:
        return 409, "text/plain", str(error).encode()
    return (404, "text/plain", b"not here") if content is None else (200, "application/octet-stream", content)


def _look(shared: SharedTwin, devices: Mapping[str, Device], path: str) -> bytes | None:
    if path == "/observation.npz":
        return shared.photograph().npz()
    if path in ("/commands.npy", "/times.npy"):
        buffer = io.BytesIO()
        np.save(buffer, shared.commands if path == "/commands.npy" else shared.times)
        return buffer.getvalue()
    if path == "/state":
        limp = [name for name, device in devices.items() if device.limp]
        return json.dumps({"failure": shared.failure(), "limp": limp}).encode()
    return None


def _change(shared: SharedTwin, devices: Mapping[str, Device], path: str) -> bytes | None:
    """Returns when the change began."""
    _, what, name, fault = (path.split("/") + [""] * 3)[:4]
    began = time.monotonic()
    if what == "scene" and name.isdecimal():
        shared.reset(int(name))
    elif what != "fault" or name not in devices:
        return None
    elif fault == "unplugged":
        devices[name].unplug()
    else:
        devices[name].fault.set(fault)
    return str(began).encode()
