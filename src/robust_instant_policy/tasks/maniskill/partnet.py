"""ManiSkill's downloadable objects, if installed: YCB's banana, PartNet-Mobility's cabinets and faucets.

The geometry that experts need is measured on their meshes. PartNet-Mobility's objects face -x, as ours do.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import sapien
import trimesh
from mani_skill import ASSET_DIR, PACKAGE_ASSET_DIR
from mani_skill.utils.geometry.trimesh_utils import get_render_shape_meshes
from mani_skill.utils.structs.articulation import Articulation
from mani_skill.utils.structs.link import Link

from robust_instant_policy.errors import RipError
from robust_instant_policy.geometry import FloatArray, make_pose, transform_points
from robust_instant_policy.tasks.maniskill.mechanism import Door, Drawer, Lever, Mechanism, closed_joints, resist
from robust_instant_policy.tasks.maniskill.robot import STROKE_M

YCB_FOLDER = ASSET_DIR / "assets" / "mani_skill2_ycb"
YCB_BANANA = "011_banana"
PARTNET_FOLDER = ASSET_DIR / "partnet_mobility" / "dataset"
URDF_NAMES = ("mobility_cvx.urdf", "mobility_fixed.urdf")
TABLETOP_SCALE = 0.2  # PartNet-Mobility's objects fill the unit sphere; on the table they measure 0.4 m across

UPRIGHT = 0.9  # smallest cosine between an axis and the required direction
DAMPING, FRICTION = 0.08, 0.05  # of levers and doors; drawers have DRAWER_DAMPING
DRAWER_DAMPING = 15.0

MIN_TRAVEL_M = 0.04
MAX_HANDLE_M = STROKE_M - 0.014  # largest width between the open fingers, with clearance on both sides
MIN_HANDLE_DEPTH_M = 0.010
MAX_OVER_HANDLE_M = 0.045  # largest height above a handle that clears the gripper's body
MIN_DOOR_M = 0.08
MIN_LEVER_M = 0.035
LEVER_ROOT_SHARE = 0.5  # share of a lever's length inside its hub

Geometry = TypeVar("Geometry", Drawer, Door, Lever)


class MissingAssetsError(RipError):
    """ManiSkill's downloadable assets are missing, or none is suitable."""

    def __init__(self, what: str, where: Path, download: str):
        super().__init__(
            f"no {what} in {where}; run: python -m mani_skill.utils.download_asset {download}, "
            "or leave out assets='maniskill' for objects built in code"
        )


def require_banana() -> None:
    """Raise `MissingAssetsError` unless YCB's banana is installed."""
    if not (YCB_FOLDER / "models" / YCB_BANANA / "textured.obj").exists():
        raise MissingAssetsError("YCB banana", YCB_FOLDER, "ycb")


def load_chest(scene: Any, rng: np.random.Generator) -> tuple[Mechanism, Drawer]:
    """A chest with a drawer whose handle fits between the fingers from above."""
    return _load(scene, "cabinet_drawer", "partnet_mobility_cabinet", None, rng, _measure_drawer)


def load_cabinet(scene: Any, objects: str, rng: np.random.Generator) -> tuple[Mechanism, Door]:
    """A cabinet with an upright door on its front."""
    return _load(scene, "cabinet_door", "partnet_mobility_cabinet", objects, rng, _measure_door)


def load_faucet(scene: Any, objects: str, rng: np.random.Generator) -> tuple[Mechanism, Lever]:
    """A faucet with a lever that turns about the vertical."""
    return _load(scene, "faucet", "partnet_mobility_faucet", objects, rng, _measure_lever)


@dataclass(frozen=True, eq=False)
class _Model:
    """An articulation with all joints closed, its root at the world's origin, and where its body then is."""

    articulation: Articulation
    body: FloatArray  # (2, 3): lower and upper corner, handles left out

    @property
    def origin(self) -> FloatArray:
        """Pose of the root in a frame on the table under the middle of the front."""
        (low_x, low_y, low_z), (_, high_y, _) = self.body
        return make_pose(np.eye(3), (-low_x, -(low_y + high_y) / 2, -low_z))

    def points(self, link: Link, handle: bool | None = None) -> FloatArray:
        """Vertices ``(V, 3)`` of ``link`` in the object's frame; only its handle's, or all but its handle's."""
        return transform_points(self.origin @ _pose(link), _vertices(link, handle))

    def axis(self, joint: Any) -> tuple[FloatArray, FloatArray]:
        """A point and the direction, both ``(3,)``, of ``joint`` in the object's frame."""
        frame = self.origin @ _pose(joint.child_link) @ np.asarray(joint.pose_in_child.to_transformation_matrix()[0])
        return frame[:3, 3], frame[:3, 0]


def _load(
    scene: Any,
    category: str,
    download: str,
    objects: str | None,
    rng: np.random.Generator,
    measure: Callable[[_Model, Any], Geometry | None],
) -> tuple[Mechanism, Geometry]:
    """The first model, in the order of ``rng``, with a joint that ``measure`` accepts."""
    info = json.loads((PACKAGE_ASSET_DIR / "partnet_mobility" / "meta" / f"info_{category}_train.json").read_text())
    installed = sorted(model for model in info if _urdf(model) is not None)
    if objects is not None:  # every other model is unseen
        installed = installed[objects == "unseen" :: 2]
    for model_id in rng.permutation(installed):
        scale = info[model_id]["scale"] if category == "faucet" else TABLETOP_SCALE
        model = _build(scene, str(model_id), scale)
        for joint in model.articulation.active_joints:
            geometry = measure(model, joint)
            if geometry is not None:
                damping = DRAWER_DAMPING if isinstance(geometry, Drawer) else DAMPING
                resist(model.articulation, joint.name, damping, FRICTION)
                return Mechanism(model.articulation, joint.name, joint.child_link.name, model.origin), geometry
        scene.remove_articulation(model.articulation)
    raise MissingAssetsError(f"model of {category} that the gripper can operate", PARTNET_FOLDER, download)


def _urdf(model_id: str) -> Path | None:
    paths = (PARTNET_FOLDER / model_id / name for name in URDF_NAMES)
    return next((path for path in paths if path.exists()), None)


def _build(scene: Any, model_id: str, scale: float) -> _Model:
    loader = scene.create_urdf_loader()
    loader.fix_root_link, loader.scale = True, scale
    loader.load_multiple_collisions_from_file = True
    loader.name = f"partnet-{model_id}"
    builder = loader.parse(str(_urdf(model_id)))["articulation_builders"][0]
    builder.initial_pose = sapien.Pose()
    articulation = builder.build(name=loader.name)
    articulation.set_qpos(closed_joints(articulation))
    corners = [transform_points(_pose(link), _vertices(link, handle=False)) for link in articulation.links]
    points = np.concatenate(corners)
    return _Model(articulation, np.array([points.min(axis=0), points.max(axis=0)]))


def _pose(link: Link) -> FloatArray:
    return link._objs[0].pose.to_transformation_matrix().astype(np.float64)


def _vertices(link: Link, handle: bool | None) -> FloatArray:
    found = [np.zeros((0, 3))]
    for shapes in link.render_shapes:
        for shape in shapes:
            if handle is None or ("handle" in shape.name) == handle:
                found += [mesh.vertices for mesh in get_render_shape_meshes(shape)]
    return np.concatenate(found)


def _measure_drawer(model: _Model, joint: Any) -> Drawer | None:
    handle = model.points(joint.child_link, handle=True)
    if joint.type[0] != "prismatic" or not len(handle):
        return None
    low, high = handle.min(axis=0), handle.max(axis=0)
    lower, upper = joint.limits[0].tolist()
    travel, out = upper - lower, model.axis(joint)[1]
    fits = high[1] - low[1] <= MAX_HANDLE_M and min(high[0], 0.0) - low[0] >= MIN_HANDLE_DEPTH_M
    in_the_open = model.body[1, 2] - model.body[0, 2] - (low[2] + high[2]) / 2 <= MAX_OVER_HANDLE_M
    if not (fits and in_the_open and travel >= MIN_TRAVEL_M and -out[0] >= UPRIGHT):
        return None
    middle = (low + high) / 2
    return Drawer(np.array([low[0] + MIN_HANDLE_DEPTH_M, middle[1], middle[2]]), travel)


def _measure_door(model: _Model, joint: Any) -> Door | None:
    point, axis = model.axis(joint)
    panel = model.points(joint.child_link, handle=False)
    if not joint.type[0].startswith("revolute") or abs(axis[2]) < UPRIGHT or not len(panel):
        return None
    side = 1.0 if axis[2] < 0 else -1.0  # this direction of rotation about the hinge opens towards -x
    low, high = panel.min(axis=0), panel.max(axis=0)
    width = float(point[1] - low[1] if side > 0 else high[1] - point[1])
    opens = float(joint.limits[0, 1] - joint.limits[0, 0])
    on_the_front = low[0] < 0.02 and width >= max(MIN_DOOR_M, 0.8 * (high[1] - low[1]))
    clear_above = model.body[1, 2] - model.body[0, 2] - high[2] <= MAX_OVER_HANDLE_M / 2
    if not (on_the_front and clear_above and opens >= np.deg2rad(80)):
        return None
    return Door(np.array([low[0], point[1]]), side, width, float(high[2]))


def _measure_lever(model: _Model, joint: Any) -> Lever | None:
    point, axis = model.axis(joint)
    if not joint.type[0].startswith("revolute") or abs(axis[2]) < UPRIGHT:
        return None
    vertices = model.points(joint.child_link) - point
    distance = np.linalg.norm(vertices[:, :2], axis=1)
    length = float(distance.max())
    tip = vertices[distance > 0.95 * length].mean(axis=0)
    start = float(np.arctan2(tip[1], tip[0]))
    outer = vertices[distance > LEVER_ROOT_SHARE * length]
    aside = np.abs(outer[:, 1] * np.cos(start) - outer[:, 0] * np.sin(start))
    lower, upper = joint.limits[0].tolist()
    turn = upper - lower if np.isfinite(upper - lower) else np.pi / 2  # as in ManiSkill's TurnFaucet
    if length < MIN_LEVER_M or aside.max() > 0.5 * length or turn <= 0:
        return None
    height = point[2] + (outer[:, 2].min() + outer[:, 2].max()) / 2
    return Lever(point[:2], start, float(np.sign(axis[2])), turn, length, float(aside.max()), float(height))


def banana_frame(mesh: trimesh.Trimesh) -> FloatArray:
    """Pose ``(4, 4)``, in the mesh's frame, of the frame that `Banana` lies in: its middle, long axis along x."""
    vertices = np.asarray(mesh.vertices)
    middle = vertices.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((vertices - middle)[:, :2].T))
    along = np.array([*axes[:, 1], 0.0])
    waist = vertices[np.abs((vertices - middle) @ along) < 0.1 * np.ptp(vertices @ along)]
    frame = make_pose(np.stack([along, np.cross([0, 0, 1], along), [0, 0, 1]], axis=1), waist.mean(axis=0))
    frame[2, 3] = (waist[:, 2].min() + waist[:, 2].max()) / 2
    return frame
