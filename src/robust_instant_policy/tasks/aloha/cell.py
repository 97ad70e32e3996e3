"""The cell of the ALOHA tasks: a table between two arms, a depth camera above it, and a camera for videos.

The world's origin lies on the table, midway between the arms; x points from the left arm to the right one; z is up. The
image's top points along +x.
"""

from typing import Any, ClassVar

import gymnasium
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray, make_pose
from robust_instant_policy.tasks.aloha.renderer import require_renderer
from robust_instant_policy.tasks.aloha.robot import (
    ARM_JOINTS,
    ARMS,
    BASE_X_M,
    CLOSED_M,
    FINGER_TRAVEL_M,
    FINGERS,
    GRIP_FORCE_N,
    HOME_JOINTS,
    PARKED_JOINTS,
    TOOL,
    two_arms,
)
from robust_instant_policy.tasks.aloha.surfaces import (
    SOLID_GROUP,
    add_solid,
    add_surface,
    box_surface,
    fixed_body,
    free_body,
    paint,
    revolved,
    tube,
)
from robust_instant_policy.tasks.level import PAPER, Distractor, Furnishing, Layout, Level, Region, Rod
from robust_instant_policy.tasks.mujoco_images import MujocoImages, pinhole
from robust_instant_policy.tasks.scene_truth import SceneTruth
from robust_instant_policy.tasks.textures import laminate, wood

CONTROL_HZ = 50.0  # ALOHA's own
TIMESTEP_S = 0.002
SETTLE_SECONDS = 0.4  # for objects to come to rest before the image

# Intel RealSense D415 at 640x480: the sides of the 65 x 40 degrees are cropped, the height is kept.
CAMERA_HEIGHT_M = 0.85
CAMERA_X_M = -0.05
CAMERA_SIZE = CAMERA_WIDTH, CAMERA_HEIGHT = (640, 480)
CAMERA_FOV_DEG = 40.0  # vertical
DEPTH_UNIT_M = 0.001
VIDEO_SIZE = VIDEO_WIDTH, VIDEO_HEIGHT = (480, 360)

TABLE_SIZE_M = (1.22, 0.76, 0.04)  # the table top of gym-aloha
TABLE_FRICTION = 0.6
NEAR_M, FAR_M = 0.05, 5.0

STILL_RAD_S = 0.2  # joint speed below which an arm is at rest, as in the tasks of the other cell
STILL_M_S = 0.02  # and an object
HELD_N = 0.5  # force of each finger from which something is held

WORKSPACE = np.array([[-0.30, -0.32, -0.005], [0.22, 0.32, 0.4]])
REGION = Region((-BASE_X_M, 0.0), nearest=0.22, farthest=0.56, view=((-0.28, -0.28), (0.18, 0.28)))
LAMPS = (((-0.15, 0.6, -1.0), 0.55, True), ((-0.3, -0.5, -1.0), 0.25, False))  # direction, intensity, shadow
DISTRACTOR_DENSITY = 600.0  # kg/m³, wood


class AlohaEnv(gymnasium.Env):
    """Base of the five environments; a subclass adds its objects and its condition of success.

    ``end_effectors`` are the working arms; the others are parked. ``beside`` is position and target of the camera for
    videos. Actions are, for each arm, the six joint angles (rad) and the travel of each finger
    (m, 0 closed), at `CONTROL_HZ`. Observations are the same quantities as measured, ``joints``, and with
    ``obs_mode="rgbd"`` the camera's ``rgb`` and ``depth`` (metres). The reward is 1 if the task is done.
    ``objects`` and ``level`` as in `tasks.make_task`.
    """

    end_effectors: ClassVar[tuple[str, ...]] = ("left",)
    beside: ClassVar[tuple[tuple[float, float, float], ...]] = ((-0.10, -0.80, 0.50), (-0.18, 0.0, 0.12))
    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": int(CONTROL_HZ)}

    def __init__(
        self,
        objects: str = "seen",
        obs_mode: str = "rgbd",
        render_mode: str | None = None,
        level: Level = PAPER,
    ):
        require_renderer()
        self.objects, self.obs_mode, self.render_mode, self.level = objects, obs_mode, render_mode, level
        travel = [0.0], [FINGER_TRAVEL_M]
        ranges = _joint_ranges()
        bounds = (np.concatenate([ranges[:, i], travel[i]]).astype(np.float32) for i in (0, 1))
        low, high = (np.tile(bound, len(self.end_effectors)) for bound in bounds)
        self.action_space = gymnasium.spaces.Box(low, high)
        unbounded = gymnasium.spaces.Box(-np.inf, np.inf, (len(low),))
        seen: dict[str, gymnasium.Space] = {"joints": unbounded}
        if obs_mode == "rgbd":
            shape = (CAMERA_HEIGHT, CAMERA_WIDTH)
            seen["rgb"] = gymnasium.spaces.Box(0, 255, (*shape, 3), np.uint8)
            seen["depth"] = gymnasium.spaces.Box(0.0, FAR_M, shape, np.float32)
        self.observation_space = gymnasium.spaces.Dict(seen)
        self._seed = 0

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the episode's objects, drawn from `draw` and placed by `Layout.place`, to ``spec``."""
        raise NotImplementedError

    def home(self, usual: FloatArray) -> FloatArray:
        """Start pose ``(A, J)`` of the episode, rad."""
        return self.layout.home(usual)

    def failure(self) -> str:
        """Reason why the task is not done; empty if it is done."""
        raise NotImplementedError

    def draw(self, what: str) -> np.random.Generator:
        """Random generator of the episode for ``what`` ("shape", "pose"), determined by the seed."""
        return np.random.default_rng([self._seed, *what.encode()])

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        super().reset(seed=seed)
        self._seed = int(self.np_random.integers(2**31)) if seed is None else seed
        self.close()
        self.layout = Layout(self.level, self._seed, REGION)
        spec = two_arms()
        _furnish(spec, self.layout.furnishing())
        add_side_camera(spec.worldbody, *self.beside)
        self.build(spec)
        for index, distractor in enumerate(self.layout.distractors()):
            _add_distractor(spec, distractor, f"distractor-{index}")
        rod = self.layout.rod((CAMERA_X_M, 0.0, CAMERA_HEIGHT_M))
        if rod is not None:
            _add_rod(spec, rod)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._images = MujocoImages(self.model, self.data)
        home = dict(
            zip(self.end_effectors, self.layout.home(np.array([HOME_JOINTS] * len(self.end_effectors))), strict=True)
        )
        for side, arm in ARMS.items():
            works = side in self.end_effectors
            joints, travel = (home[side], FINGER_TRAVEL_M) if works else (PARKED_JOINTS, 0.0)
            for joint, angle in zip(ARM_JOINTS, joints, strict=True):
                self.data.joint(f"{arm}/{joint}").qpos = angle
                self.data.actuator(f"{arm}/{joint}").ctrl = angle
            for finger, sign in zip(FINGERS, (1, -1), strict=True):
                self.data.joint(f"{arm}/{finger}").qpos = sign * (CLOSED_M + travel)
            self.data.actuator(f"{arm}/{FINGERS[0]}").ctrl = CLOSED_M + travel
        mujoco.mj_step(self.model, self.data, round(SETTLE_SECONDS / TIMESTEP_S))
        mujoco.mj_forward(self.model, self.data)
        self._joints_before = self.measured()
        return self._observation(), {}

    def step(self, action: FloatArray) -> tuple[dict, float, bool, bool, dict]:
        self.advance(np.asarray(action, dtype=np.float64))
        failure = self.failure()
        return self._observation(), float(not failure), False, False, {"success": not failure, "failure": failure}

    def advance(self, command: FloatArray) -> None:
        """One control step, with joint angles and finger travel ``(7·A,)`` commanded, without evaluation."""
        self._joints_before = self.measured()
        for side, (*angles, travel) in zip(self.end_effectors, command.reshape(-1, len(ARM_JOINTS) + 1), strict=True):
            for joint, angle in zip(ARM_JOINTS, angles, strict=True):
                self.data.actuator(f"{ARMS[side]}/{joint}").ctrl = angle
            self.data.actuator(f"{ARMS[side]}/{FINGERS[0]}").ctrl = CLOSED_M + travel
        mujoco.mj_step(self.model, self.data, round(1 / CONTROL_HZ / TIMESTEP_S))

    def photograph(self) -> Observation:
        """The current image of the camera above the table."""
        depth = self._images.depth("top", CAMERA_SIZE)
        axes = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])
        return Observation(
            rgb=self._images.rgb("top", CAMERA_SIZE),
            depth=(np.rint(depth.astype(np.float64) / DEPTH_UNIT_M) * DEPTH_UNIT_M).astype(np.float32),
            intrinsics=pinhole(CAMERA_SIZE, CAMERA_FOV_DEG),
            camera_pose=make_pose(axes.T, (CAMERA_X_M, 0.0, CAMERA_HEIGHT_M)),
        )

    def scene_truth(self) -> SceneTruth:
        """Ground truth of each pixel of the top view."""
        seen = self._images.segmentation("top", CAMERA_SIZE)
        parts = np.full(seen.shape[:2], -1)
        geoms = seen[..., 1] == mujoco.mjtObj.mjOBJ_GEOM
        parts[geoms] = self.model.geom_bodyid[seen[..., 0][geoms]]
        names = tuple(self.model.body(body).name for body in range(self.model.nbody))
        return SceneTruth(parts, names, make_pose(self.data.xmat.reshape(-1, 3, 3), self.data.xpos))

    def video_frame(self) -> np.ndarray:
        """RGB frame ``(H, W, 3)`` uint8 of the camera beside the table."""
        return self._images.rgb("side", VIDEO_SIZE)

    def render(self) -> np.ndarray | None:
        return self.video_frame() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        if hasattr(self, "_images"):
            self._images.close()

    def tool_poses(self) -> FloatArray:
        """Poses of the working arms' tool frames, ``(A, 4, 4)``."""
        tools = [self.data.site(f"{ARMS[side]}/{TOOL}") for side in self.end_effectors]
        return np.stack([make_pose(tool.xmat.reshape(3, 3), tool.xpos) for tool in tools])

    def pose_of(self, body: str) -> FloatArray:
        """Pose of a body, ``(4, 4)``."""
        place = self.data.body(body)
        return make_pose(place.xmat.reshape(3, 3), place.xpos)

    def arm_is_still(self) -> bool:
        """Whether no joint of a working arm moved faster than `STILL_RAD_S` over the last control step."""
        moved = np.abs(self.measured() - self._joints_before).reshape(-1, len(ARM_JOINTS) + 1)[:, : len(ARM_JOINTS)]
        return bool(moved.max() * CONTROL_HZ <= STILL_RAD_S)

    def is_still(self, body: str) -> bool:
        """Whether a body is not faster than `STILL_M_S`."""
        return bool(np.linalg.norm(self.data.joint(body).qvel[:3]) <= STILL_M_S)

    def touch(self, body: str, other: str) -> float:
        """Force, in N, with which two bodies press on each other."""
        wanted = sorted((self.model.body(body).id, self.model.body(other).id))
        touching = np.sort(self.model.geom_bodyid[self.data.contact.geom], axis=1)
        total, force = 0.0, np.zeros(6)
        for index in np.flatnonzero((touching == wanted).all(axis=1)):
            mujoco.mj_contactForce(self.model, self.data, index, force)
            total += float(force[0])
        return total

    def is_held(self, body: str, side: str = "left") -> bool:
        """Whether both fingers of the arm on a ``side`` press on a body."""
        return all(self.touch(body, f"{ARMS[side]}/{finger}_link") > HELD_N for finger in FINGERS)

    def grip_loads(self) -> FloatArray:
        """Force of each working gripper as a share of its limit, ``(A,)``."""
        forces = [self.data.actuator(f"{ARMS[side]}/{FINGERS[0]}").force[0] for side in self.end_effectors]
        return np.abs(forces) / (2 * GRIP_FORCE_N)

    def measured(self) -> FloatArray:
        """Joint angles and finger travel of the working arms, in the order of commands ``(7·A,)``."""
        reached: list[float] = []
        for side in self.end_effectors:
            reached += [self.data.joint(f"{ARMS[side]}/{joint}").qpos[0] for joint in ARM_JOINTS]
            reached.append(self.data.joint(f"{ARMS[side]}/{FINGERS[0]}").qpos[0] - CLOSED_M)
        return np.array(reached)

    def _observation(self) -> dict[str, np.ndarray]:
        seen: dict[str, np.ndarray] = {"joints": self.measured().astype(np.float32)}
        if self.obs_mode == "rgbd":
            photograph = self.photograph()
            seen |= {"rgb": photograph.rgb, "depth": photograph.depth}
        return seen


def _joint_ranges() -> FloatArray:
    model = two_arms().compile()
    return np.array([model.joint(f"{ARMS['left']}/{joint}").range for joint in ARM_JOINTS])


def _furnish(spec: mujoco.MjSpec, furnishing: Furnishing | None) -> None:
    """Physics, table, light and cameras; None for the usual furnishing."""
    option = spec.option
    option.timestep, option.integrator = TIMESTEP_S, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone, option.noslip_iterations, option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 3, 10.0
    spec.stat.extent, spec.stat.center = 1.0, [0, 0, 0]
    visual = spec.visual
    visual.map.znear, visual.map.zfar = NEAR_M, FAR_M
    visual.quality.shadowsize, visual.quality.offsamples = 2048, 4
    getattr(visual, "global").offwidth = max(CAMERA_WIDTH, VIDEO_WIDTH)
    getattr(visual, "global").offheight = max(CAMERA_HEIGHT, VIDEO_HEIGHT)
    visual.headlight.active = 0

    world = spec.worldbody
    world.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[2, 2, 0.1],
        friction=[TABLE_FRICTION, 5e-3, 2e-4],
        condim=6,
        group=SOLID_GROUP,
    )
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.86, 0.88, 0.90],
        rgb2=[0.62, 0.64, 0.66],
        width=64,
        height=384,
    )
    top = world.add_body(name="table-top", pos=[0, 0, -TABLE_SIZE_M[2] / 2])
    material, brightness = laminate(np.random.default_rng(0)), np.ones(3)
    if furnishing is not None:
        grain, brightness = furnishing.grain, furnishing.brightness
        material = wood(furnishing.table, np.random.default_rng(0)) if grain else paint(furnishing.table)
    add_surface(spec, top, "table-top", box_surface(TABLE_SIZE_M), material, shine=0.05)
    for direction, diffuse, shadow in LAMPS:
        rotated = direction if furnishing is None else furnishing.direction(direction)
        world.add_light(
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            dir=rotated,
            pos=[-1.5 * part for part in rotated],
            diffuse=diffuse * brightness,
            specular=[0.1] * 3,
            ambient=0.2 * brightness,
            castshadow=shadow,
        )
    camera = world.add_camera(name="top", pos=[CAMERA_X_M, 0, CAMERA_HEIGHT_M], fovy=CAMERA_FOV_DEG)
    camera.quat = [np.sqrt(0.5), 0, 0, -np.sqrt(0.5)]


def _add_distractor(spec: mujoco.MjSpec, distractor: Distractor, name: str) -> None:
    body = free_body(spec, name, distractor.pose)
    width, height = distractor.width, distractor.height
    half: tuple[float, ...]
    if distractor.kind == "box":
        kind, half, volume = mujoco.mjtGeom.mjGEOM_BOX, (width / 2, width / 2, height / 2), width**2 * height
        surface = box_surface((width, width, height))
    else:
        kind, half, volume = mujoco.mjtGeom.mjGEOM_CYLINDER, (width / 2, height / 2), np.pi / 4 * width**2 * height
        low, high = -height / 2, height / 2
        surface = revolved([(0.0, low), (width / 2, low), (width / 2, high), (0.0, high)])
    add_surface(spec, body, name, surface, paint(distractor.color))
    add_solid(body, kind, half, mass=DISTRACTOR_DENSITY * volume)


def _add_rod(spec: mujoco.MjSpec, rod: Rod) -> None:
    points = np.linspace(rod.start, rod.stop, 3)
    add_surface(spec, fixed_body(spec, "rod", np.eye(4)), "rod", tube(points, rod.radius), paint((0.08, 0.08, 0.09)))


def add_side_camera(world: Any, eye: ArrayLike, target: ArrayLike) -> None:
    """A camera at ``eye (3,)`` that looks at ``target (3,)``, upright."""
    back = np.subtract(eye, target)
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.stack([right, np.cross(back, right), back], axis=1).ravel())
    world.add_camera(name="side", pos=eye, quat=quaternion, fovy=48.0)
