"""Records the film of the studio for the README, and two still pictures, in headless Chromium.

    python scripts/studio_film.py --demos data/push-cube    # recorded by `make demo`

A demonstration by keys, a plan in a new scene, its preview, and its execution. The demonstration is not kept.
"""

from __future__ import annotations

import argparse
import base64
import io
import queue
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from playwright.sync_api import Page, sync_playwright

from robust_instant_policy.studio.server import Choice, studio
from robust_instant_policy.studio.session import Session

SOFTWARE = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
SIZE, FILM_SIZE = (1200, 720), (880, 528)
FRAME_S = 0.15  # of the film
FILM_S = 24.0  # the page is shown faster if it took longer
END_S = 1.5  # of the film, on the last picture
LONGEST_STILL_S = 0.8  # of the page; longer ones, while the model is asked, are cut
QUALITY = 55
KEYS = {"x": "lj", "y": "ik", "z": "uo"}  # forward and back
NUDGE_M = 0.005
PATIENCE_S = 300


class Camera:
    """Collects the pictures of a browser page with their times."""

    def __init__(self, view: Page):
        self.frames: list[tuple[float, Image.Image]] = []
        self._client = view.context.new_cdp_session(view)
        self._client.on("Page.screencastFrame", self._take)
        self._client.send("Page.startScreencast", {"format": "png", "everyNthFrame": 1})

    def _take(self, event: dict[str, Any]) -> None:
        self._client.send("Page.screencastFrameAck", {"sessionId": event["sessionId"]})
        picture = Image.open(io.BytesIO(base64.b64decode(event["data"]))).convert("RGB")
        self.frames.append((event["metadata"]["timestamp"], picture))

    def film(self) -> list[Image.Image]:
        """The pictures at the film's rate, without long stills."""
        self._client.send("Page.stopScreencast")
        taken = np.array([at for at, _ in self.frames])
        shown = np.concatenate([[0.0], np.cumsum(np.minimum(np.diff(taken), LONGEST_STILL_S))])
        shown *= min(1.0, FILM_S / shown[-1])
        chosen = np.searchsorted(shown, np.arange(0.0, shown[-1] + END_S, FRAME_S), side="right") - 1
        return [self.frames[index][1].resize(FILM_SIZE, Image.Resampling.LANCZOS) for index in chosen]


def ask(session: Session, question: Callable[[Session], Any]) -> Any:
    """The answer of ``question(session)``, asked in the session's thread."""
    answers: queue.SimpleQueue = queue.SimpleQueue()
    session.post(lambda: answers.put(question(session)))
    return answers.get(timeout=PATIENCE_S)


def banner(view: Page, text: str) -> None:
    view.wait_for_function(
        "text => document.querySelector('#studio-banner')?.textContent.includes(text)",
        arg=text,
        timeout=1000 * PATIENCE_S,
    )


def demonstrate(view: Page, session: Session) -> None:
    """Push the cube into the goal by keys."""
    goal, cube, tool = ask(
        session, lambda one: (*(one.cell.poses()[body][:3, 3] for body in ("goal", "cube")), one.cell.tool_poses()[0])
    )
    at = tool[:3, 3].copy()
    behind, end = cube + np.array([-0.085, 0, 0]), goal + np.array([-0.02, 0, 0])
    view.keyboard.press("Space")
    for axes, target in (("xyz", [*behind[:2], 0.1]), ("z", [*behind[:2], 0.015]), ("x", [*end[:2], 0.015])):
        for axis in axes:
            index = "xyz".index(axis)
            steps = round((target[index] - at[index]) / NUDGE_M)
            for _ in range(abs(steps)):
                view.keyboard.press(KEYS[axis][0 if steps > 0 else 1])
                view.wait_for_timeout(15)
            at[index] += steps * NUDGE_M
        view.wait_for_timeout(600)
    banner(view, "Press Enter")
    view.wait_for_timeout(1000)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--demos", type=Path, required=True)
    parser.add_argument("--images", type=Path, default=Path("docs/images"))
    options = parser.parse_args()
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    choice = Choice("push-cube", options.demos, options.demos.parent)
    with sync_playwright() as api, studio(choice, "127.0.0.1", 0) as (page, address):
        session = page.session
        thread = threading.Thread(target=session.run, daemon=True)
        thread.start()
        ask(session, lambda one: one.seed)  # the cell is open
        view = api.chromium.launch(executable_path=chromium, args=SOFTWARE).new_page(
            viewport={"width": SIZE[0], "height": SIZE[1]}
        )
        view.goto(address, timeout=1000 * PATIENCE_S)
        banner(view, "Your turn")
        view.get_by_text("Software WebGL").locator("xpath=ancestor::*[@role='alert']").get_by_role("button").click()
        view.wait_for_timeout(2000)
        camera = Camera(view)
        demonstrate(view, session)
        still(view, options.images / "studio-show.jpg")
        view.keyboard.press("x")
        banner(view, "Your turn")
        view.get_by_role("tab", name="Plan").click()
        view.get_by_role("button", name="New scene").click()
        ask(session, lambda one: one.seed)  # the new scene is drawn
        view.wait_for_timeout(1500)
        view.get_by_role("button", name="Plan", exact=True).click()
        view.get_by_text("5 of 5 candidates").wait_for(timeout=1000 * PATIENCE_S)
        view.wait_for_timeout(1500)
        still(view, options.images / "studio-plan.jpg")
        view.get_by_role("tab", name="Act").click()
        view.get_by_role("button", name="Preview").click()
        view.wait_for_timeout(6500)
        view.get_by_role("button", name="Execute").click()
        view.get_by_text("Success").or_(view.get_by_text("Failed:")).wait_for(timeout=1000 * PATIENCE_S)
        view.wait_for_timeout(1500)
        frames = camera.film()
        session.post(session.close)
        session.stop()
        thread.join()
    out = options.images / "studio.webp"
    frames[0].save(
        out, save_all=True, append_images=frames[1:], duration=round(1000 * FRAME_S), loop=0, quality=QUALITY, method=4
    )
    print(f"{out}: {len(frames)} frames, {out.stat().st_size / 1e6:.1f} MB")


def still(view: Page, path: Path) -> None:
    time.sleep(1.0)  # for the notifications to be drawn
    Image.open(io.BytesIO(view.screenshot(timeout=1000 * PATIENCE_S))).convert("RGB").save(path, quality=85)
    print(path)


if __name__ == "__main__":
    main()
