"""What the page of `rip studio` costs: start, latency from a key to motion in the picture, memory, changes of task.

The latency is measured in headless Chromium, which draws by software: from the key event to the time stamp of the first
picture of the page in which the arm has moved. Writes `docs/tables/studio.md`.

    python benchmarks/studio.py --minutes 30
"""

from __future__ import annotations

import argparse
import base64
import io
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from PIL import Image
from playwright.sync_api import Page, sync_playwright

from robust_instant_policy.tasks import TASK_NAMES

ROOT = Path(__file__).parents[1]
TABLE = ROOT / "docs" / "tables" / "studio.md"
SOFTWARE = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
PRESSES = 30
REST_MS = 2000  # between presses, for the arm to come to rest in the picture
CHANGED, CHANGED_PIXELS = 40, 30  # difference of a colour, and number of pixels, from which the arm has moved
PATIENCE_MS = 300_000
TASKS_IN_TURN = 10
FIRST_TASK = "push-cube"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--minutes", type=float, default=30.0, help="of use, for the memory")
    options = parser.parse_args()
    rows: list[tuple[str, str, float]] = []

    def measured(name: str, value: str) -> None:
        rows.append((name, value, os.getloadavg()[0]))
        write(rows)

    with tempfile.TemporaryDirectory() as folder, sync_playwright() as api:
        start = time.monotonic()
        command = [
            sys.executable,
            "-m",
            "robust_instant_policy.cli",
            "studio",
            "--port",
            "0",
            "--demos",
            f"{folder}/demos",
        ]
        server = subprocess.Popen([*command, "--task", FIRST_TASK], stdout=subprocess.PIPE, text=True)
        try:
            assert server.stdout is not None
            address = re.search(r"http://\S+", server.stdout.readline())
            assert address is not None, "the studio printed no address"
            measured("address printed after", f"{time.monotonic() - start:.1f} s")
            chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
            browser = api.chromium.launch(executable_path=chromium, args=SOFTWARE)
            page = browser.new_page(viewport={"width": 1200, "height": 760})
            page.goto(address[0], timeout=PATIENCE_MS)
            wait(page, "Your turn")
            process = psutil.Process(server.pid)
            spent = sum(process.cpu_times()[:2])
            measured("scene ready in the browser after", f"{time.monotonic() - start:.1f} s")
            measured("processor time of the server until then", f"{spent:.1f} s")
            delays = latencies(page)
            quarter, median, most = np.percentile(delays, [25, 50, 90])
            measured(
                f"key to motion in the picture, {len(delays)} presses: median (quartile, 90%)",
                f"{median:.0f} ms ({quarter:.0f}, {most:.0f})",
            )
            before = process.memory_info().rss
            scenes = use(page, 60 * options.minutes)
            grown = (process.memory_info().rss - before) / 1e6
            measured(
                f"memory after {options.minutes:g} minutes of use, {scenes} scenes",
                f"{grown:+.0f} MB of {before / 1e6:.0f}",
            )
            seconds = tasks_in_turn(page)
            measured(
                f"{len(seconds)} tasks opened one after the other, seconds each",
                f"{min(seconds):.1f} to {max(seconds):.1f}",
            )
            measured("memory after that", f"{process.memory_info().rss / 1e6:.0f} MB")
            browser.close()
        finally:
            server.send_signal(signal.SIGTERM)
            server.wait(30)


def write(rows: list[tuple[str, str, float]]) -> None:
    """Write the table of what was measured so far, with the load average of the minute before."""
    head = f"| quantity | measured | load average, {os.cpu_count()} cores |"
    lines = (f"| {name} | {value} | {load:.1f} |" for name, value, load in rows)
    TABLE.write_text("\n".join([head, "| --- | --- | --- |", *lines]) + "\n")
    print(TABLE.read_text(), flush=True)


def wait(page: Page, text: str) -> None:
    """Wait until the banner says ``text``."""
    page.wait_for_function(
        "text => document.querySelector('#studio-banner')?.textContent.includes(text)", arg=text, timeout=PATIENCE_MS
    )


def latencies(page: Page) -> list[float]:
    """Milliseconds from a key that shifts the gripper to the first picture in which the arm has moved."""
    client = page.context.new_cdp_session(page)
    frames: list[tuple[float, np.ndarray]] = []

    def take(event: dict[str, Any]) -> None:
        client.send("Page.screencastFrameAck", {"sessionId": event["sessionId"]})
        picture = Image.open(io.BytesIO(base64.b64decode(event["data"]))).convert("L")
        frames.append((event["metadata"]["timestamp"], np.asarray(picture, dtype=np.int16)[:, : picture.width // 2]))

    client.on("Page.screencastFrame", take)
    client.send("Page.startScreencast", {"format": "jpeg", "quality": 60, "everyNthFrame": 1})
    page.keyboard.press("u")  # a recording begins
    sent = []
    for press in range(PRESSES):
        page.wait_for_timeout(REST_MS)
        sent.append(time.time())
        for _ in range(6):
            page.keyboard.press("ulojikoi"[press % 8])
    page.wait_for_timeout(2 * REST_MS)  # pictures come late where the machine is busy
    delays = []
    for start, end in pairwise([*sent, time.time()]):
        still = [picture for at, picture in frames if at <= start][-1]
        moved = [
            at for at, picture in frames if start < at < end and (abs(picture - still) > CHANGED).sum() > CHANGED_PIXELS
        ]
        if moved:
            delays.append(1000 * (moved[0] - start))
    client.send("Page.stopScreencast")
    return delays


def use(page: Page, seconds: float) -> int:
    """Move, undo, discard and change scenes for ``seconds``; returns the number of scenes."""
    end, scenes = time.monotonic() + seconds, 0
    while time.monotonic() < end:
        for key in "llluuu   jjjooo":
            page.keyboard.press("Space" if key == " " else key)
            page.wait_for_timeout(30)
        page.keyboard.press("z")
        page.wait_for_timeout(500)
        page.keyboard.press("x")
        wait(page, "Your turn")
        page.get_by_role("button", name="Another scene").click()
        wait(page, "Your turn")
        scenes += 1
    return scenes


def tasks_in_turn(page: Page) -> list[float]:
    """Seconds to open each of ten tasks."""
    seconds = []
    others = [name for name in TASK_NAMES if name != FIRST_TASK]
    for name in (*others[: TASKS_IN_TURN - 1], FIRST_TASK):
        start, before = time.monotonic(), page.inner_text("#studio-banner")
        tasks = page.locator("input.mantine-Select-input:visible").first
        tasks.fill(name)
        page.keyboard.press("ArrowDown")
        page.keyboard.press("Enter")
        page.wait_for_function(
            """before => {
                const text = document.querySelector("#studio-banner")?.innerText ?? "";
                return text.startsWith("Your turn") && text !== before;
            }""",
            arg=before,
            timeout=PATIENCE_MS,
        )
        seconds.append(time.monotonic() - start)
    return seconds


if __name__ == "__main__":
    main()
