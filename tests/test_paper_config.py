"""The paper's configuration end to end: real simulator, real HTTP; trajectories come from the benchmarks' stand-in."""

import json
import sys
import threading
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import robust_instant_policy as rip
from robust_instant_policy.cli import main
from robust_instant_policy.errors import ModelError, UnknownNameError
from robust_instant_policy.policies import Settings, build_context, locate
from robust_instant_policy.regression.em import fit_numbers

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from stand_in import Server, answer

PARTS = {"features": "efficientnet", "estimator": "em-number"}  # neither the hub nor minutes of training


@pytest.fixture(scope="module")
def url():
    server = Server()
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
    yield server.url
    server.shutdown()
    server.server_close()


@pytest.fixture(scope="module")
def demonstrations(workbench):
    return rip.load_demonstrations(workbench / "data" / "push-cube")


@pytest.fixture(scope="module")
def context(demonstrations):
    return build_context(demonstrations, Settings.of("paper").changed(**PARTS))


@pytest.fixture(scope="module")
def observation(workbench):
    return rip.Observation.load(workbench / "observation.npz")


def test_the_prompt_holds_whole_trajectories_with_all_keypoints_in_the_world_frame(context, observation):
    scene = locate(context, observation)
    (query,) = context.prompt.queries(scene.keypoints)
    blocks = [block.splitlines() for block in query.text.split("\n\n")]
    for block, keypoints, trajectory in zip(blocks, context.keypoints, context.trajectories, strict=False):
        assert block[0].split() == [str(round(1000 * number)) for number in keypoints.ravel()]
        assert len(block) == 1 + len(trajectory)
        assert block[1].split()[:3] == [str(round(1000 * number)) for number in trajectory.actions[0, :3]]
    assert len(blocks) == len(context.demonstrations) + 1


def test_the_trajectory_is_the_mean_of_every_number_by_itself(url, context, observation):
    llm = rip.connect(f"{url}#stand-in-40")
    plan = rip.RobustInstantPolicy.paper(llm, **PARTS).fit_context(context).plan(observation)
    assert len(plan.candidates) == 5
    candidates = np.stack([candidate.actions for candidate in plan.candidates])
    means = np.stack([fit_numbers(candidates[:, :, column]).mean for column in range(10)], axis=1)
    assert np.array_equal(plan.trajectory.actions[:, 9], means[:, 9] > 0.5)
    moved = np.linalg.norm((plan.trajectory.actions - means)[:, :9].reshape(-1, 3, 3), axis=-1)
    assert moved.max() < 0.02  # an arm needs a rigid gripper; the numbers' means are not quite one


def test_both_columns_of_table_ii_can_be_had_and_others_are_refused(url):
    llm = rip.connect(f"{url}#stand-in-0")
    columns = {}
    for column in ("sim", "real"):
        settings = rip.RobustInstantPolicy.paper(llm, column).settings
        columns[column] = settings.estimator, settings.descriptors.load_size, settings.descriptors.stride
    assert columns == {"sim": ("network-sim", 100, 2), "real": ("network-real", 240, 4)}
    with pytest.raises(UnknownNameError, match="paper-real"):
        rip.RobustInstantPolicy.paper(llm, "virtual")


def test_an_evaluation_in_the_papers_configuration_is_named_so(url, reach, in_this_process, monkeypatch):
    monkeypatch.chdir(reach)
    command = ["eval", "--config", "paper", "--features", "efficientnet", "--estimator", "em-number", "--demos", "4"]
    command += [
        "--tasks",
        "metaworld/reach",
        "--llm",
        f"{url}#stand-in-0",
        "--methods",
        "rip",
        "mean",
        "--episodes",
        "1",
        "--no-analysis",
    ]
    assert main([*command, "--out", "runs/paper-config"]) == 0
    rows = pq.read_table("runs/paper-config/episodes.parquet").to_pylist()
    assert [(row["method"], row["config"], row["estimator"], row["keypoints"]) for row in rows] == [
        ("rip", "paper", "em-number", "nearest"),
        ("mean", "paper", "", "nearest"),
    ]
    assert "Configuration: paper; descriptors: efficientnet" in Path("runs/paper-config/chosen-paper.md").read_text()


def test_the_stand_in_refuses_a_rate_above_100_percent(url, context, observation):
    policy = rip.RobustInstantPolicy.paper(rip.connect(f"{url}#stand-in-150"), **PARTS).fit_context(context)
    with pytest.raises(ModelError, match="stand-in-0 to stand-in-100"):
        policy.plan(observation)


@pytest.mark.parametrize("prompt", ["", "1 2 3 4", "hello\n\n1 2 3", "1 2 3\nx y\n\n1 2 3"])
def test_the_stand_in_refuses_a_prompt_without_examples(url, prompt):
    body = {"model": "stand-in-0", "prompt": prompt}
    request = urllib.request.Request(f"{url}/completions", json.dumps(body).encode())
    with pytest.raises(urllib.error.HTTPError) as caught:
        urllib.request.urlopen(request)
    assert caught.value.code == 400
    assert "the prompt cannot be answered" in json.load(caught.value)["error"]["message"]


def test_the_stand_in_repeats_itself_and_hallucinates_at_the_rate_it_is_told(context, observation):
    (query,) = context.prompt.queries(locate(context, observation).keypoints)
    sound = [context.prompt.read(0, answer(query.text, seed, 0.0)) for seed in range(40)]
    half = [context.prompt.read(0, answer(query.text, seed, 0.5)) for seed in range(40)]
    same = [np.array_equal(one, other) for one, other in zip(sound, half, strict=True)]
    assert 10 <= sum(same) <= 30
    middle = np.median(sound, axis=0)
    for one, is_sound in zip(half, same, strict=True):
        assert one.shape == middle.shape
        assert is_sound == (np.abs(one - middle)[:, :9].max() < 14)
