"""The studio in a real browser: headless Chromium, drawing by software, against the real simulator."""

from __future__ import annotations

import io
import queue
import re
import shutil
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import UsageError
from robust_instant_policy.evaluation.scenes import SPLITS
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.policies import Proposal, Settings, locate
from robust_instant_policy.sanity import check_demonstrations, errors
from tests.conftest import NUM_DEMONSTRATIONS

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed; run: make setup")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
KEYS = {"x": "lj", "y": "ik", "z": "uo"}  # forward and back
SOFTWARE = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
PATIENCE_S = 120.0  # of a busy machine
# The page draws as often as it can, which takes a processor of its own where there is no GPU.
DRAW_SELDOM = """
const draw = window.requestAnimationFrame;
window.requestAnimationFrame = (frame) => setTimeout(draw, 200, frame);
window.cancelAnimationFrame = clearTimeout;
"""

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium; run: make setup (Debian), or install one")


class Studio:
    """A running studio, and a browser that looks at it."""

    def __init__(self, page, address: str, folder, browser):
        self.page, self.address, self.folder = page, address, folder
        self.session = page.session
        self.browser = browser
        self.view = self.another_view()

    def another_view(self):
        view = self.browser.new_page(viewport={"width": 900, "height": 600})
        view.add_init_script(DRAW_SELDOM)
        view.goto(self.address)
        return view

    def has_its_camera(self) -> bool:
        """Keys move the gripper in the directions that the browser sees; at first it looks from anywhere."""
        from robust_instant_policy.studio.stage import EYE

        return any(np.allclose(one.camera.position, EYE, atol=1e-3) for one in self.page._server.get_clients().values())

    def banner(self, text: str, view=None) -> None:
        """Wait until the banner says ``text``."""
        (view or self.view).wait_for_function(
            "text => document.querySelector('#studio-banner')?.textContent.includes(text)",
            arg=text,
            timeout=1000 * PATIENCE_S,
        )

    def press(self, key: str, times: int = 1) -> None:
        for _ in range(times):
            self.view.keyboard.press(key)

    def ask(self, question: Callable):
        """The answer of ``question(session)``, asked in the session's thread."""
        answers: queue.SimpleQueue = queue.SimpleQueue()
        self.session.post(lambda: answers.put(question(self.session)))
        return answers.get(timeout=PATIENCE_S)

    def tool(self) -> FloatArray:
        return self.ask(lambda session: session.cell.tool_poses()[0, :3, 3])

    def target(self) -> FloatArray:
        return self.ask(lambda session: session._targets[0, :3, 3].copy())

    def state(self) -> tuple:
        return self.tool(), self.target(), self.session.status

    def seconds(self) -> float:
        return self.ask(lambda session: session.status.seconds)

    def position(self, body: str) -> FloatArray:
        return self.ask(lambda session: session.cell.poses()[body][:3, 3])

    def picture(self) -> np.ndarray:
        """The scene's pixels, without the panel."""
        shot = self.view.screenshot(clip={"x": 0, "y": 0, "width": 480, "height": 600})
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), dtype=float)

    def pixel(self, point: FloatArray) -> FloatArray:
        """Where the browser draws the world ``point (3,)``."""
        camera = next(iter(self.page._server.get_clients().values())).camera
        forward = camera.look_at - camera.position
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        away = point - camera.position
        depth = away @ forward
        height = np.array([away @ right, -away @ np.cross(right, forward)]) / depth / np.tan(camera.fov / 2)
        size = self.view.evaluate(
            "(({width, height}) => [width, height])(document.querySelector('canvas').getBoundingClientRect())"
        )
        return np.array(size) / 2 + height * size[1] / 2


def refusal(action: Callable, session) -> str:
    try:
        action(session)
    except UsageError as error:
        return str(error)
    return ""


def wait_until(true: Callable[[], bool], what: str, state: Callable[[], object] = str) -> None:
    """Wait until ``true()``; a failure says ``what`` was waited for, and the ``state()`` at its end."""
    end = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < end, f"{what}; {state()}"
        time.sleep(0.02)


@pytest.fixture(scope="module")
def browser() -> Iterator:
    with playwright.sync_playwright() as api:
        browser = api.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def opened_studio(browser, workbench, tmp_path_factory) -> Iterator[Studio]:
    from robust_instant_policy.studio.server import Choice, studio

    folder = shutil.copytree(workbench / "data" / "push-cube", tmp_path_factory.mktemp("studio") / "push-cube")
    with studio(Choice("push-cube", folder, folder.parent), "127.0.0.1", 0) as (page, address):
        thread = threading.Thread(target=page.session.run, daemon=True)
        thread.start()
        try:
            opened = Studio(page, address, folder, browser)
            opened.banner("Your turn")
            wait_until(opened.has_its_camera, "the browser looks from where the page has it look")
            yield opened
        finally:
            page.session.post(page.session.close)
            page.session.stop()
            thread.join(PATIENCE_S)


@pytest.fixture
def studio(opened_studio) -> Iterator[Studio]:
    """The studio of all tests; what a test that failed was recording is discarded."""
    yield opened_studio
    opened_studio.ask(lambda session: session.discard() if session.status.phase == "recording" else None)


@needs_browser
def test_the_arm_follows_the_handle_that_is_dragged(studio):
    from robust_instant_policy.studio.stage import GIZMO_M

    before, picture = studio.tool(), studio.picture()
    mouse = studio.view.mouse
    grip = studio.pixel(before + np.array([0.93 * GIZMO_M, 0, 0]))  # on the arrow along x, beyond the rings
    mouse.move(*grip)
    time.sleep(0.5)  # the page finds what lies under the pointer when it draws
    mouse.down()
    for share in np.linspace(0, 1, 12):
        mouse.move(grip[0] + 60 * share, grip[1])
        time.sleep(0.03)
    mouse.up()
    studio.banner("Recording")
    wait_until(lambda: studio.tool()[0] - before[0] > 0.02, "the gripper moves along x")
    np.testing.assert_allclose(studio.tool()[1:], before[1:], atol=0.005)
    wait_until(lambda: np.abs(studio.picture() - picture).max(axis=2).__gt__(40).sum() > 500, "the picture shows it")
    studio.press("x")
    studio.banner("Your turn")
    np.testing.assert_allclose(studio.tool(), before, atol=0.002)


@needs_browser
def test_what_the_arm_cannot_reach_is_said_and_not_jumped_to(studio):
    studio.press("l", 180)
    studio.banner("Out of reach")
    reach = np.linalg.norm(studio.tool() - studio.position("base"))
    assert 0.8 < reach < 1.1
    studio.press("x")
    studio.banner("Your turn")
    lying = studio.ask(lambda one: one.cell.tool_poses()[0])
    lying[:3, :3] = Rotation.from_euler("x", 90, degrees=True).as_matrix() @ lying[:3, :3]
    lying[:3, 3] = 0.0, 0.2, 0.02
    studio.session.post(lambda: studio.session.aim(0, lying))
    studio.banner("a link of the arm would touch the table")
    studio.press("x")
    studio.banner("Your turn")


@needs_browser
def test_a_gamepad_moves_the_gripper(studio):
    before = studio.tool()
    studio.view.evaluate("navigator.getGamepads = () => [{axes: [0, 0, 0, -1], buttons: []}]")  # right stick up
    wait_until(lambda: studio.tool()[2] > before[2] + 0.03, "the gripper rises")
    studio.view.evaluate("navigator.getGamepads = () => [{axes: [0, 0, 0, 0], buttons: [{}, {}, {pressed: true}]}]")
    studio.banner("Your turn")
    np.testing.assert_allclose(studio.tool(), before, atol=0.002)


@needs_browser
def test_a_demonstration_by_keys_is_kept_like_any_other(studio):
    start = studio.session.observation
    goal = studio.position("goal")
    cube = studio.position("cube")

    def go(target: FloatArray, axes: str) -> None:
        """Press the keys that lead to ``target`` along ``axes``, one after the other, and wait for the gripper."""
        along = ["xyz".index(name) for name in axes]
        for axis, (more, less) in zip(along, (KEYS[name] for name in axes), strict=True):
            start = studio.target()[axis]
            steps = round((target[axis] - start) / 0.005)
            studio.press(more if steps > 0 else less, abs(steps))
            end = start + 0.005 * steps
            wait_until(lambda axis=axis, end=end: abs(studio.target()[axis] - end) < 1e-6, "keys", studio.state)
        wait_until(
            lambda: np.linalg.norm((studio.tool() - target)[along]) < 0.012, f"the gripper is at {target}", studio.state
        )

    studio.press("Space")
    go(cube + np.array([-0.085, 0, 0.1]), "xyz")  # along x first: close to its base the arm would fold up
    go(cube + np.array([-0.085, 0, -0.005]), "z")
    go(goal * [1, 1, 0] + np.array([-0.02, 0, 0.015]), "x")
    studio.banner("Press Enter")
    long, _, short = studio.ask(lambda one: (one.status.seconds, one.undo(1.0), one.status.seconds))
    assert short == pytest.approx(long - 1.0)
    for axis in "yzx":  # a second before its end the gripper may not have come down behind the cube
        go(goal * [1, 1, 0] + np.array([-0.02, 0, 0.015]), axis)
    studio.banner("Press Enter")
    studio.view.get_by_text("Another scene").click()  # would lose the recording
    studio.view.get_by_text("keep it (Enter) or discard it (X) first").wait_for(timeout=1000 * PATIENCE_S)
    for action in (lambda one: one.open(None), lambda one: one.play(None, None), lambda one: one.rehearse(None, None)):
        assert "being recorded" in studio.ask(lambda one, action=action: refusal(action, one))
    studio.press("Enter")
    studio.banner("Your turn")
    *earlier, kept = load_demonstrations(studio.folder, task="push-cube")
    assert len(earlier) == NUM_DEMONSTRATIONS
    assert not errors(check_demonstrations([*earlier, kept]).findings)
    assert kept.rate_hz == 55
    assert kept.seed == studio.session.seed - 1 == max(one.seed for one in earlier) + 1
    np.testing.assert_array_equal(kept.observation.rgb, start.rgb)
    assert kept.trajectory.gripper_state[0, 0] == 0
    assert kept.trajectory.gripper_state[-1, 0] == 1
    speed = np.linalg.norm(np.diff(kept.trajectory.triplets[:, 0, 0], axis=0), axis=1) * kept.rate_hz
    assert speed.max() < 0.6


@needs_browser
def test_a_recording_ends_after_its_longest_time_and_can_be_taken_back(studio, monkeypatch):
    monkeypatch.setattr("robust_instant_policy.studio.session.LONGEST_TAKE_S", 1.0)
    studio.press("u")
    studio.banner("longest recording is reached")
    assert studio.seconds() == pytest.approx(1.0, abs=0.01)
    studio.press("z")
    studio.banner("Your turn")


@needs_browser
def test_a_second_browser_watches_until_it_takes_the_controls(studio):
    other = studio.another_view()
    studio.banner("Your turn", other)
    other.get_by_text("Another scene").click()
    other.get_by_text("Another browser holds the controls").wait_for(timeout=1000 * PATIENCE_S)
    seed = studio.session.seed
    other.get_by_role("button", name="Take the controls").click()
    other.get_by_text("Another scene").click()
    wait_until(lambda: studio.session.seed == seed + 1, "the scene changes")
    other.close()
    studio.view.get_by_text("Another scene").click()
    wait_until(lambda: studio.session.seed == seed + 2, "the first browser has the controls again")


@needs_browser
def test_a_recording_goes_on_after_its_tab_was_closed(studio):
    before = studio.tool()
    studio.press("u", 4)
    studio.banner("Recording")
    wait_until(lambda: studio.tool()[2] > before[2] + 0.01, "the gripper rises")
    studio.view.close()
    studio.view = studio.another_view()
    studio.banner("Recording")
    studio.press("u", 4)
    wait_until(lambda: studio.tool()[2] > before[2] + 0.03, "the gripper rises further")
    studio.press("x")
    studio.banner("Your turn")


@needs_browser
def test_a_plan_is_made_shown_and_executed(studio, monkeypatch):
    from robust_instant_policy.studio import markup

    view, trust = studio.view, markup.trust
    view.get_by_role("tab", name="Plan").click()
    view.get_by_role("button", name="New scene").click()
    studio.banner("Your turn")
    bare = studio.picture()
    view.get_by_role("button", name="Plan", exact=True).click()
    view.get_by_role("button", name="Cancel").click()
    view.get_by_text("Planning was cancelled").wait_for(timeout=1000 * PATIENCE_S)
    told: list[str] = []  # a slow browser may miss what is soon replaced
    monkeypatch.setattr(markup, "trust", lambda *arguments: told.append(trust(*arguments)) or told[-1])
    view.get_by_role("button", name="Plan", exact=True).click()
    view.get_by_text(re.compile(r"^Confidence [01].\d\d: 5 of 5 candidates")).wait_for(timeout=3000 * PATIENCE_S)
    assert "more follow" in told[0]
    assert "Confidence" not in told[0], "some of the candidates say little"
    assert view.locator(".keypoint").count() == 10
    for mark in view.locator(".keypoint").all():
        mark.hover()  # fails where the pointer cannot reach it
        assert re.search(r"on object \d: confidence here [01].\d\d, in the demonstrations [01]", mark.text_content())
    assert (np.abs(studio.picture() - bare).max(axis=2) > 40).sum() > 300
    for slider, value in (
        ("Noise, mm", 20),
        ("ν of the t", 10),
        ("Candidates Q", 3),
        ("Candidates Q", 5),
        ("Noise, mm", 0),
        ("ν of the t", 1.5),
    ):
        drawn = studio.page.plans.trajectory.actions
        setting = view.locator(f"xpath=//label[contains(., '{slider}')]/ancestor::*[.//input][1]//input").last
        setting.fill(str(value))
        setting.press("Enter")
        wait_until(
            lambda drawn=drawn: not np.array_equal(studio.page.plans.trajectory.actions, drawn), f"{slider} is drawn"
        )
    assert studio.session.seed < min(SPLITS.values()), "the scenes of evaluations stay unseen"
    view.get_by_role("tab", name="Act").click()
    view.get_by_role("button", name="Execute").click()
    home = studio.tool()
    wait_until(lambda: np.linalg.norm(studio.tool() - home) > 0.05, "the arm moves")
    resumed = threading.Event()
    studio.session.post(resumed.wait)  # the cell waits for the browser, however slow it is
    view.get_by_role("button", name="Stop").click()
    wait_until(lambda: not studio.session._jobs.empty(), "Stop arrives")
    resumed.set()
    view.get_by_text("Stopped").wait_for(timeout=1000 * PATIENCE_S)
    end = studio.page.plans.trajectory.triplets[-1, 0, 1:].mean(axis=0)
    assert np.linalg.norm(studio.target() - end) > 0.05, "the arm is not sent to the end of the plan"
    wait_until(lambda: np.linalg.norm(studio.tool() - studio.target()) < 0.01, "the arm holds")
    view.get_by_role("button", name="Same scene again").click()
    view.get_by_role("button", name="Execute").click()
    view.get_by_text("Success: the cube is in the goal disc").wait_for(timeout=1000 * PATIENCE_S)


@needs_browser
def test_keys_move_either_of_two_arms(studio):
    studio.view.get_by_role("tab", name="Show").click()
    studio.page.open("aloha-sweep")
    studio.banner("sweep the object")
    before = studio.ask(lambda one: one.cell.tool_poses()[:, 2, 3])
    studio.press("u", 4)
    studio.press("c")
    studio.press("o", 4)
    wait_until(
        lambda: (studio.ask(lambda one: one.cell.tool_poses()[:, 2, 3]) - before) @ [1, -1] > 0.03,
        "the left gripper rises, the right one sinks",
    )
    studio.press("x")
    studio.banner("Your turn")


def test_the_t_regression_ignores_a_candidate_that_is_dragged_away_and_the_gaussian_follows_it(context, workbench):
    from robust_instant_policy.studio.drawing import spread
    from robust_instant_policy.studio.planner import Choices, Draft

    settings = Settings()
    scene = locate(context, Observation.load(workbench / "observation.npz"))
    candidates = context.prompt.for_scene(scene.keypoints).carried_over(scene.keypoints, 5)
    draft = Draft(context, scene, settings, Proposal(candidates), "")
    far, farther = (Choices(dragged={0: (0.5, np.array([0.0, 0.0, way]))}) for way in (0.15, 0.30))

    def moved(trajectory: Callable) -> float:
        """How far the ``trajectory`` follows from ``far`` to ``farther``, metres."""
        one, other = (trajectory(choices).tool_points[:, 0] for choices in (far, farther))
        return float(np.linalg.norm(other - one, axis=1).max())

    assert moved(draft.gaussian) > 0.02
    assert moved(lambda choices: draft.plan(choices).trajectory) < moved(draft.gaussian) / 2
    assert draft.plan(far).hallucinated.tolist() == [True, False, False, False, False]
    quiet, noisy = (spread(draft.plan(Choices(noise=noise)), 0).mean() for noise in (0.0, 0.02))
    assert noisy > 1.5 * quiet


def test_a_recorded_folder_is_shown_without_a_simulator(workbench):
    from robust_instant_policy.studio.recorded import RecordedCell

    shown = load_demonstrations(workbench / "data" / "push-cube")
    observation = Observation.load(workbench / "observation.npz")
    cell = RecordedCell("push-cube", shown, observation)
    assert cell.reset(0) is observation
    assert cell.reset(1) is shown[0].observation
    assert cell.arms == ()
    assert cell.failure() is None


def test_pauses_are_cut_and_shakes_smoothed_and_a_grasp_stays_where_it_is():
    from robust_instant_policy.studio.take import edited

    rate_hz, count = 50.0, 200
    poses = np.tile(np.eye(4), (count, 1, 1, 1))
    poses[:, 0, 0, 3] = np.concatenate([np.linspace(0, 0.1, 50), np.full(100, 0.1), np.linspace(0.1, 0.2, 50)])
    shaking = poses.copy()
    shaking[:50, 0, 1, 3] += 0.002 * np.sin(np.arange(50) * 2 * np.pi * 12 / rate_hz)
    closed = np.arange(count)[:, None] >= 60
    steady, states = edited(shaking, closed, rate_hz)
    change = int(np.flatnonzero(states[:, 0])[0])
    assert len(steady) < 150
    assert np.abs(steady[:change, 0, 1, 3]).max() < 0.001
    np.testing.assert_allclose(steady[change, 0, :3, 3], [0.1, 0, 0], atol=1e-4)
    np.testing.assert_allclose(steady[[0, -1]], shaking[[0, -1]], atol=1e-9)
    held = np.count_nonzero(states[:, 0] & (np.abs(steady[:, 0, 0, 3] - 0.1) < 1e-3))
    assert held >= 0.4 * rate_hz  # the fingers have their time


def test_an_address_for_others_needs_its_token_and_no_other_web_site_may_use_the_page():
    from robust_instant_policy.studio.gate import Gate, admit

    gate = Gate("0.0.0.0", 0, 1)
    try:
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(f"http://127.0.0.1:{gate.port}/", timeout=10)
        token = gate.address.rsplit("/", 1)[-1]
        assert len(token) > 20
    finally:
        gate.close()
    head = "GET /{} HTTP/1.1\r\nHost: {}\r\nOrigin: {}\r\n\r\n"
    assert admit(head.format("secret", "robot:80", "http://robot:80"), "secret", False)[1] == ""
    assert "token" in admit(head.format("other", "robot:80", "http://robot:80"), "secret", False)[1]
    assert "web site" in admit(head.format("", "localhost:80", "http://bad.example"), "", True)[1]
    assert "this machine" in admit(head.format("", "bad.example:80", "http://bad.example:80"), "", True)[1]
