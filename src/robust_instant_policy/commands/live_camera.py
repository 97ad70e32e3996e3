"""The camera of a cell in a process of its own, which also shows its live picture in the browser.

recording process ── read, start image, lines ──▶ camera process ──▶ browser, http://127.0.0.1:…
                  ◀──── frames, errors ─────────  camera, keypoints

Pictures and keypoints take no time of the process that commands the arms.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import re
import signal
import threading
import time
from collections.abc import Mapping
from http.server import BaseHTTPRequestHandler
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.datasets.images import encode_image
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import RipError, RobotError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.interrupts import blocked
from robust_instant_policy.network import Answer, is_loopback, serve_loopback
from robust_instant_policy.perception import KeypointExtractor
from robust_instant_policy.reporting.pages import render
from robust_instant_policy.reporting.pictures import Picture, keypoint_marks, picture
from robust_instant_policy.robots.camera import Frame, VideoCamera
from robust_instant_policy.robots.cameras import make_camera
from robust_instant_policy.robots.cell import DeviceConfig

LIVE_S = 0.2  # between two live pictures
MOST_SHARE = 0.2  # of the camera's time for them
JPEG_QUALITY = 80
NICE = 5  # the process that commands the arms goes first
STARTING_S, READING_S = 60.0, 40.0
ENDING_S = 0.7  # of a camera that hangs
SIGNALS = (signal.SIGINT, signal.SIGHUP)


class LiveCamera:
    """See `robots.camera.Camera`; ``url`` is the page's address once the camera is connected.

    ``folder`` is that of the cell's file; the page marks the keypoints of the dataset ``demos`` that lie in
    ``workspace (2, 3)``.
    """

    def __init__(self, config: DeviceConfig, folder: Path, demos: Path, workspace: FloatArray):
        self.name, self.url = config.kind, ""
        context = multiprocessing.get_context("spawn")
        self._wire, self._theirs = context.Pipe()
        self._outbox: SimpleQueue[tuple[str, object] | None] = SimpleQueue()  # `put` does not wait for the process
        self._sender = threading.Thread(target=self._send, daemon=True)
        device = (config.kind, dict(config.options), config.where)
        self._process = context.Process(
            target=_serve, args=(self._theirs, device, folder, demos, workspace), daemon=True, name="camera"
        )

    def connect(self) -> None:
        self._sender.start()
        # Only the recording process handles Ctrl-C; the new process inherits the blocked signals.
        with blocked(*SIGNALS):
            self._process.start()
        self._theirs.close()  # so that the end of the process ends the pipe
        self.name, self.url = self._answer(STARTING_S)

    def read(self) -> Frame:
        self._outbox.put(("read", None))
        frame: Frame = self._answer(READING_S)
        return frame

    def show(self, start: Observation) -> None:
        """Mark the keypoints of the demonstrations in the ``start`` image, once they are found."""
        self._outbox.put(("start", start))

    def say(self, line: str) -> None:
        """Show what the person was told last."""
        self._outbox.put(("line", line))

    def disconnect(self) -> None:
        if self._process.pid is not None:
            self._outbox.put(None)
            self._sender.join(ENDING_S)
            if self._sender.is_alive():
                self._process.kill()
                self._sender.join()
        self._wire.close()  # the process ends then
        if self._process.pid is not None:
            self._process.join(ENDING_S)
            self._process.kill()

    def _send(self) -> None:
        """Send what is in the outbox. A failure is told by `_answer`: what is only shown on the page must not stop an
        arm."""
        with contextlib.suppress(OSError):
            while (message := self._outbox.get()) is not None:
                self._wire.send(message)

    def _answer(self, seconds: float) -> Any:
        try:
            if not self._wire.poll(seconds):
                raise RobotError(f"camera {self.name} did not answer within {seconds:g} s; connect it again")
            answer = self._wire.recv()
        except (EOFError, OSError):
            raise RobotError(f"the process of camera {self.name} has ended; run the same command again") from None
        if isinstance(answer, str):
            raise RobotError(answer)
        return answer


def _serve(
    wire: Connection, device: tuple[str, Mapping[str, Any], str], folder: Path, demos: Path, workspace: FloatArray
) -> None:
    """Read the camera and show it until ``wire`` is closed; a text sent over it is an error's message."""
    for number in SIGNALS:  # the recording process stops the arms first
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    os.nice(NICE)
    page = _Page(demos, workspace)
    try:
        camera = make_camera(DeviceConfig(*device), folder)
        camera.connect()
    except RipError as error:
        wire.send(str(error))
        return
    wire.send((camera.name, serve_loopback(page.answer)))
    with contextlib.suppress(EOFError, OSError):
        _work(wire, camera, page)
    camera.disconnect()


def _work(wire: Connection, camera: VideoCamera, page: _Page) -> None:
    due = time.monotonic()
    while True:
        if wire.poll(max(due - time.monotonic(), 0.0)):
            what, value = wire.recv()
            if what == "read":
                try:
                    wire.send(camera.read())
                except RipError as error:
                    wire.send(str(error))
            elif what == "line":
                page.line = value
            else:
                page.newest = value
                page.show(picture(value.rgb, "start image"))
                threading.Thread(target=page.find_keypoints, args=(value,), daemon=True).start()
            continue
        began = time.monotonic()
        try:
            page.live = encode_image(camera.preview(), "jpeg", quality=JPEG_QUALITY)
            page.error = ""
        except Exception as error:  # any error of a camera's library; `read` may still work
            page.error = str(error)
        now = time.monotonic()
        due = now + max(LIVE_S, (now - began) / MOST_SHARE)


class _Page:
    """What the browser shows: replaced by the camera's thread, read by those of the server."""

    def __init__(self, demos: Path, workspace: FloatArray):
        self._demos, self._workspace = demos, workspace
        self.live, self.line, self.error = b"", "", ""
        self.start: Picture | None = None
        self.shown = 0  # pictures so far, by which the browser knows a new one
        self.newest: Observation | None = None

    def show(self, start: Picture) -> None:
        self.start = start
        self.shown += 1

    def find_keypoints(self, seen: Observation) -> None:
        """Mark the keypoints of the demonstrations so far in a start image, or say why there are none."""
        marked = self._with_keypoints(seen)
        if seen is self.newest:
            self.show(marked)

    def _with_keypoints(self, seen: Observation) -> Picture:
        if not self._demos.exists():
            return picture(seen.rgb, "start image; its keypoints are shown once there is a demonstration")
        try:
            recorded = load_demonstrations(self._demos)
            extractor = KeypointExtractor(workspace=self._workspace)
            extractor.fit([one.observation for one in recorded], [one.trajectory for one in recorded])
            located = extractor.locate(seen)
        except RipError as error:  # too few demonstrations so far, too little in common, or a missing package
            return picture(seen.rgb, f"start image; no keypoints yet: {error}")
        low, high = located.confidence.min(), located.confidence.max()
        words = f"start image with the keypoints of the demonstrations so far ({len(recorded)}), confidence"
        caption = "; ".join((f"{words} {low:.2f} to {high:.2f}", *located.notes))
        return picture(seen.rgb, caption, marks=keypoint_marks(located.pixels, located.confidence))

    def answer(self, request: BaseHTTPRequestHandler) -> Answer:
        path, start = request.path.partition("?")[0], self.start
        if not is_loopback(re.sub(r":\d+$", "", request.headers.get("Host", ""))):
            return 403, "text/plain", b"this address is for this machine only"  # a name that resolves to it
        if path == "/":
            return 200, "text/html", render("record.html", title="Recording").encode()
        if path == "/live.jpg":
            return 200 if self.live else 404, "image/jpeg", self.live
        if path == "/state":
            state = {"line": self.line, "error": self.error, "start": self.shown}
            return 200, "application/json", json.dumps(state).encode()
        if path == "/start":
            return 200, "text/html", b"" if start is None else render("start.html", start=start).encode()
        return 404, "text/plain", b"not here"
