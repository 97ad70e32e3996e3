"""Messages: observations in, chunks of actions out, as openpi's binary messages and as JSON.

openpi packs maps with msgpack, and an array as a map with the bytes ``__ndarray__``, ``data``, ``dtype`` and ``shape``
as keys (a NumPy number with ``__npgeneric__``, ``data`` and ``dtype``).
"""

import base64
import binascii
import math
import re
from collections.abc import Mapping
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from robust_instant_policy import __version__
from robust_instant_policy.datasets.images import decode_image
from robust_instant_policy.datasets.layout import axis_names
from robust_instant_policy.demonstration import ARRAYS, Observation
from robust_instant_policy.errors import InvalidValueError, RipError
from robust_instant_policy.files import excerpt
from robust_instant_policy.geometry import GripperTriangle
from robust_instant_policy.serving.planner import Job, Planner

PREFIX = "observation/"  # of openpi's keys, which may be left out
SYNONYMS = {"image": "rgb"}
PLAIN_DTYPE = re.compile(r"[<>|=]?[biuf][1248]")
MAX_DIMENSIONS = 4
MAX_NAME = 200  # characters of a robot's name
MAX_UNIT_M = 1.0  # metres per step of depth
OBSERVATION = {
    "rgb": "(H, W, 3) uint8",
    "depth": "(H, W) float metres, or whole numbers with depth_unit_m; 0 or NaN: no reading",
    "intrinsics": "(3, 3) pixels",
    "camera_pose": "(4, 4) camera to world, OpenCV axes",
    "depth_unit_m": "metres per step, where depth holds whole numbers",
    "robot": "name of the robot; one plan at a time for each (default: one for each connection)",
}


class MessageError(RipError):
    """A message that is not what the protocol asks for."""


def pack(content: object) -> bytes:
    """A message of openpi's protocol; arrays and NumPy numbers may be anywhere in ``content``."""
    return msgpack.packb(content, default=_pack_array)


def unpack(message: bytes) -> dict[str, Any]:
    """The map in a message; nothing is unpickled. Raises `MessageError`."""
    try:
        content = msgpack.unpackb(message, object_hook=_unpack_array)
    except (ValueError, TypeError, ArithmeticError, RecursionError, MemoryError, msgpack.UnpackException) as error:
        raise MessageError(
            f"the message is not msgpack with NumPy arrays as openpi packs them: {_said(error)}"
        ) from None
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise MessageError(f"the message must be a map with text as keys, got {type(content).__name__}")
    return content


def _pack_array(value: object) -> dict[bytes, Any]:
    if not isinstance(value, np.ndarray | np.generic) or not PLAIN_DTYPE.fullmatch(value.dtype.str):
        raise TypeError(f"{type(value).__name__} cannot be packed")
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}


def _unpack_array(content: dict[Any, Any]) -> Any:
    is_array = b"__ndarray__" in content
    if not is_array and b"__npgeneric__" not in content:
        return content
    data, dtype, shape = content.get(b"data"), content.get(b"dtype"), content.get(b"shape", [])
    if not (isinstance(dtype, str) and PLAIN_DTYPE.fullmatch(dtype)):
        raise ValueError(f"an array of type {dtype!r}, not of real numbers")
    if not is_array:
        return np.dtype(dtype).type(data)
    if not (isinstance(shape, list) and len(shape) <= MAX_DIMENSIONS and all(type(n) is int and n >= 0 for n in shape)):
        raise ValueError(f"an array of shape {shape!r}")
    if not isinstance(data, bytes) or len(data) != math.prod(shape) * np.dtype(dtype).itemsize:
        raise ValueError(f"an array whose data do not fill its shape {shape!r}")
    return np.frombuffer(data, dtype).reshape(shape)


def read_observation(content: Mapping[str, Any]) -> Observation:
    """The observation in a map with the keys of `OBSERVATION`; others, such as openpi's ``prompt``, are ignored.

    Raises `MessageError` that names what is missing or wrong.
    """
    named = {SYNONYMS.get(key := name.removeprefix(PREFIX), key): value for name, value in content.items()}
    missing = [name for name in ARRAYS if name not in named]
    if missing:
        got = excerpt(", ".join(content)) or "nothing"
        raise MessageError(f"the observation lacks {', '.join(missing)}; it has {got}")
    try:
        arrays = {name: np.asarray(named[name]) for name in ARRAYS}
        arrays["depth"] = _metres(arrays["depth"], named.get("depth_unit_m"))
        return Observation(**arrays)
    except (ValueError, TypeError) as error:
        raise MessageError(f"the observation is wrong: {_said(error)}") from None


def read_robot(content: Mapping[str, Any], default: str) -> str:
    """The name of the robot in a map. Raises `MessageError` for anything else than short text."""
    robot = content.get("robot", default)
    if not isinstance(robot, str) or not 0 < len(robot) <= MAX_NAME:
        raise MessageError(f"robot must be a name of at most {MAX_NAME} characters")
    return robot


def read_image(name: str, text: str) -> NDArray:
    """The pixels of an image, PNG or JPEG in base64. Raises `MessageError`."""
    try:
        return np.asarray(decode_image(base64.b64decode(text, validate=True), ("PNG", "JPEG")))
    except (binascii.Error, ValueError) as error:
        raise MessageError(f"{name} must be a PNG or JPEG file in base64: {_said(error)}") from None


def _metres(depth: NDArray, unit: object) -> NDArray:
    if depth.ndim == 3 and depth.shape[2] == 1:
        depth = depth[..., 0]
    if depth.dtype.kind not in "iu":
        return depth
    if isinstance(unit, bool) or not isinstance(unit, int | float | np.number) or not 0 < unit <= MAX_UNIT_M:
        raise InvalidValueError(
            f"depth holds whole numbers; give depth_unit_m, metres per step, at most {MAX_UNIT_M:g} (0.001: mm)"
        )
    return depth.astype(np.float32) * np.float32(unit)


def _said(error: Exception) -> str:
    return excerpt(error) or type(error).__name__


def describe(planner: Planner) -> dict[str, Any]:
    """What a client is told when it connects: what the server plans, what it needs, and what it answers."""
    first = planner.demonstrations[0]
    seconds = [one.seconds for one in planner.demonstrations]
    return {
        "policy": "robust-instant-policy",
        "version": __version__,
        "method": planner.policy.name,
        "task": first.task,
        "num_demonstrations": len(planner.demonstrations),
        "demonstrated_s": float(np.median(seconds)),
        "min_confidence": planner.min_confidence,
        "observation": OBSERVATION,
        "actions": axis_names(first.trajectory.num_arms),
        "frame": "world of the demonstrations, metres; gripper 0 open, 1 closed",
        "is_open_loop": True,
    }


def reply(planner: Planner, job: Job) -> dict[str, Any]:
    """The answer of a finished plan.

    ``actions (H, 10·A)`` as in `Trajectory`; the same as tool poses ``poses (H, A, 4, 4)`` (z out of the gripper) and
    ``gripper (H, A)``; ``times (H,)`` in [0, 1]; its confidence, notes, and the time it took.
    """
    plan = job.future.result()
    trajectory = plan.trajectory
    triangles = [
        GripperTriangle.from_triplets(planner.demonstrations[0].trajectory.triplets[:, arm])
        for arm in range(trajectory.num_arms)
    ]
    poses = [triangle.poses(trajectory.triplets[:, arm]) for arm, triangle in enumerate(triangles)]
    return {
        "actions": trajectory.actions,
        "poses": np.stack(poses, axis=1),
        "gripper": trajectory.gripper_state,
        "times": trajectory.times,
        "confidence": plan.confidence,
        "hallucinated": int(plan.hallucinated.sum()),
        "notes": list(plan.notes),
        "server_timing": {
            "infer_ms": 1e3 * (job.ended_at - job.started_at),
            "queue_ms": 1e3 * (job.started_at - job.queued_at),
        },
    }


def as_json(value: Any) -> Any:
    """``value`` with lists in place of arrays."""
    if isinstance(value, Mapping):
        return {key: as_json(inner) for key, inner in value.items()}
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value
