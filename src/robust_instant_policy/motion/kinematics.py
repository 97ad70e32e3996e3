"""Forward and inverse kinematics of an arm, by mink on its MuJoCo model."""

from dataclasses import dataclass
from typing import Literal

import mink
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from robust_instant_policy.geometry import FloatArray, invert_pose, make_pose

MAX_ITERATIONS = 30  # per pose; two or three suffice along a path
CONVERGED_M = 1e-4
CONVERGED_RAD = 1e-3
LEVENBERG_MARQUARDT = 1e-4  # bounds the steps near singular poses
DAMPING = 1e-6
ORIENTATION_COST = 0.3  # metres per radian, about the length of the gripper


@dataclass(frozen=True, eq=False)
class JointPath:
    """Joint angles ``(N, J)`` rad and their tool errors: ``position_error (N,)`` m, ``rotation_error (N,)`` rad."""

    joints: FloatArray
    position_error: FloatArray
    rotation_error: FloatArray


class Kinematics:
    """An arm whose first ``num_joints`` joints, in the order of ``model``, move the frame ``tool``.

    ``tool`` names a ``kind`` ("body" or "site") of the model; ``base (4, 4)`` is the pose of the model's origin in
    the world. ``orientation_cost``, metres per radian, weighs orientation against position errors. A
    ``posture_cost``, in the same unit, penalises joint motion: near a singular pose the tool then has a small
    orientation error instead of a large joint motion.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        tool: str,
        kind: Literal["body", "site"],
        num_joints: int,
        base: ArrayLike,
        posture_cost: float = 0.0,
        orientation_cost: float = ORIENTATION_COST,
    ):
        self.model, self.base = model, np.asarray(base, dtype=np.float64)
        self._configuration = mink.Configuration(model)
        self._tool, self._kind, self.num_joints = tool, kind, num_joints
        self._task = mink.FrameTask(
            tool, kind, position_cost=1.0, orientation_cost=orientation_cost, lm_damping=LEVENBERG_MARQUARDT
        )
        self._posture = mink.PostureTask(model, cost=posture_cost)
        self._tasks = [self._task, self._posture] if posture_cost else [self._task]
        self._limits = [mink.ConfigurationLimit(model)]

    @property
    def joint_range(self) -> FloatArray:
        """Lowest and highest angle ``(J, 2)`` of each joint, rad; infinite for one that turns without end."""
        limited = self.model.jnt_limited[: self.num_joints, None].astype(bool)
        return np.where(limited, self.model.jnt_range[: self.num_joints], [-np.inf, np.inf])

    def tool_pose(self, joints: ArrayLike) -> FloatArray:
        """Tool pose ``(4, 4)`` in the world at ``joints (J,)``."""
        self._place(joints)
        return self.base @ self._configuration.get_transform_frame_to_world(self._tool, self._kind).as_matrix()

    def body_poses(self, joints: ArrayLike) -> dict[str, FloatArray]:
        """Pose ``(4, 4)`` in the world of each body of the model, by name, at ``joints (J,)``."""
        self._place(joints)
        data = self._configuration.data
        poses = self.base @ make_pose(data.xmat.reshape(-1, 3, 3), data.xpos)
        return {self.model.body(body).name: poses[body] for body in range(1, len(poses))}

    def follow(self, poses: ArrayLike, start: ArrayLike) -> JointPath:
        """Joint angles along tool ``poses (N, 4, 4)``, each solved from the previous one, the first from ``start``."""
        poses = np.asarray(poses, dtype=np.float64)
        self._place(start)
        local = invert_pose(self.base) @ poses
        joints = np.empty((len(poses), self.num_joints))
        errors = np.empty((len(poses), 2))
        for step, pose in enumerate(local):
            self._task.set_target(mink.SE3.from_matrix(pose))
            self._posture.set_target(self._configuration.q)
            errors[step] = self._solve()
            joints[step] = self._configuration.q[: self.num_joints]
        return JointPath(joints, errors[:, 0], errors[:, 1])

    def _place(self, joints: ArrayLike) -> None:
        q = np.zeros(self._configuration.model.nq)
        q[: self.num_joints] = joints
        self._configuration.update(q)

    def _solve(self) -> tuple[float, float]:
        for iteration in range(MAX_ITERATIONS + 1):
            error = self._task.compute_error(self._configuration)
            position, rotation = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
            if (position < CONVERGED_M and rotation < CONVERGED_RAD) or iteration == MAX_ITERATIONS:
                break
            velocity = mink.solve_ik(
                self._configuration, self._tasks, 1.0, "daqp", damping=DAMPING, limits=self._limits
            )
            self._configuration.integrate_inplace(velocity, 1.0)
        return position, rotation
