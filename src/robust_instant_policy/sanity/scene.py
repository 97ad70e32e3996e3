"""A new scene against what the demonstrations' images have in common."""

import numpy as np

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray, lift
from robust_instant_policy.sanity.finding import Finding
from robust_instant_policy.sanity.hypotheses import OF_DEPTH, OF_IMAGES, OF_POSE
from robust_instant_policy.sanity.image import UNIFORM
from robust_instant_policy.sanity.scenery import CameraChange, Likeness, Scenery, camera_change
from robust_instant_policy.sanity.view import View

SAME_PICTURE = 0.9  # share, of what the demonstrations' own images agree, that an image of the same scenery agrees
SAME_TEXTURE = 0.5  # the same of the correlation of texture, which light and shadows lower
BETTER = 0.1  # by which the sum of both shares must be larger under a hypothesis that explains a picture
TABLE_M, TABLE_RAD = 0.02, np.deg2rad(2.0)  # that the table may differ from the demonstrations'
MUCH_TEXTURE = 0.8  # from which texture survives another camera's resolution
SAME_IN_WORLD = 0.3  # of the demonstrations' own correlation, of texture on the table seen by another camera
RECALIBRATED_M = 0.015  # by which another calibration of the same camera may displace what it shows
MISSING = 0.2  # share of the scenery without depth that no camera noise explains


def check_against_scenery(view: View, scenery: Scenery) -> list[Finding]:
    """For demonstrations from one fixed camera: has the camera, its calibration or the picture changed since?"""
    observation = view.observation
    change = camera_change(scenery.reference, observation)
    if observation.rgb.shape != scenery.reference.rgb.shape:
        old, new = scenery.reference.rgb.shape, observation.rgb.shape
        words = f"the image has {new[1]}x{new[0]} pixels, the demonstrations' have {old[1]}x{old[0]}"
        if change.within_calibration:
            advice = ": one was cropped; subtract what was cut on the left and at the top from the principal point"
            numbers = {"intrinsics": change.intrinsics}
            return [Finding("camera", "error", f"{words}, with the same intrinsics{advice}", numbers, "cropped image")]
        return [Finding("camera", "warning", f"{words}: scenery was not compared", cause="another resolution")]
    small = change.within_calibration
    like = scenery.likeness(view)
    if not np.isfinite(like.depth):
        return [Finding("scenery", "unchecked", "too little of the scenery is visible to compare it")]
    found = []
    missing = float(np.isnan(view.depth)[scenery.static].mean())
    if missing > MISSING:
        words = f"depth is missing or unsteady in {missing:.0%} of the scenery that the demonstrations' images have"
        advice = "; is it of another lens or stream, or not aligned to colour?"
        found.append(Finding("scenery", "error", words + advice, {"missing": missing}, "depth of another lens"))
    if small and scenery.swapped(view):
        words = "red and blue are exchanged: the image is BGR, the demonstrations' are RGB, or the other way round"
        found.append(Finding("scenery", "error", words, cause="BGR"))
    same_depth = like.depth >= SAME_PICTURE * scenery.agreed
    compares_texture = scenery.textured and view.rgb.std() >= UNIFORM  # `check_image` tells an image without content
    same_texture = not compares_texture or like.texture >= SAME_TEXTURE * scenery.texture
    explained = _explain(view, scenery, like) if small else None
    numbers = {
        "same_depth": like.depth,
        "texture": like.texture,
        "moved": change.moved,
        "turned": change.turned,
        "intrinsics": change.intrinsics,
    }
    if same_depth and same_texture and not explained:
        displaced = _displaced(view, scenery.reference)
        if small and displaced < RECALIBRATED_M:
            return found
        numbers["displaced"] = displaced
        cause = _name_calibration(scenery.reference, observation, change)
        words = f"the picture is the demonstrations', but its camera is said to be {change}"
        places = f", which displaces what it shows by {displaced * 1e3:.0f} mm"
        return [*found, Finding("camera", "error", f"{words}{places}: {cause}", numbers, cause)]
    if small:
        cause, words = explained or _unexplained(scenery, like, same_depth)
        return [*found, Finding("scenery", "error", words, {**numbers, "ratio": like.ratio}, cause)]
    # Another camera, or one that was moved and calibrated: only the world can be compared.
    there = scenery.texture_in_world(view)
    if scenery.texture >= MUCH_TEXTURE and there < SAME_IN_WORLD * scenery.texture:
        words = f"the camera is {change}, and where its calibration puts the table the texture is another"
        advice = f" ({there:.2f} against {scenery.texture:.2f}): is the new calibration right, and the table the same?"
        found.append(
            Finding("scenery", "warning", words + advice, {**numbers, "texture_in_world": there}, "camera moved")
        )
    return found


def _displaced(view: View, reference: Observation) -> float:
    """Median distance, metres, of what is seen from where it would be with the camera of ``reference``."""
    rows, cols = np.nonzero(np.isfinite(view.depth))
    pixels = np.stack([cols, rows], axis=-1) * view.every
    there = lift(pixels, view.depth[rows, cols], reference.intrinsics, reference.camera_pose)
    return float(np.median(np.linalg.norm(view.points[rows, cols] - there, axis=-1)))


def _name_calibration(old: Observation, new: Observation, change: CameraChange) -> str:
    for hypothesis in () if change.pose_within_calibration else OF_POSE:
        if camera_change(old, hypothesis.correct(new)).pose_within_calibration:
            return f"{hypothesis.cause} is the demonstrations'; {hypothesis.remedy}"
    if not change.intrinsics_within_calibration:
        ratio = new.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]] / old.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
        told = ", ".join(f"{name} x{value:.3g}" for name, value in zip(("fx", "fy", "cx", "cy"), ratio, strict=True))
        return f"intrinsics of another camera or resolution, or a wrong focal length or principal point ({told})"
    return "the camera pose is wrong, here or in the demonstrations; calibrate the camera once for both"


def _explain(view: View, scenery: Scenery, like: Likeness) -> tuple[str, str] | None:
    """Cause and words of the known mistake without which the picture agrees best, where it agrees clearly better."""

    def score(depth: float, texture: float) -> float:
        shares = depth / scenery.agreed, texture / scenery.texture if scenery.textured else 0.0
        return float(np.minimum(np.nan_to_num(shares), 1.0).sum())

    as_is = score(like.depth, like.texture)
    if as_is > 1 + scenery.textured - BETTER:
        return None
    found: list[tuple[float, str, str]] = []
    for hypothesis in OF_IMAGES:
        turned = scenery.likeness(View.of(hypothesis.correct(view.observation)))
        what = hypothesis.cause.removeprefix("the image ")
        for name, depth, texture in (
            ("depth image", turned.depth, like.texture),
            ("colour image", like.depth, turned.texture),
            ("image", turned.depth, turned.texture),
        ):
            words = (
                f"the {name} is {what}: turned back, it agrees with the demonstrations' scenery; {hypothesis.remedy}"
            )
            found.append((score(depth, texture), f"{name} {what}", words))
    for hypothesis in OF_DEPTH:
        fixed = scenery.likeness(View.of(hypothesis.correct(view.observation)))
        words = (
            f"depth reads {like.ratio:.3g} times the demonstrations' over the same scenery; with {hypothesis.cause} it "
            f"agrees: {hypothesis.remedy}"
        )
        found.append((score(fixed.depth, like.texture), hypothesis.cause, words))
    if scenery.textured:
        cols, rows, texture = scenery.shift(view)
        metres = float(np.hypot(cols, rows) * np.nanmedian(view.depth) / view.observation.intrinsics[0, 0])
        words = f"the camera was moved: the scenery is displaced by {cols:+d}, {rows:+d} pixels ({metres * 100:.0f} cm)"
        found.append((score(like.depth, texture), "camera moved", f"{words}; calibrate it anew, or put it back"))
    best, cause, words = max(found, key=lambda one: one[0])
    return (cause, words) if best > as_is + BETTER else None


def _unexplained(scenery: Scenery, like: Likeness, same_depth: bool) -> tuple[str, str]:
    """Cause and words where the camera is said to be the same, the picture is not, and no known mistake explains it."""
    if not same_depth and abs(like.ratio - 1) * np.nanmedian(scenery.depth) > TABLE_M:
        words = f"depth reads {like.ratio:.3g} times the demonstrations' ({like.offset * 100:+.1f} cm)"
        advice = "; the table is lower or higher, the camera was moved, or the depth is not calibrated"
        return "depth scale, camera or table moved", words + advice
    if not same_depth:
        words = f"{like.depth:.0%} of the scenery's depth are as in the demonstrations"
        return "camera moved", f"{words}: the camera was moved, or the depth is of another scene or stream"
    told = f"texture agrees by {like.texture:.2f}" if np.isfinite(like.texture) else "it has no texture"
    words = f"the scenery looks different ({told}, theirs by {scenery.texture:.2f})"
    advice = ": the camera was moved, the colour image is of another stream, or the table is covered"
    return "camera moved, or another colour image", words + advice


def check_table(view: View, plane: FloatArray, centre: FloatArray) -> list[Finding]:
    """The table must be where the demonstrations' table is, at their ``centre (3,)``, wherever the camera is."""
    if not view.shows_table:
        words = f"only {view.share_on_plane:.0%} of the image are one plane: the table's height was not checked"
        return [Finding("table", "unchecked", words, {"share_on_plane": view.share_on_plane})]
    offset = float(centre @ view.plane[:3] + view.plane[3])
    angle = float(np.arccos(np.clip(view.plane[:3] @ plane[:3], -1, 1)))
    if abs(offset) <= TABLE_M and angle <= TABLE_RAD:
        return []
    words = (
        f"the table lies {abs(offset) * 100:.1f} cm {'below' if offset > 0 else 'above'} the demonstrations' table, "
        f"turned by {np.rad2deg(angle):.1f} degrees"
    )
    numbers = {"table_offset": offset, "table_angle": angle}
    advice = "; the camera's pose or the depth is wrong, or the table was moved"
    return [Finding("table", "error", words + advice, numbers, "camera pose or depth: the table moved")]
