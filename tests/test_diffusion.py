import shutil
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import nn

from robust_instant_policy.cli import main
from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import DatasetError, ModelError, UsageError
from robust_instant_policy.evaluation import Episode, Scene, Setup, Variant, scene_seed
from robust_instant_policy.evaluation.work import SceneWork
from robust_instant_policy.evaluation.workbench import Workbench
from robust_instant_policy.policies import Settings, make_policy
from robust_instant_policy.policies.diffusion import ImageDiffusion, KeypointDiffusion, dp, kat_dp, training, vision
from robust_instant_policy.policies.diffusion.denoiser import Denoiser
from robust_instant_policy.policies.diffusion.scaling import Scaling
from robust_instant_policy.policies.diffusion.unet import ConditionalUnet1D
from robust_instant_policy.policies.diffusion.vision import ImageEncoder
from robust_instant_policy.policies.training import Training
from robust_instant_policy.tasks import make_task


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Threads that share so little work, on a busy machine, wait for each other most of the time."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


ONE = Settings(features="efficientnet", num_queries=1)
THREE = Settings(features="efficientnet", num_queries=3)


@pytest.fixture(scope="module")
def demonstrations(workbench):
    return load_demonstrations(workbench / "data" / "push-cube")


@pytest.fixture
def small_batches(monkeypatch):
    """Few enough trajectories a step to train while one waits."""
    monkeypatch.setattr(kat_dp, "BATCH_SIZE", 4)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """Two demonstrations with images along the way."""
    folder = tmp_path_factory.mktemp("filmed")
    command = ["record", "--task", "push-cube", "--episodes", "2", "--images", "--every", "5", "--out", str(folder)]
    assert main(command) == 0
    return folder


@pytest.fixture
def small_images(monkeypatch):
    """A Diffusion Policy small enough to train while one waits."""
    for name, value in {"IMAGE_PIXELS": 36, "CROP_PIXELS": 32, "BATCH_SIZE": 8, "NOISE_DRAWS": 2}.items():
        monkeypatch.setattr(dp, name, value)
    monkeypatch.setattr(vision, "STAGES", (16, 16, 32, 32))


class Killed(Exception):
    pass


def killed_at(step):
    def report(method, done, total, loss, seconds_left):
        if done == step:
            raise Killed

    return report


def refused(*_):
    raise AssertionError("there is nothing left to train")


def test_the_network_keeps_shapes_and_listens_to_what_it_is_told():
    torch.manual_seed(0)
    network = ConditionalUnet1D(channels=20, condition=7, widths=(16, 32, 64))
    assert network.length_multiple == 4
    noisy, steps = torch.randn(3, 16, 20), torch.tensor([0, 50, 99])
    told = network(noisy, steps, torch.zeros(3, 7))
    assert told.shape == noisy.shape
    assert not torch.allclose(told, network(noisy, steps, torch.ones(3, 7)))
    assert not torch.allclose(told, network(noisy, steps.flip(0), torch.zeros(3, 7)))


def test_places_are_those_in_the_whole_image_wherever_it_was_cropped():
    torch.manual_seed(0)
    encoder = ImageEncoder(size=96)
    assert not any(isinstance(module, nn.BatchNorm2d) for module in encoder.modules())
    crops = torch.rand(1, 3, 64, 64)
    here = encoder(crops, torch.tensor([[0, 0]]))
    there = encoder(crops, torch.tensor([[24, 12]]))
    down, right = (there - here).unflatten(-1, (2, -1))[0]
    torch.testing.assert_close(down, torch.full_like(down, 2 * 24 / 96))
    torch.testing.assert_close(right, torch.full_like(right, 2 * 12 / 96))
    assert here.min() >= -1
    assert here.max() <= 2 * 64 / 96 - 1


def test_samples_stay_within_limits_and_the_same_seed_gives_the_same(demonstrations):
    torch.manual_seed(0)
    model = Denoiser(nn.Identity(), condition=4, channels=10, widths=(16, 32))
    first, again, other = (
        model.sample(torch.zeros(5, 4), 12, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)
    )
    assert first.shape == (5, 12, 10)
    assert first.abs().max() <= 1
    torch.testing.assert_close(first, again, rtol=0, atol=0)
    assert not torch.allclose(first, other)
    actions = demonstrations[0].trajectory.actions
    scaling = Scaling.of(actions)
    assert np.abs(scaling.scaled(actions)).max() <= 1
    np.testing.assert_allclose(scaling.restored(scaling.scaled(actions)), actions, atol=1e-12)


def test_keypoint_diffusion_learns_recorded_demonstrations(demonstrations, context, workbench, tmp_path, small_batches):
    policy = KeypointDiffusion(THREE, Training(tmp_path, steps=80)).fit_context(context)
    losses = policy.trained_.losses
    assert losses[-10:].mean() < 0.3 * losses[:10].mean()
    plan = policy.plan(Observation.load(workbench / "observation.npz"))
    assert len(plan.candidates) == 3
    assert policy.executions(plan) == (plan.candidates[0],)
    assert plan.trajectory.actions.shape[1] == 10
    lowest, highest = (
        np.stack([end(one.trajectory.actions[:, :9], 0) for one in demonstrations]) for end in (np.min, np.max)
    )
    assert (plan.trajectory.actions[:, :9] > lowest.min(axis=0) - 0.1).all()
    assert (plan.trajectory.actions[:, :9] < highest.max(axis=0) + 0.1).all()


def test_a_training_that_was_killed_ends_as_if_it_had_not_been(context, tmp_path, monkeypatch, small_batches):
    monkeypatch.setattr(training, "SAVE_EVERY_S", 0.0)
    whole = KeypointDiffusion(ONE, Training(tmp_path / "whole", steps=8)).fit_context(context)
    with pytest.raises(Killed):
        KeypointDiffusion(ONE, Training(tmp_path / "cut", steps=8, report=killed_at(5))).fit_context(context)
    assert [path.name for path in (tmp_path / "cut").iterdir()] == [
        f"{whole.trained_.path.stem}.unfinished.safetensors"
    ]
    resumed = KeypointDiffusion(ONE, Training(tmp_path / "cut", steps=8)).fit_context(context)
    assert [path.name for path in (tmp_path / "cut").iterdir()] == [whole.trained_.path.name]
    one, other = load_file(whole.trained_.path), load_file(resumed.trained_.path)
    assert one.keys() == other.keys()
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_what_was_trained_is_not_trained_again_and_other_demonstrations_are(
    demonstrations, context, tmp_path, small_batches
):
    first = KeypointDiffusion(ONE, Training(tmp_path, steps=2)).fit_context(context)
    KeypointDiffusion(ONE, Training(tmp_path, steps=2, report=refused)).fit_context(context)
    fewer = KeypointDiffusion(ONE, Training(tmp_path, steps=2))
    assert fewer.fit(demonstrations[:4]).trained_.path != first.trained_.path
    longer = KeypointDiffusion(ONE, Training(tmp_path, steps=3)).fit_context(context)
    assert longer.trained_.path != first.trained_.path


def test_a_damaged_checkpoint_is_refused_in_one_line(context, tmp_path, small_batches):
    policy = KeypointDiffusion(ONE, Training(tmp_path, steps=1)).fit_context(context)
    policy.trained_.path.write_bytes(b"half a file")
    with pytest.raises(ModelError, match="remove it to train again"):
        policy.fit_context(context)


def test_diffusion_policy_learns_recorded_images_and_a_kill_does_not_matter(
    filmed, tmp_path, monkeypatch, small_images
):
    demonstrations = load_demonstrations(filmed)
    policy = ImageDiffusion(Training(tmp_path, steps=26)).fit(demonstrations)
    losses = policy.trained_.losses
    assert losses[-10:].mean() < 0.6 * losses[:5].mean()
    assert policy.rate_hz == 11.0
    whole = ImageDiffusion(Training(tmp_path / "whole", steps=8)).fit(demonstrations)
    monkeypatch.setattr(training, "SAVE_EVERY_S", 0.0)
    with pytest.raises(Killed):
        ImageDiffusion(Training(tmp_path / "cut", steps=8, report=killed_at(5))).fit(demonstrations)
    assert list((tmp_path / "cut").glob("*.unfinished.safetensors"))
    resumed = ImageDiffusion(Training(tmp_path / "cut", steps=8)).fit(demonstrations)
    one, other = load_file(whole.trained_.path), load_file(resumed.trained_.path)
    assert all(torch.equal(one[name], other[name]) for name in one)
    rehearsal = policy.rehearse(1)[0]
    assert rehearsal.samples.shape == (1, *rehearsal.shown.shape)
    _drives_the_simulator(policy)


def _drives_the_simulator(policy):
    """It looks twice a plan: after seven of its eight waypoints, and after the eighth."""
    task = make_task("push-cube")
    commanded = []

    class Watched:
        rate_hz = policy.rate_hz
        controller = policy.controller(task.reset(0))

        def act(self, observation, action):
            waypoints = self.controller.act(observation, action)
            commanded.append(waypoints)
            return waypoints

    try:
        task.follow(Watched(), max_seconds=2.0)
    finally:
        task.close()
    moves = [len(waypoints) for waypoints in commanded if waypoints is not None]
    assert moves[:2] == [dp.EXECUTED - 1, 1][: len(moves)]
    assert set(np.concatenate(commanded)[:, 9]) <= {0.0, 1.0}


def test_a_policy_that_wants_to_stay_where_it_is_is_done(filmed, small_images, tmp_path, monkeypatch):
    policy = ImageDiffusion(Training(tmp_path, steps=1)).fit(load_demonstrations(filmed))
    controller = policy.controller(None)
    here = np.append(np.linspace(0.1, 0.2, 9), 0.0)
    monkeypatch.setattr(controller, "planned", lambda seen: np.tile(here, (dp.EXECUTED, 1)))
    image = SimpleNamespace(rgb=np.zeros((64, 64, 3), np.uint8))
    assert [controller.act(image, here) is None for _ in range(5)] == [False] * 4 + [True]


def test_what_cannot_be_learned_from_is_refused(demonstrations, tmp_path, workbench):
    with pytest.raises(DatasetError, match="record them with"):
        ImageDiffusion(Training(tmp_path, steps=1)).fit(demonstrations)
    with pytest.raises(UsageError, match="fit"):
        ImageDiffusion().controller(Observation.load(workbench / "observation.npz"))


def test_the_command_trains_what_an_evaluation_then_finds(workbench, demonstrations, tmp_path, capsys):
    command = ["train", "--task", "push-cube", "--demos", str(workbench / "data" / "push-cube"), "--steps", "2"]
    assert main([*command, "--method", "kat-dp", "--out", str(tmp_path)]) == 0
    assert "2 steps in" in capsys.readouterr().out
    assert "demonstration 2" in next(tmp_path.glob("*.svg")).read_text()
    # An evaluation names the network that "auto" stands for.
    make_policy("kat-dp", None, ONE, Training(tmp_path, steps=2, report=refused)).fit(demonstrations)
    assert main([*command, "--method", "rip", "--out", str(tmp_path)]) == 2
    assert "known: dp, kat-dp" in capsys.readouterr().err


def test_an_evaluation_trains_diffusion_policy_and_executes_it(filmed, workbench, small_images, tmp_path):
    shutil.copytree(filmed, tmp_path / "data" / "push-cube-images")
    shutil.copytree(workbench / "data" / "push-cube", tmp_path / "data" / "push-cube")
    setup = Setup("none", True, tmp_path / "samples.sqlite", tmp_path / "data", 1.0, False, tmp_path / "checkpoints")
    scene, variant = Scene("push-cube", "seen", scene_seed(0, 0)), Variant("dp", demos=2, steps=1)
    with closing(Workbench(setup)) as bench:
        executed = next(bench.run(SceneWork(scene, (variant,))))
    assert isinstance(executed, Episode)
    assert (executed.scene, executed.variant, executed.candidates) == (scene, variant, 1)


def test_the_report_of_an_evaluation_shows_what_was_learned(reach, in_this_process, tmp_path, monkeypatch):
    monkeypatch.chdir(reach)
    command = ["eval", "--tasks", "metaworld/reach", "--methods", "kat-dp", "--episodes", "1", "--no-videos"]
    places = ["--checkpoints", str(tmp_path), "--out", str(tmp_path / "run")]
    assert main([*command, "--steps", "2", "--demos", "3", *places]) == 0
    (picture,) = (tmp_path / "run" / "training").glob("metaworld-reach-kat-dp-*-2steps-*.svg")
    assert "demonstration 2" in picture.read_text()
    page = (tmp_path / "run" / "index.html").read_text()
    assert page.count('<h2 id="training">') == page.count('href="#training"') == 1
    assert picture.stem in page
