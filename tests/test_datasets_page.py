"""The page about a demonstrations folder shows every episode and needs nothing else."""

import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from robust_instant_policy.datasets import DatasetWriter, write_page
from robust_instant_policy.errors import DatasetError
from tests.datasets_samples import DESCRIPTION, RATE_HZ, TASK, demonstration, images

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")


class Elements(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.seen = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.seen.append((tag, dict(attributes)))

    def of(self, tag):
        return [attributes for name, attributes in self.seen if name == tag]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "demos"
    with DatasetWriter(path, TASK, DESCRIPTION, RATE_HZ) as writer:
        for seed in (1, 2, 3):
            demo = replace(demonstration(seed), info={"note": "</script><b>bold</b> & more"})
            writer.add(demo, images(seed))
        writer.discard(4)
    return path


def test_the_page_shows_every_episode_and_loads_nothing(folder, tmp_path):
    text = write_page(folder, tmp_path / "page.html").read_text()
    page = Elements(text)
    sections = [attributes for attributes in page.of("section") if "episode" in attributes["class"]]
    assert len(sections) == 3
    assert len(page.of("video")) == 3
    assert len(page.of("img")) == 6
    for tag, attributes in page.seen:
        for name in ("src", "href"):
            assert attributes.get(name, "data:").startswith("data:"), (tag, attributes)
    assert not re.search(r"https?://(?!www\.w3\.org)", text)
    assert "<b>1</b>attempts thrown away" in text
    assert "<b>bold</b>" not in text
    assert "%%" not in text
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)[1])
    drawn = data["episodes"][1]["arms"][0]
    expected = demonstration(2).trajectory
    np.testing.assert_allclose(drawn["grippers"], expected.triplets[:, 0], atol=1e-4)
    np.testing.assert_array_equal(drawn["closed"], expected.gripper_state[:, 0])


def test_folders_without_images_with_two_arms_and_without_depth_have_a_page_too(tmp_path):
    demo = demonstration(0, arms=2)
    blind = replace(demo.observation, depth=np.zeros_like(demo.observation.depth))
    with DatasetWriter(tmp_path / "demos", TASK, DESCRIPTION, RATE_HZ) as writer:
        writer.add(replace(demo, observation=blind))
    text = write_page(tmp_path / "demos", tmp_path / "page.html").read_text()
    assert not Elements(text).of("video")
    assert "no reading at all" in text
    assert text.count('"points":') == 2


def test_a_folder_that_cannot_be_read_leaves_no_page(tmp_path):
    with pytest.raises(DatasetError, match="rip record"):
        write_page(tmp_path / "nowhere", tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


@pytest.mark.skipif(BROWSER is None, reason="no browser on this machine")
def test_the_page_draws_itself_in_a_browser_without_an_error(folder, tmp_path):
    page = write_page(folder, tmp_path / "page.html")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--virtual-time-budget=2000"]
    done = subprocess.run(
        [BROWSER, *options, f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", page.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert "CONSOLE" not in done.stderr
    assert len(re.findall(r'class="now">0\.00 s of 0\.71 s<', done.stdout)) == 3
