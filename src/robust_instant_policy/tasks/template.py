"""A task of your own: change the scene, the robot and the goal; keep the shapes and units (docs/own-tasks.md)."""

import numpy as np

from robust_instant_policy import Demonstration, GripperTriangle, Observation, Trajectory
from robust_instant_policy.geometry import lift, make_pose
from robust_instant_policy.tasks import Attempt, Execution, SceneTruth

SIDE, HEIGHT_M = 160, 0.8  # of the image, in pixels, and of the camera above the table
INTRINSICS = np.array([[200.0, 0.0, 79.5], [0.0, 200.0, 79.5], [0.0, 0.0, 1.0]])  # focal length and centre, pixels
DOWN = np.diag([1.0, -1.0, -1.0])  # x right, y away from the image's top, z towards the table
CAMERA = make_pose(DOWN, [0.0, 0.0, HEIGHT_M])  # camera to world, OpenCV axes
GRIPPER = GripperTriangle(length=0.10, opening=0.08)  # flange to fingertips, between the open fingertips; metres
PARTS = {"base": (0.04, 0.05, (60, 90, 200)), "block": (0.02, 0.04, (200, 60, 50))}  # half width, height, colour


class PlaceBlock:
    """Put the red block onto the blue base."""

    record_hz = 10.0
    workspace = np.array([[-0.3, -0.3, -0.05], [0.3, 0.3, 0.4]])

    def reset(self, seed: int) -> Observation:
        """The scene of ``seed`` and its image."""
        sides, along = np.array([-0.14, 0.14]), np.random.default_rng(seed).uniform(-0.12, 0.12, (2, 2))
        self.places = {
            name: np.array([side + x / 2, y]) for name, side, (x, y) in zip(PARTS, sides, along, strict=True)
        }
        pixels = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), axis=-1)
        rgb, depth = np.full((SIDE, SIDE, 3), 190, np.uint8), np.full((SIDE, SIDE), HEIGHT_M, np.float32)
        self.parts = np.full((SIDE, SIDE), -1)
        for number, (name, (half, height, colour)) in enumerate(PARTS.items()):
            points = lift(pixels, HEIGHT_M - height, INTRINSICS, CAMERA)[..., :2]
            seen = (np.abs(points - self.places[name]) < half).all(axis=-1)
            rgb[seen], depth[seen], self.parts[seen] = colour, HEIGHT_M - height, number
        return Observation(rgb, depth, INTRINSICS, CAMERA)

    def execute(self, trajectory: Trajectory, on_frame=None) -> Execution:
        """Move through the waypoints from the scene as `reset` drew it: here, a held block follows the fingertips."""
        block, was_closed, held = np.append(self.places["block"], 0.02), False, False
        poses, states = GRIPPER.poses(trajectory.triplets[:, 0]), trajectory.gripper_state[:, 0] > 0.5
        for tips, closed in zip(poses[:, :3, 3], states.tolist(), strict=True):
            grasped = not was_closed and bool(np.linalg.norm(tips - block) < 0.02)
            was_closed, held = closed, closed and (held or grasped)
            block = tips if held else block
        off = float(np.linalg.norm(block[:2] - self.places["base"]))
        failure = "the block is held" if held else f"the block is {off * 1e3:.0f} mm off" if off > 0.03 else ""
        return Execution(not failure, failure, seconds=len(trajectory) / self.record_hz)

    def demonstrate(self, seed: int) -> Attempt:
        """Optional: a demonstration of the scene of ``seed``, for `rip record` and `rip eval`."""
        observation = self.reset(seed)
        block, base = self.places["block"], self.places["base"]
        stops = [(0, -0.25, 0.3, 0), (*block, 0.15, 0), (*block, 0.02, 0), (*block, 0.02, 1)]  # x, y, z, closed
        stops += [(*block, 0.15, 1), (*base, 0.15, 1), (*base, 0.07, 1), (*base, 0.07, 0), (*base, 0.15, 0)]
        corners, closed = np.split(np.array(stops), [3], axis=1)
        at = np.linspace(0, len(stops) - 1, 6 * len(stops))
        path = np.stack([np.interp(at, np.arange(len(stops)), axis) for axis in corners.T], axis=1)
        trajectory = Trajectory.from_poses(
            [make_pose(DOWN, point) for point in path], closed[at.astype(int), 0], GRIPPER
        )
        execution = self.execute(trajectory)
        return Attempt(Demonstration(observation, trajectory, self.record_hz), execution.success, execution.failure)

    def scene_truth(self) -> SceneTruth:
        """Optional: what the pixels show, to measure the errors of keypoints."""
        poses = [make_pose(np.eye(3), np.append(self.places[name], 0.0)) for name in PARTS]
        return SceneTruth(self.parts, tuple(PARTS), np.array(poses))
