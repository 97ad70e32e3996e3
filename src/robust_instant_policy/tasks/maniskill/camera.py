"""A sensor of a ManiSkill environment as a calibrated RGB-D camera, and the ground truth of its pixels."""

from typing import Any

import numpy as np
from mani_skill.envs.sapien_env import BaseEnv

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray, invert_pose, make_pose
from robust_instant_policy.tasks.scene_truth import SceneTruth


def matrix(pose: Any) -> FloatArray:
    """``(4, 4)`` of the first of a batch of ManiSkill's poses."""
    return pose.to_transformation_matrix()[0].cpu().numpy().astype(np.float64)


def photograph(env: BaseEnv, sensor: str) -> Observation:
    """The current image of the camera called ``sensor``."""
    camera = _captured(env, sensor)
    images = camera.get_obs(rgb=True, depth=True, position=False, segmentation=False)
    parameters = camera.get_params()
    world_to_camera = parameters["extrinsic_cv"][0].cpu().numpy().astype(np.float64)
    intrinsics = parameters["intrinsic_cv"][0].cpu().numpy().astype(np.float64)
    intrinsics[:2, 2] -= 0.5  # SAPIEN counts pixels from their corners, OpenCV from their centres
    depth_mm = images["depth"][0, ..., 0].cpu().numpy()
    return Observation(
        rgb=images["rgb"][0].cpu().numpy().astype(np.uint8),
        depth=depth_mm.astype(np.float32) / 1000.0,
        intrinsics=intrinsics,
        camera_pose=invert_pose(make_pose(world_to_camera[:3, :3], world_to_camera[:3, 3])),
    )


def scene_truth(env: BaseEnv, sensor: str) -> SceneTruth:
    """Ground truth of each pixel of the camera called ``sensor``."""
    labels = _captured(env, sensor).get_obs(rgb=False, depth=False, position=False, segmentation=True)["segmentation"]
    seen = labels[0, ..., 0].cpu().numpy()
    entities = {actor._objs[0].per_scene_id: actor for actor in env.scene.actors.values()}
    for articulation in env.scene.articulations.values():
        entities |= {link._objs[0].entity.per_scene_id: link for link in articulation.links}
    poses = [matrix(entity.pose) for entity in entities.values()]
    parts = np.full(seen.shape, -1)
    for index, identity in enumerate(entities):
        parts[seen == identity] = index
    names = tuple(entity.name for entity in entities.values())
    return SceneTruth(parts, names, np.array(poses))


def _captured(env: BaseEnv, sensor: str) -> Any:
    """The camera called ``sensor``, with a new picture."""
    camera = env._sensors[sensor]
    env.scene.update_render(update_sensors=True, update_human_render_cameras=False)
    camera.capture()
    return camera
