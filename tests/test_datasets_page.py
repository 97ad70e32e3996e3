"""The page about a demonstrations folder shows every episode and needs nothing else."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from robust_instant_policy.datasets import DatasetWriter
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.reporting.demonstrations import write_page
from tests.datasets_samples import DESCRIPTION, RATE_HZ, TASK, demonstration, images
from tests.pages import BROWSER, Page, drawn


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
    page = Page(text)
    sections = [attributes for attributes in page.of("section") if "episode" in attributes["class"]]
    assert len(sections) == 3
    assert len(page.of("video")) == 3
    assert len(page.of("image")) == len(page.of("img")) == 3
    assert page.loaded() == []
    assert not re.search(r"https?://(?!www\.w3\.org)", text)
    assert "<b>1</b>attempts discarded" in text
    assert "<b>bold</b>" not in text
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)[1])
    path = data["episodes"][1]["arms"][0]
    expected = demonstration(2).trajectory
    np.testing.assert_allclose(path["grippers"], expected.triplets[:, 0], atol=1e-4)
    np.testing.assert_array_equal(path["closed"], expected.gripper_state[:, 0])


def test_folders_without_images_with_two_arms_and_without_depth_have_a_page_too(tmp_path):
    demo = demonstration(0, arms=2)
    blind = replace(demo.observation, depth=np.zeros_like(demo.observation.depth))
    with DatasetWriter(tmp_path / "demos", TASK, DESCRIPTION, RATE_HZ) as writer:
        writer.add(replace(demo, observation=blind))
    text = write_page(tmp_path / "demos", tmp_path / "page.html").read_text()
    assert not Page(text).of("video")
    assert "no reading at all" in text
    assert text.count('"points":') == 2


def test_a_folder_that_cannot_be_read_leaves_no_page(tmp_path):
    with pytest.raises(DatasetError, match="rip record"):
        write_page(tmp_path / "nowhere", tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


@pytest.mark.skipif(BROWSER is None, reason="no browser on this machine")
def test_the_page_draws_itself_in_a_browser_without_an_error(folder, tmp_path):
    page = write_page(folder, tmp_path / "page.html")
    document, log = drawn(page, tmp_path)
    assert "CONSOLE" not in log
    assert len(re.findall(r'class="now">0\.00 s of 0\.71 s<', document)) == 3
