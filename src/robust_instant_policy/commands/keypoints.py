"""`rip keypoints`: a page with the keypoints of all demonstrations side by side, and their errors."""

import argparse
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np

from robust_instant_policy.commands.console import StageConsole
from robust_instant_policy.commands.options import add_demos, add_keypoints, add_level, beside, positive, seed
from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import UsageError
from robust_instant_policy.evaluation import scene_seed
from robust_instant_policy.files import require_writable, write_whole
from robust_instant_policy.perception import KeypointExtractor
from robust_instant_policy.perception.accuracy import Accuracy, measure
from robust_instant_policy.reporting.keypoints import keypoints_page
from robust_instant_policy.tasks import is_installed, make_task
from robust_instant_policy.tasks.camera_noise import CameraNoise
from robust_instant_policy.tasks.task import require

SAME_DEPTH_M = 0.005  # difference of depth between two renderings of one scene
OTHER_PIXELS = 0.002  # share of pixels that differ by more, from which two images show different scenes
NOISE_SEED = 1_000_000  # of the demonstrations' camera noise, apart from the scenes'
Camera = Callable[[Observation, int], Observation]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_demos(parser)
    parser.add_argument(
        "--task", help="task that the demonstrations are of, if it is not installed: module:Class (default: their own)"
    )
    parser.add_argument("--scenes", type=positive, default=20, metavar="N", help="new scenes")
    parser.add_argument("--seed", type=seed, default=0, help="seed of the first new scene")
    add_keypoints(parser, "auto", "registration")
    parser.add_argument("--noise", action="store_true", help="add the noise of a stereo depth camera")
    add_level(parser)
    parser.add_argument("--out", type=Path, metavar="FILE", help="the page (default: DIR-keypoints.html)")


def run(options: argparse.Namespace) -> int:
    """Write the page; for a simulated task also compare the keypoints of new scenes with the true positions of the same
    material points."""
    if options.out is not None:
        require_writable(options.out)
    screen = StageConsole()
    demonstrations = load_demonstrations(options.demos)
    camera: Camera = CameraNoise().photograph if options.noise else lambda seen, _: seen
    images = [camera(one.observation, NOISE_SEED + index) for index, one in enumerate(demonstrations)]
    name = options.task or demonstrations[0].task
    # A class is loaded only if the user names it; a dataset must not make this package run code.
    simulated = (options.task or is_installed(name)) and all(one.seed is not None for one in demonstrations)
    scenes: list[Observation] = []
    accuracy = None
    with ExitStack() as stack:
        task: Any = stack.enter_context(closing(make_task(name, level=options.level))) if simulated else None
        extractor = KeypointExtractor(
            features=options.features or "auto",
            correspondence=options.keypoints or "registration",
            workspace=task.workspace if simulated else None,
        )
        if simulated:
            require(task, "scene_truth")
        with screen.stage(f"keypoints of {len(images)} demonstrations"):
            # The trajectories decide where a policy's keypoints lie, too.
            extractor.fit(images, [one.trajectory for one in demonstrations])
        if simulated:
            with screen.stage(f"{options.scenes} new scenes"):
                scenes, accuracy = _compare(task, extractor, demonstrations, camera, options.scenes, options.seed)
    summary = accuracy.summary() if accuracy else "no errors: the true positions are known for simulated tasks only"
    for line in (summary, *extractor.notes_):
        screen.say(f"    {line}")
    out = options.out or beside(options.demos, "-keypoints.html")
    write_whole(out, keypoints_page(extractor, images, scenes, accuracy, f"Keypoints of {name}").encode())
    screen.say(f"page: {out}")
    return 0


def _shows_the_same(scene: Observation, recorded: Observation) -> bool:
    """Whether two depth images are of the same scene."""
    if scene.depth.shape != recorded.depth.shape:
        return False
    one, other = (np.nan_to_num(image.depth) for image in (scene, recorded))  # 0 and NaN are no reading
    differs = np.abs(one - other) > SAME_DEPTH_M
    return bool(differs.mean() < OTHER_PIXELS)


def _compare(
    task: Any,
    extractor: KeypointExtractor,
    demonstrations: list[Demonstration],
    camera: Camera,
    num_scenes: int,
    seed: int,
) -> tuple[list[Observation], Accuracy]:
    known = []
    for demonstration in demonstrations:
        if not _shows_the_same(task.reset(demonstration.seed), demonstration.observation):
            raise UsageError(
                f"the demonstration with seed {demonstration.seed} does not show the scene that {demonstration.task} "
                "draws here: give --level as it was recorded"
            )
        known.append(task.scene_truth())
    scenes, scenes_known = [], []
    for index in range(num_scenes):
        scenes.append(task.reset(scene_seed(seed, index)))
        scenes_known.append(task.scene_truth())
    rendered = [demonstration.observation for demonstration in demonstrations]
    accuracy = measure(extractor, rendered, known, scenes, scenes_known, camera)
    return [camera(scene, index) for index, scene in enumerate(scenes)], accuracy
