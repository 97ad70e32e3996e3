"""Forward and inverse kinematics of the arm, by mink on the MuJoCo model of the same URDF."""

from __future__ import annotations

from dataclasses import dataclass

import mink
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from robust_instant_policy.geometry import FloatArray, invert_pose, make_pose
from robust_instant_policy.tasks.maniskill.robot import ARM_JOINTS, TOOL_LINK, URDF_PATH

MAX_ITERATIONS = 30  # per pose; along a path two or three are enough
CONVERGED_M = 1e-4
CONVERGED_RAD = 1e-3
LEVENBERG_MARQUARDT = 1e-4  # keeps steps bounded near singular poses
DAMPING = 1e-6
ORIENTATION_COST = 0.3  # metres per radian: about the hand's own length


@dataclass(frozen=True, eq=False)
class JointPath:
    """Joint angles ``(N, 6)`` rad with what they miss: ``position_error (N,)`` m, ``rotation_error (N,)`` rad."""

    joints: FloatArray
    position_error: FloatArray
    rotation_error: FloatArray


class Kinematics:
    """The arm standing at ``base_position (3,)`` metres, its base unturned."""

    def __init__(self, base_position: ArrayLike):
        spec = mujoco.MjSpec.from_file(str(URDF_PATH))
        spec.compiler.fusestatic = False  # the tool frame is a link of its own
        self._configuration = mink.Configuration(spec.compile())
        self._task = mink.FrameTask(
            TOOL_LINK,
            "body",
            position_cost=1.0,
            orientation_cost=ORIENTATION_COST,
            lm_damping=LEVENBERG_MARQUARDT,
        )
        self._limits = [mink.ConfigurationLimit(self._configuration.model)]
        self._base = make_pose(np.eye(3), base_position)

    def tool_pose(self, joints: ArrayLike) -> FloatArray:
        """Tool pose ``(4, 4)`` in the world at ``joints (6,)``."""
        self._place(joints)
        return self._base @ self._configuration.get_transform_frame_to_world(TOOL_LINK, "body").as_matrix()

    def follow(self, poses: ArrayLike, start: ArrayLike) -> JointPath:
        """Joint angles along tool ``poses (N, 4, 4)``, each solved from the one before, the first from ``start``."""
        poses = np.asarray(poses, dtype=np.float64)
        self._place(start)
        local = invert_pose(self._base) @ poses
        joints = np.empty((len(poses), len(ARM_JOINTS)))
        errors = np.empty((len(poses), 2))
        for step, pose in enumerate(local):
            self._task.set_target(mink.SE3.from_matrix(pose))
            errors[step] = self._solve()
            joints[step] = self._configuration.q[: len(ARM_JOINTS)]
        return JointPath(joints, errors[:, 0], errors[:, 1])

    def _place(self, joints: ArrayLike) -> None:
        q = np.zeros(self._configuration.model.nq)
        q[: len(ARM_JOINTS)] = joints
        self._configuration.update(q)

    def _solve(self) -> tuple[float, float]:
        for iteration in range(MAX_ITERATIONS + 1):
            error = self._task.compute_error(self._configuration)
            position, rotation = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
            if (position < CONVERGED_M and rotation < CONVERGED_RAD) or iteration == MAX_ITERATIONS:
                break
            velocity = mink.solve_ik(
                self._configuration, [self._task], 1.0, "daqp", damping=DAMPING, limits=self._limits
            )
            self._configuration.integrate_inplace(velocity, 1.0)
        return position, rotation
