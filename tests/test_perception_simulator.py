"""Keypoints measured against the simulator's truth, on a task's own scenes."""

import pytest

pytest.importorskip("mani_skill")

from robust_instant_policy.perception import KeypointExtractor, measure
from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.camera_noise import CameraNoise


@pytest.mark.parametrize("noisy", [False, True])
def test_keypoints_of_push_cube_are_found_within_millimetres(noisy):
    task = make_task("push-cube")
    try:
        images, truths = [], []
        for seed in [*range(4), *range(100_000, 100_003)]:
            images.append(task.reset(seed))
            truths.append(task.scene_truth())
    finally:
        task.close()
    camera = CameraNoise().photograph if noisy else None
    seen = [camera(image, 100 + i) for i, image in enumerate(images[:4])] if camera else images[:4]
    extractor = KeypointExtractor(features="efficientnet", workspace=task.workspace).fit(seen)
    accuracy = measure(extractor, images[:4], truths[:4], images[4:], truths[4:], camera)
    assert accuracy.on_object >= 4
    assert {"cube", "goal"} <= set(accuracy.part_of)
    assert accuracy.median <= 0.008
    assert accuracy.worst_tenth <= 0.025
