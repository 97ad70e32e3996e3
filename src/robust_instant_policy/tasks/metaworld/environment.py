"""One of Meta-World's environments: its scenes by seed, a depth camera, and where its hand is.

The package pins an older MuJoCo, whose rows of ``eq_data`` are shorter; one method is replaced for the newer ones.
"""

import warnings
from typing import Any

import mujoco
import numpy as np
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from metaworld.policies import ENV_POLICY_MAP
from metaworld.sawyer_xyz_env import SawyerMocapBase

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray, make_pose
from robust_instant_policy.tasks.mujoco_images import MujocoImages, pinhole
from robust_instant_policy.tasks.scene_truth import SceneTruth
from robust_instant_policy.tasks.task import Image

WELD = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 5.0)  # Meta-World's own parameters
CONTROL_HZ = 80.0
HORIZON = 500  # control steps of an episode, Meta-World's own
STEP_M = 0.01  # by which an action of 1 moves the mocap body
SIZE_PX = (384, 256)
LOOK_AT_M, DISTANCE_M = (0.0, 0.68, 0.05), 1.05  # above and behind the robot's base, which is at the origin
ELEVATION_DEG = -50.0
FILM_CAMERA, FILM_PX = "corner3", (320, 320)
HIDDEN_GROUP = 5  # of the robot's shapes, which the depth camera does not see


def _reset_mocap_welds(self: Any) -> None:
    """`SawyerMocapBase.reset_mocap_welds` for rows of any length."""
    for row in np.flatnonzero(self.model.eq_type == mujoco.mjtEq.mjEQ_WELD):
        self.model.eq_data[row, : len(WELD)] = WELD


SawyerMocapBase.reset_mocap_welds = _reset_mocap_welds


class Environment:
    """The task ``name``, such as "reach", with its goal in the observations of the expert."""

    def __init__(self, name: str):
        self.env = ALL_V3_ENVIRONMENTS[f"{name}-v3"]()
        self._policy = ENV_POLICY_MAP[f"{name}-v3"]
        self.env._set_task_called, self.env._partially_observable = True, False
        self.env.__dict__.pop("sawyer_observation_space", None)  # computed for hidden goals
        self.model, self.data = self.env.model, self.env.data
        base = self.model.body("base").id
        self.model.geom_group[self.model.body_rootid[self.model.geom_bodyid] == base] = HIDDEN_GROUP
        self.model.site_group[self.model.body_rootid[self.model.site_bodyid] == base] = HIDDEN_GROUP
        self._images = MujocoImages(self.model, self.data)
        self._seen: FloatArray = np.zeros(0)  # the expert's observation

    def reset(self, seed: int) -> None:
        """Draw the positions of objects and goal for ``seed``, as the benchmark draws them."""
        env = self.env
        env.seeded_rand_vec, env._freeze_rand_vec = True, False
        env.seed(seed)
        env.reset()
        env._freeze_rand_vec = True  # a reset draws twice; the benchmark keeps the second
        self._seen = env.reset()[0]
        mujoco.mj_forward(self.model, self.data)
        self.success, self.steps = False, 0
        self.expert = self._policy()

    def step(self, shift: FloatArray, grip: float) -> None:
        """Move the mocap body by ``shift (3,)``, metres, at most `STEP_M` an axis, with gripper effort in [-1, 1]."""
        action = np.append(np.clip(np.asarray(shift) / STEP_M, -1, 1), grip).astype(np.float32)
        self._seen, _, _, _, info = self.env.step(action)
        self.steps += 1
        self.success = self.success or bool(info["success"])

    def step_expert(self) -> None:
        """One step of the scripted expert of the package."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that it asks for more than an action can do
            action = self.expert.get_action(self._seen)
        self.step(action[:3] * STEP_M, float(np.clip(action[3], -1, 1)))

    @property
    def over(self) -> bool:
        return self.steps >= HORIZON

    @property
    def hand(self) -> FloatArray:
        """Position ``(3,)`` of the hand, metres."""
        return self.data.body("hand").xpos.copy()

    @property
    def opening(self) -> float:
        """Distance between the fingers, metres."""
        return float(np.linalg.norm(self.data.body("rightclaw").xpos - self.data.body("leftclaw").xpos))

    def photograph(self) -> Observation:
        """What the depth camera sees; the robot is not drawn."""
        self._place_goals()
        rgb, depth = self._images.rgb(_camera(), SIZE_PX), self._images.depth(_camera(), SIZE_PX)
        return Observation(rgb, depth, pinhole(SIZE_PX, self.model.vis.global_.fovy), _camera_pose())

    def scene_truth(self) -> SceneTruth:
        """Bodies and goal sites at the pixels of the camera, and their poses."""
        self._place_goals()
        seen, kind = np.moveaxis(self._images.segmentation(_camera(), SIZE_PX), -1, 0)
        model, data = self.model, self.data
        parts = np.full(seen.shape, -1)
        geoms, sites = kind == mujoco.mjtObj.mjOBJ_GEOM, kind == mujoco.mjtObj.mjOBJ_SITE
        parts[geoms] = model.geom_bodyid[seen[geoms]]
        parts[sites] = model.nbody + seen[sites]
        names = [model.body(i).name for i in range(model.nbody)] + [
            f"site {model.site(i).name}" for i in range(model.nsite)
        ]
        turned = np.concatenate([data.xmat, data.site_xmat]).reshape(-1, 3, 3)
        return SceneTruth(parts, tuple(names), make_pose(turned, np.concatenate([data.xpos, data.site_xpos])))

    def video_frame(self) -> Image:
        """A frame of one of the benchmark's own cameras, with the robot."""
        self._place_goals()
        options = mujoco.MjvOption()
        options.geomgroup[HIDDEN_GROUP] = 1
        return self._images.rgb(FILM_CAMERA, FILM_PX, options)

    def close(self) -> None:
        self._images.close()
        self.env.close()

    def _place_goals(self) -> None:
        """Goals without a body are sites, which the benchmark puts where they belong after every step.

        Only in pick-out-of-hole it puts its one site elsewhere: at the object, so that nothing shows the goal.
        """
        sites, target = self.env._target_site_config, self.env._target_pos
        if sites and not any(np.allclose(place, target) for _, place in sites):
            sites = [(sites[0][0], target)]
        for site, place in sites:
            self.env._set_pos_site(site, place)


def _camera() -> mujoco.MjvCamera:
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat[:], camera.distance = LOOK_AT_M, DISTANCE_M
    camera.azimuth, camera.elevation = 90.0, ELEVATION_DEG
    return camera


def _camera_pose() -> FloatArray:
    """Camera to world ``(4, 4)``, OpenCV axes, of `_camera`, which looks along +y and down."""
    down = np.deg2rad(-ELEVATION_DEG)
    forward = np.array([0.0, np.cos(down), -np.sin(down)])
    right = np.array([1.0, 0.0, 0.0])
    axes = np.stack([right, np.cross(forward, right), forward], axis=1)
    return make_pose(axes, np.array(LOOK_AT_M) - DISTANCE_M * forward)
