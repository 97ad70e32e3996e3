"""The 3-D scene of the page: bodies, grippers' handles, and what the camera saw."""

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray, make_pose
from robust_instant_policy.studio import drawing
from robust_instant_policy.studio.cell import Cell, Surface

GIZMO_M = 0.2
NEAR_M, FAR_M = 0.1, 20.0
MOVED = 1e-4  # entries of a pose that change by less are not sent
EYE, LOOK_AT = (-0.02, -0.88, 0.6), (-0.08, 0.04, 0.14)  # of a new browser, m
POINT_M = 0.003
REFUSED = (214, 40, 57)


class Stage:
    """Draws a cell in ``server``'s scene."""

    def __init__(self, server: viser.ViserServer):
        self.scene = server.scene
        self._server = server
        self._bodies: dict[str, tuple[str, Any]] = {}  # digest of its surfaces, and handle
        self._shown: dict[str, FloatArray] = {}
        self.gizmos: list[viser.TransformControlsHandle] = []
        camera = server.initial_camera
        camera.position, camera.look_at = EYE, LOOK_AT
        camera.near, camera.far = NEAR_M, FAR_M  # thin discs on a table need a precise depth buffer
        self.scene.configure_environment_map(None)  # without a GPU its light takes a second a picture
        self.scene.configure_default_lights(False)
        self.scene.add_light_hemisphere(
            "/light/sky", sky_color=(255, 255, 255), ground_color=(190, 180, 170), intensity=2.0
        )
        self.scene.add_light_directional("/light/lamp", intensity=1.6, position=(-0.6, -0.9, 1.6))
        self.scene.world_axes.visible = False
        self._points: viser.PointCloudHandle | None = None
        self._ways: list[viser.LineSegmentsHandle] = []

    def show_cell(self, cell: Cell) -> None:
        """Draw the bodies of ``cell``; those that look as before are not sent again."""
        surfaces = sorted(cell.surfaces(), key=lambda surface: surface.body)
        bodies = {name: list(group) for name, group in groupby(surfaces, key=lambda surface: surface.body)}
        for name in set(self._bodies) - set(bodies):
            self._bodies.pop(name)[1].remove()
        for name, own in bodies.items():
            self._show_body(name, own)
        self.show_poses(cell.poses())

    def show_poses(self, poses: Mapping[str, FloatArray]) -> None:
        """Move the bodies to ``poses``."""
        with self._server.atomic():
            for name, pose in poses.items():
                before = self._shown.get(name)
                if name in self._bodies and (before is None or np.abs(pose - before).max() >= MOVED):
                    place(self._bodies[name][1], pose)
                    self._shown[name] = pose

    def show_grippers(self, names: Sequence[str]) -> None:
        """Have a handle for each gripper."""
        for node in (*self.gizmos, *self._ways):
            node.remove()
        self.gizmos = [
            self.scene.add_transform_controls(f"/gripper/{name}", scale=GIZMO_M, depth_test=False, line_width=4.0)
            for name in names
        ]
        self._ways = [
            self.scene.add_line_segments(
                f"/way/{name}", np.zeros((1, 2, 3)), REFUSED, thickness=5.0, thickness_units="screen", visible=False
            )
            for name in names
        ]

    def show_way(self, tools: FloatArray, targets: FloatArray, refused: bool) -> None:
        """A red line from each gripper to a target that it cannot follow."""
        for way, tool, target in zip(self._ways, tools, targets, strict=True):
            way.visible = refused
            if refused:
                way.points = np.stack([tool[:3, 3], target[:3, 3]])[None].astype(np.float32)

    def show_points(self, observation: Observation | None) -> None:
        """The point cloud of ``observation``, or none."""
        if self._points is not None:
            self._points.remove()
            self._points = None
        if observation is not None:
            self._points = self.scene.add_point_cloud(
                "/seen", *observation.points(), point_size=POINT_M, precision="float32"
            )

    def _show_body(self, name: str, surfaces: Sequence[Surface]) -> None:
        look = drawing.digest(surfaces)
        if name in self._bodies:
            if self._bodies[name][0] == look:
                return
            self._bodies.pop(name)[1].remove()
        handle = self.scene.add_glb(f"/cell/{name.replace('/', '.') or 'world'}", drawing.glb(surfaces))
        self._bodies[name] = look, handle
        self._shown.pop(name, None)


def place(handle: Any, pose: FloatArray) -> None:
    """Move a node of the scene to ``pose (4, 4)``."""
    handle.wxyz = Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]]
    handle.position = pose[:3, 3]


def pose_of(handle: Any) -> FloatArray:
    """Pose ``(4, 4)`` of a node of the scene."""
    return make_pose(Rotation.from_quat(np.asarray(handle.wxyz)[[1, 2, 3, 0]]).as_matrix(), handle.position)
