"""`check_demonstrations`: everything that a set of demonstrations says about itself, about new scenes and plans."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.sanity.agreement import (
    Shift,
    agreement,
    check_agreement,
    check_depth_shift,
    check_scene_agreement,
    check_scene_depth_shift,
)
from robust_instant_policy.sanity.consistency import gripper_poses
from robust_instant_policy.sanity.contact import GripperPath
from robust_instant_policy.sanity.envelope import Envelope
from robust_instant_policy.sanity.episodes import check_episodes
from robust_instant_policy.sanity.finding import DemonstrationError, Finding, GeometryError, Severity, errors
from robust_instant_policy.sanity.geometry import Evidence, evidence
from robust_instant_policy.sanity.image import check_each_image, check_hole, check_holes, check_image
from robust_instant_policy.sanity.images import ONE_SCENE_M, check_contact, scene_spread
from robust_instant_policy.sanity.recording import (
    check_direction,
    check_fingers,
    check_openings,
    check_rotations,
    check_tool_frame,
)
from robust_instant_policy.sanity.scene import SAME_PICTURE, TABLE_M, check_against_scenery, check_table
from robust_instant_policy.sanity.scenery import Scenery, camera_change
from robust_instant_policy.sanity.view import View

OUTSIDE_SPREADS = 3.0  # times the demonstrations' spread, and
OUTSIDE_M = 0.05  # at least this far from every demonstration's objects, a scene lies outside


@dataclass(frozen=True, eq=False)
class Reference:
    """What sound demonstrations have in common.

    ``plane (4,)`` of the table and ``centre (3,)`` on it; ``scenery`` of a fixed camera, None where there is none;
    ``evidence`` of paths and images; ``edges (I,)`` the ratios of colour and depth edges, as far as there are any, and
    ``depth_shift`` of depth against colour, pixels;
    ``object_centres (I, 3)`` of what is raised in each scene, and ``scene_spread_m`` how far they spread (metres, NaN
    unknown); ``widest_hole`` of the depth images, metres from its middle to its rim.
    """

    plane: FloatArray
    centre: FloatArray
    scenery: Scenery | None
    evidence: Evidence
    edges: FloatArray
    depth_shift: Shift
    object_centres: FloatArray
    scene_spread_m: float
    widest_hole: float


@dataclass(frozen=True, eq=False)
class SetReport:
    """``findings`` of a set of demonstrations, the ``envelope`` of its paths, and the ``reference`` for new scenes.

    ``envelope`` and ``reference`` are None where the demonstrations are too broken to learn them from.
    """

    findings: tuple[Finding, ...]
    envelope: Envelope | None
    reference: Reference | None

    @property
    def notes(self) -> tuple[str, ...]:
        """One line for each finding."""
        return tuple(str(finding) for finding in self.findings)

    def raise_if_wrong(self) -> None:
        """Raises `GeometryError` or `DemonstrationError` with all errors among the findings in one line."""
        if found := errors(self.findings):
            geometric = any(finding.kind in GEOMETRIC for finding in found)
            raise (GeometryError if geometric else DemonstrationError)(found)

    def check_observation(self, observation: Observation) -> tuple[Finding, ...]:
        """What is wrong with a new scene, by itself and beside the demonstrations."""
        view = View.of(observation)
        found = check_image(view)
        if self.reference is None or any(finding.kind == "depth" for finding in found):
            return tuple(found)
        known = self.reference
        if known.scenery is not None:
            found += check_against_scenery(view, known.scenery)
        found += check_table(view, known.plane, known.centre) + check_hole(view, known.widest_hole)
        edges = agreement(view)
        found += check_scene_depth_shift(view, edges, known.depth_shift) + check_scene_agreement(edges, known.edges)
        if any(finding.cause == "depth of another lens" for finding in found):
            return tuple(found)  # without its depth, what is raised is unknown
        return (*found, *_check_novelty(view, known))

    def require_observation(self, observation: Observation) -> tuple[Finding, ...]:
        """`check_observation`; raises `GeometryError` where one of the findings is an error."""
        found = self.check_observation(observation)
        if wrong := errors(found):
            raise GeometryError(wrong)
        return found


GEOMETRIC = {
    "contact", "camera", "camera pose", "intrinsics", "depth", "depth unit", "colour", "colour and depth", "table",
    "scenery", "rotation", "registration",
}  # fmt: skip


def check_demonstrations(demonstrations: Sequence[Demonstration]) -> SetReport:
    """Check ``demonstrations`` as a set: each path, each image, and whether they belong together.

    Raises `DatasetError` where there are none.
    """
    if not demonstrations:
        raise DatasetError("no demonstrations; show the task at least once (rip record)")
    found = check_episodes(demonstrations)
    broken = {finding.kind for finding in errors(found)} & {"unit", "length", "arms", "motion"}
    views = [View.of(demonstration.observation) for demonstration in demonstrations]
    found += check_each_image(views)
    if broken or any(finding.kind == "depth" for finding in errors(found)):
        return SetReport(tuple(found), None, None)

    trajectories = [demonstration.trajectory for demonstration in demonstrations]
    paths = [GripperPath.of(trajectory) for trajectory in trajectories]
    poses = gripper_poses(trajectories)
    as_is = evidence(views, paths, poses)
    cameras = _check_cameras(views)
    found += cameras + check_rotations(demonstrations, as_is)
    found += check_contact(demonstrations, views, paths, poses, as_is) + check_holes(views, paths)
    edges = [agreement(view) for view in views]
    found += check_tool_frame(demonstrations, views, as_is) + check_openings(demonstrations, views)
    found += check_fingers(demonstrations, views) + check_direction(demonstrations, views)
    displaced, depth_shift = check_depth_shift(views, edges)
    found += displaced + check_agreement(views, edges)
    spread = scene_spread(views)
    if len(views) > 1 and np.isfinite(spread) and spread < ONE_SCENE_M:
        words = (
            f"all demonstrations show one scene (objects lie within {spread * 1e3:.1f} mm): others lie outside of "
            "what was shown; record with the objects in other places"
        )
        found.append(Finding("one scene", "warning", words, {"scene_spread_m": spread}))

    planes = np.array([view.plane for view in views])
    plane = np.median(planes, axis=0)
    plane /= np.linalg.norm(plane[:3])
    middle = np.concatenate([path.tips for path in paths]).mean(axis=0)
    centre = middle - (middle @ plane[:3] + plane[3]) * plane[:3]
    fixed = not cameras and all(camera_change(views[0].observation, view.observation).same for view in views)
    same_size = len({view.depth.shape for view in views}) == 1
    reference = Reference(
        plane,
        centre,
        Scenery.of(views) if fixed and same_size else None,
        as_is,
        np.array([edge.ratio for edge in edges if np.isfinite(edge.ratio)]),
        depth_shift,
        np.array([view.object_centre for view in views]),
        spread,
        max(float(view.holes.max()) for view in views),
    )
    return SetReport(tuple(found), Envelope.of(trajectories, plane), reference)


def _check_cameras(views: Sequence[View]) -> list[Finding]:
    """One fixed camera, or several: where the camera is said to differ, the picture must."""
    first = views[0].observation
    sizes = {view.observation.rgb.shape for view in views}
    if len(sizes) > 1:
        told = " and ".join(f"{size[1]}x{size[0]}" for size in sorted(sizes))
        return [Finding("camera", "warning", f"images have {told} pixels: cameras or resolutions are mixed")]
    changes = [camera_change(first, view.observation) for view in views]
    same = np.array([c.same for c in changes])
    if same.all():
        return _check_planes(views)
    scenery = Scenery.of([view for view, is_same in zip(views, same, strict=True) if is_same])
    for index in (int(i) for i in np.flatnonzero(~same)):
        change = changes[index]
        like = scenery.likeness(views[index])
        if (
            not change.within_calibration
            and like.depth > SAME_PICTURE
            and scenery.textured
            and like.texture > SAME_PICTURE * scenery.texture
        ):
            words = f"from demonstration {index} on the camera is said to be {change}, but the picture is the same"
            numbers = {"demonstration": float(index), "moved": change.moved, "turned": change.turned}
            return [Finding("camera", "error", f"{words}: one calibration is wrong", numbers, "camera pose changed")]
    return _check_planes(views)


def _check_planes(views: Sequence[View]) -> list[Finding]:
    """The table is one plane in the world, whatever camera looks at it."""
    known = [view for view in views if view.shows_table]
    if len(known) < 2:
        return []
    middle = np.nanmedian(np.concatenate([view.points.reshape(-1, 3) for view in known[:3]]), axis=0)
    heights = np.array([middle @ view.plane[:3] + view.plane[3] for view in known])
    off = float(np.abs(heights - np.median(heights)).max())
    if off <= TABLE_M:
        return []
    words = f"the table's height differs by {off * 100:.1f} cm between demonstrations: a camera pose or depth is wrong"
    return [Finding("camera", "error", words, {"table_offset": off}, "camera pose changed")]


def _check_novelty(view: View, known: Reference) -> list[Finding]:
    """How far what is raised lies from what was raised in the demonstrations."""
    centre = view.object_centre
    seen = known.object_centres[np.isfinite(known.object_centres).all(axis=1)]
    if not len(seen):
        return []
    if not np.isfinite(centre).all():
        words = "nothing in the image stands above the table; every demonstration shows something that does"
        severity: Severity = "error" if len(seen) == len(known.object_centres) else "warning"
        return [Finding("scene", severity, words, cause="flat depth: nothing raised")]
    distance = float(np.linalg.norm(seen - centre, axis=1).min())
    spread = known.scene_spread_m if np.isfinite(known.scene_spread_m) else 0.0
    if distance <= max(OUTSIDE_SPREADS * spread, OUTSIDE_M):
        return []
    words = f"the objects lie {distance * 100:.0f} cm from where any demonstration has them"
    advice = f" (these spread by {spread * 100:.1f} cm): the scene lies outside of what was shown"
    return [
        Finding("scene", "warning", words + advice, {"scene_distance_m": distance, "scene_spread_m": spread}, "outside")
    ]
