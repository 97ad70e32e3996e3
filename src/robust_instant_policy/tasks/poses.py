"""Tool poses for experts."""

import numpy as np
from scipy.spatial.transform import Rotation

from robust_instant_policy.geometry import FloatArray, make_pose


def downward(x: float, y: float, z: float, yaw: float = 0.0) -> FloatArray:
    """Tool at ``(x, y, z)`` m pointing straight down; at ``yaw`` 0 rad the fingers open along the world's y."""
    rotation = Rotation.from_euler("z", yaw).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    return make_pose(rotation, (x, y, z))


def facing(x: float, y: float, yaw: float) -> FloatArray:
    """Frame on the table at ``(x, y)`` m, rotated by ``yaw`` rad; at 0 its -x axis points to the robot."""
    return make_pose(Rotation.from_euler("z", yaw).as_matrix(), (x, y, 0.0))


def pitched(pitch: float, yaw: float) -> FloatArray:
    """Rotation ``(3, 3)`` of a tool whose approach is raised by ``pitch`` rad from straight down towards ``yaw`` rad.

    At ``pitch`` pi/2 it points horizontally in the direction ``yaw``; the fingers open horizontally.
    """
    down = downward(0.0, 0.0, 0.0)[:3, :3]
    return Rotation.from_euler("z", yaw).as_matrix() @ Rotation.from_euler("y", -pitch).as_matrix() @ down
