"""What reads from outside, as targets for fuzzing: a strategy that makes cases, and what must hold for each of them.

A case is bytes, so that one that failed can be kept in ``tests/fuzz_corpus/TARGET/`` and run again. Of each case one
of two things must come: an error of the package, in one line, or a value that keeps its promises; within a second.
Most cases are mutations of something real: a recorded folder, an observation, a plan, an answer in the prompt's form.
"""

from __future__ import annotations

import io
import json
import os
import re
import signal
import socket
import struct
import tempfile
import time
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from robust_instant_policy.context import Prompt, write_prompt
from robust_instant_policy.context.codec import read_row, read_rows, write_row
from robust_instant_policy.datasets import DatasetWriter, load_demonstrations
from robust_instant_policy.datasets.importers import GripperCommand, Rig, import_demonstrations
from robust_instant_policy.datasets.video import encode_video
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import RipError
from robust_instant_policy.geometry import GripperTriangle, make_pose
from robust_instant_policy.policies.policy import Plan, Stage, Usage
from robust_instant_policy.trajectory import Trajectory

LIMIT_S = 1.0  # of processor time, for a case
HANG_S = 20.0  # after which a case counts as blocked
CORPUS = Path(__file__).parent / "fuzz_corpus"
TRIANGLE = GripperTriangle(length=0.1, opening=0.08)
HEIGHT, WIDTH, STEPS, RATE_HZ = 16, 16, 6, 20.0


class Case(bytes):
    """One input; shown by its beginning, as reports of failures would fill pages otherwise."""

    def __repr__(self) -> str:
        return f"<{len(self)} bytes: {bytes(self[:100])!r}>"


@dataclass(frozen=True)
class Target:
    """``check`` runs a case; it returns whether it gave a right value, and may raise `RipError` for a refusal."""

    name: str
    cases: st.SearchStrategy[Case]
    check: Callable[[bytes], bool]


@dataclass(frozen=True)
class Outcome:
    accepted: bool
    seconds: float  # of processor time


def run(target: Target, case: bytes) -> Outcome:
    """Raises whatever is neither a right value nor an error of the package in one line, `AssertionError` if slow."""
    start = time.process_time()
    refusal = None
    accepted = False
    with _no_longer_than(HANG_S), warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            accepted = target.check(case)
        except RipError as error:
            refusal = str(error)
    if refusal is not None:
        assert refusal.strip(), "an error without words"
        assert "\n" not in refusal, "an error of several lines"
        assert len(refusal) < 1000, "an error that quotes too much"
    seconds = time.process_time() - start
    assert seconds < LIMIT_S, f"took {seconds:.1f} s"
    return Outcome(accepted, seconds)


def fuzz(target: Target, count: int, first_seed: int, check: Callable[[Case], None]) -> None:
    """Call ``check`` with ``count`` cases of ``target``; the last one that it fails for is the smallest."""

    @seed(first_seed)
    @settings(
        max_examples=count,
        deadline=None,
        database=None,
        report_multiple_bugs=False,
        suppress_health_check=list(HealthCheck),
    )
    @given(case=target.cases)
    def each(case: Case) -> None:
        check(case)

    each()


@contextmanager
def _no_longer_than(seconds: float) -> Iterator[None]:
    def stop(*_: object) -> None:
        raise AssertionError(f"blocked for {seconds:g} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


# ---- Mutations of anything

DEEP = json.loads("[" * 400 + "]" * 400)
ODD_TEXTS = [
    "", "0", "nan", "a\0b", "é\n\r\x1b[31m", "x" * 5000, "../../../../../../etc/passwd", "/etc/passwd", "/dev/zero",
    "data/{chunk_index.__class__}/{file_index}", "{chunk_index:2000000000d}", "{file_index!r:>99}", "{0}", "{", "}",
    "{chunk_index:{file_index}}", "{video_key[0]}", "data/chunk-000/file-000.parquet", ".", "data", "meta/info.json",
]  # fmt: skip
ODD_VALUES = [
    None, True, False, -1, 0, 1, 2, 255, 2**31, 2**63, 10**30, 10**400, 0.5, -0.0, 1e308, 1e-308, float("nan"),
    float("inf"), -float("inf"), [], {}, [[]], [None], [1, "a"], [[1], [1, 2]], {"a": {}}, [[0.0] * 10, [0.0] * 9],
    list(range(10)), DEEP, *ODD_TEXTS,
]  # fmt: skip


def odd_values() -> st.SearchStrategy:
    leaves = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
    nested = st.recursive(
        leaves, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner)
    )
    return st.sampled_from(ODD_VALUES) | nested


@st.composite
def mutated_bytes(draw: st.DrawFn, original: bytes) -> bytes:
    """Bytes cut, overwritten, inserted, removed or repeated."""
    content = bytearray(original)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(content)))
        length = draw(st.sampled_from([1, 1, 2, 4, 8, 64]))
        match draw(st.sampled_from(["cut", "write", "write", "write", "insert", "remove", "repeat", "zero"])):
            case "cut":
                del content[at:]
            case "write":
                content[at : at + length] = draw(st.binary(min_size=length, max_size=length))[: len(content) - at]
            case "insert":
                content[at:at] = draw(st.binary(min_size=1, max_size=length))
            case "remove":
                del content[at : at + length]
            case "repeat":
                content[at:at] = content[at : at + length] * 3
            case "zero":
                content[at : at + length] = bytes(len(content[at : at + length]))
    return bytes(content)


ODD_CONTENTS = [
    b"", b"\0" * 512, b"null", b"[]", b"{}", b"\xff\xfe{}", b"\xef\xbb\xbf{}", b"[" * 100_000, b'{"a":' * 100_000,
    b'{"a": 1' + b"0" * 10_000 + b"}", b"\x80\x04\x95", b"PK\x03\x04", b"PAR1PAR1", b"#EXTM3U\nfile:///etc/passwd\n",
    b"ffconcat version 1.0\nfile /etc/passwd\n", b"\x89HDF\r\n\x1a\n",
]  # fmt: skip


def other_contents() -> st.SearchStrategy[bytes]:
    return st.sampled_from(ODD_CONTENTS) | st.binary(max_size=200)


def _paths(value: object, path: tuple = ()) -> list[tuple]:
    """The places in a JSON value, at most the first few of each list."""
    places = [path]
    if isinstance(value, dict):
        for key, inner in value.items():
            places += _paths(inner, (*path, key))
    elif isinstance(value, list):
        for index, inner in enumerate(value[:3]):
            places += _paths(inner, (*path, index))
    return places


@st.composite
def mutated_json(draw: st.DrawFn, original: dict) -> bytes:
    """JSON with a few values replaced, removed or renamed, or damaged as text."""
    content = json.loads(json.dumps(original))
    places = [path for path in _paths(content) if path]
    for path in draw(st.lists(st.sampled_from(places), min_size=1, max_size=3)):
        holder = content
        try:
            for step in path[:-1]:
                holder = holder[step]
            match draw(st.sampled_from(["replace", "replace", "remove", "rename"])):
                case "replace":
                    holder[path[-1]] = draw(odd_values())
                case "remove":
                    del holder[path[-1]]
                case "rename":
                    holder[str(draw(st.sampled_from(ODD_TEXTS)))] = holder.pop(path[-1])
        except (KeyError, IndexError, TypeError, AttributeError):  # gone by an earlier mutation
            continue
    text = json.dumps(content).encode()
    return draw(mutated_bytes(text)) if draw(st.integers(0, 5)) == 0 else text


# ---- Observation files

NPY_HEADERS = [
    "{'descr': '|u1', 'fortran_order': False, 'shape': (1000000000000,), }",
    "{'descr': '|u1', 'fortran_order': False, 'shape': (100000, 100000, 3), }",
    "{'descr': '|u1', 'fortran_order': False, 'shape': (-16, -16, 3), }",
    "{'descr': '|u1', 'fortran_order': False, 'shape': (16, 16, True), }",
    "{'descr': '|u1', 'fortran_order': False, 'shape': (%s), }" % ("16," * 200),
    "{'descr': '|O', 'fortran_order': False, 'shape': (16, 16, 3), }",
    "{'descr': '|V2000000000', 'fortran_order': False, 'shape': (16, 16, 3), }",
    "{'descr': '|S2000000000', 'fortran_order': False, 'shape': (16, 16), }",
    "{'descr': [('a', '<f4'), ('b', '|O')], 'fortran_order': False, 'shape': (16, 16), }",
    "{'descr': ('<f4', (9999999, 99999)), 'fortran_order': False, 'shape': (), }",
    "{'descr': '<f4', 'fortran_order': 3, 'shape': (16, 16), }",
    "{'descr': '<M8[ns]', 'fortran_order': False, 'shape': (16, 16), }",
    "[1, 2]", "{}", "(" * 300 + ")" * 300, "__import__('os').system('true')", "{'descr': 1}",
]  # fmt: skip
ODD_ARRAYS = [
    np.zeros((16, 16, 3), np.uint8), np.zeros((0, 0, 3), np.uint8), np.zeros((16, 16, 4), np.uint8), np.zeros(()),
    np.zeros((16, 16), ">f8"), np.full((16, 16), np.inf, np.float32), np.full((16, 16), np.nan), np.eye(3), np.eye(4),
    np.full((16, 16), 1e300), np.full((16, 16), -1.0, np.float16), np.zeros((16, 16), complex),
    np.zeros((16, 16), bool),
    np.array([["a"] * 16] * 16), np.array([[b"a"] * 16] * 16), np.zeros((16, 16), "M8[s]"),
    np.zeros((1, 1, 3), np.uint8),
    np.zeros((16, 16), [("a", "f4")]), np.diag([0.0, 20, 1]), np.diag([-20.0, 20, 1]), np.diag([20.0, 20, 2]),
    np.array([[20.0, 5, 8], [0, 20, 8], [0, 0, 1]]), np.array([[20.0, 0, 0], [0, 20, 0], [8, 8, 1]]),
    np.array([[20.0, 0, 900], [0, 20, 8], [0, 0, 1]]), np.full((3, 3), np.nan), np.full((4, 4), np.nan),
    np.diag([1.0, 1, -1, 1]), np.diag([2.0, 2, 2, 1]), np.full((4, 4), 1e200), np.eye(4) * 2,
    np.asfortranarray(np.eye(4)),
    make_pose(np.eye(3), [1000.0, 0, 0]), make_pose(np.eye(3), [0, 0, 1e300]),
]  # fmt: skip


def observation(seed: int = 0) -> Observation:
    random = np.random.default_rng(seed)
    intrinsics = np.array([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]])
    depth = random.uniform(0.4, 1.6, (HEIGHT, WIDTH)).astype(np.float32)
    rgb = random.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    return Observation(rgb, depth, intrinsics, make_pose(np.diag([1, -1, -1]), [0.4, 0, 0.9]))


def _npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


@st.composite
def observation_files(draw: st.DrawFn) -> bytes:
    """Archives with odd arrays, lying headers, odd compression and odd names, and damaged ones."""
    real = observation()
    members = {f"{name}.npy": _npy(getattr(real, name)) for name in ("rgb", "depth", "intrinsics", "camera_pose")}
    for name in draw(st.lists(st.sampled_from(sorted(members)), max_size=2)):
        match draw(st.sampled_from(["array", "array", "header", "bytes", "remove", "other", "zeros", "object"])):
            case "array":
                members[name] = _npy(draw(st.sampled_from(ODD_ARRAYS)))
            case "header":
                text = draw(st.sampled_from(NPY_HEADERS)).encode() + b"\n"
                magic = draw(st.sampled_from([b"\x93NUMPY\x01\x00", b"\x93NUMPY\x02\x00", b"\x93NUMPY\x03\x00"]))
                members[name] = magic + struct.pack("<H" if magic[6] == 1 else "<I", len(text)) + text + bytes(100)
            case "bytes":
                members[name] = draw(mutated_bytes(members.get(name, b"")))
            case "remove":
                members.pop(name, None)
            case "other":
                members[name] = draw(other_contents())
            case "zeros":
                header = _npy(np.zeros((16, 16), np.float32))[:128].replace(b"(16, 16)", b"(9999,99999)")
                members[name] = header + bytes(2_000_000)
            case "object":
                members[name] = _npy(np.array([{"a": 1}, None], dtype=object))
    buffer = io.BytesIO()
    kinds = [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED] * 4 + [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]
    compression = draw(st.sampled_from(kinds))
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content, compression)  # without the time
    content = buffer.getvalue()
    match draw(st.sampled_from(["whole", "whole", "whole", "bytes", "other", "array"])):
        case "bytes":
            return draw(mutated_bytes(content))
        case "other":
            return draw(other_contents())
        case "array":
            return _npy(draw(st.sampled_from(ODD_ARRAYS)))
    return content


def _check_observation_values(seen: Observation) -> None:
    height, width = seen.depth.shape
    assert seen.rgb.shape == (height, width, 3)
    assert seen.rgb.dtype == np.uint8
    assert seen.depth.size
    assert seen.depth.dtype == np.float32
    assert not np.isinf(seen.depth).any()
    assert not (seen.depth < 0).any()
    assert min(seen.intrinsics[0, 0], seen.intrinsics[1, 1]) > 0
    assert np.isfinite(np.linalg.inv(seen.intrinsics)).all()
    assert np.isfinite(seen.camera_pose).all()


def check_observation(case: bytes) -> bool:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "observation.npz"
        path.write_bytes(case)
        _check_observation_values(Observation.load(path))
    return True


# ---- Plans


@cache
def plan_content() -> dict:
    random = np.random.default_rng(0)
    candidates = tuple(_trajectory(seed) for seed in range(2))
    plan = Plan(
        trajectory=_trajectory(2),
        candidates=candidates,
        weights=random.uniform(0, 1, (2, STEPS)),
        scale=random.uniform(0, 0.01, (STEPS, 10)),
        hallucinated=np.array([False, True]),
        onset=np.array([-1, 3]),
        scores=np.array([0.5, 9.0]),
        confidence=0.7,
        keypoints=random.normal(size=(4, 3)),
        pixels=random.uniform(0, 16, (4, 2)),
        keypoint_confidence=random.uniform(0, 1, 4),
        usage=Usage((Stage("keypoints", 0.1), Stage("language model", 2.0, 100, 50, 20))),
        notes=("a note",),
    )
    with tempfile.TemporaryDirectory() as folder:
        plan.save(Path(folder) / "plan.json")
        return json.loads((Path(folder) / "plan.json").read_text())


def plan_files() -> st.SearchStrategy[bytes]:
    return st.deferred(
        lambda: st.one_of(
            *[mutated_json(plan_content())] * 5, mutated_bytes(json.dumps(plan_content()).encode()), other_contents()
        )
    )


def check_plan(case: bytes) -> bool:
    """What was read can be written, and is read as the same again."""
    with tempfile.TemporaryDirectory() as folder:
        path, again = Path(folder) / "plan.json", Path(folder) / "again.json"
        path.write_bytes(case)
        plan = Plan.load(path)
        count, steps = len(plan.candidates), len(plan.trajectory)
        assert plan.weights.shape == (count, steps)
        assert plan.hallucinated.shape == plan.onset.shape == plan.scores.shape == (count,)
        assert plan.confidence is None or 0 <= plan.confidence <= 1
        plan.save(again)
        back = Plan.load(again)
        np.testing.assert_array_equal(back.trajectory.actions, plan.trajectory.actions)
        np.testing.assert_array_equal(back.weights, plan.weights)
        assert (back.usage, back.notes, back.confidence) == (plan.usage, plan.notes, plan.confidence)
    return True


# ---- Folders of demonstrations. A case is a line "KIND PATH" and the content of that file.


def _trajectory(seed: int) -> Trajectory:
    positions = np.random.default_rng(seed).normal(size=(STEPS, 3)).cumsum(axis=0) * 0.01
    poses = np.stack([make_pose(np.eye(3), position) for position in positions])
    return Trajectory.from_poses(poses, np.arange(STEPS) > STEPS // 2, TRIANGLE)


def _images(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (STEPS, HEIGHT, WIDTH, 3), dtype=np.uint8)


def _files(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


@cache
def recorded_files() -> dict[str, bytes]:
    """A folder of two episodes with images along the way, as the writer makes it."""
    with tempfile.TemporaryDirectory() as folder:
        with DatasetWriter(folder, "push-cube", "push the cube", RATE_HZ) as writer:
            for seed in range(2):
                demonstration = Demonstration(observation(seed), _trajectory(seed), RATE_HZ, "push-cube", seed)
                writer.add(demonstration, _images(seed))
            writer.discard(2)
        return _files(Path(folder))


COLUMN_VALUES = [
    lambda n: pa.array([None] * n, pa.int64()), lambda n: pa.array([-1] * n), lambda n: pa.array([0] * n),
    lambda n: pa.array([2**62] * n), lambda n: pa.array([float("nan")] * n), lambda n: pa.array([float("inf")] * n),
    lambda n: pa.array([1.5] * n), lambda n: pa.array([1e300] * n), lambda n: pa.array(["../../x"] * n),
    lambda n: pa.array([b"\xff\xfe"] * n), lambda n: pa.array([True] * n), lambda n: pa.nulls(n),
    lambda n: pa.array([[1.0] * (1 + i % 2) for i in range(n)]), lambda n: pa.array([[0.5] * 10] * n),
    lambda n: pa.array([[5.0] * 10] * n), lambda n: pa.array([[float("nan")] * 10] * n),
    lambda n: pa.array([[None] * 10] * n, pa.list_(pa.float32())), lambda n: pa.array([[]] * n, pa.list_(pa.float32())),
    lambda n: pa.array([["a"] * 10] * n), lambda n: pa.array([[[1.0]]] * n), lambda n: pa.array([{"a": 1}] * n),
    lambda n: pa.array([1] * n, pa.timestamp("ns")), lambda n: pa.array([2**50] * n, pa.timestamp("s")),
    lambda n: pa.array([1] * n, pa.date32()), lambda n: pa.array(list(range(n))), lambda n: pa.array(["{}"] * n),
    lambda n: pa.array(['{"a": [1]}'] * n), lambda n: pa.array(["[" * 5000] * n), lambda n: pa.array([[1e200] * 9] * n),
    lambda n: pa.array([[[None]]] * n, pa.list_(pa.list_(pa.float32()))),
]  # fmt: skip


@st.composite
def mutated_parquet(draw: st.DrawFn, original: bytes) -> bytes:
    """A table with columns replaced, removed, renamed or doubled, or other rows."""
    table = pq.read_table(io.BytesIO(original))
    for _ in range(draw(st.integers(1, 2))):
        index = draw(st.integers(0, table.num_columns - 1))
        name = table.column_names[index]
        match draw(st.sampled_from(["replace", "replace", "replace", "remove", "rename", "double", "rows"])):
            case "replace":
                table = table.set_column(index, name, draw(st.sampled_from(COLUMN_VALUES))(len(table)))
            case "remove" if table.num_columns > 1:
                table = table.remove_column(index)
            case "rename":
                table = table.set_column(index, draw(st.sampled_from(["", "x", "action", "a.b"])), table.column(index))
            case "double":
                table = table.append_column(name, table.column(index))
            case "rows":
                rows = draw(st.lists(st.integers(0, max(len(table) - 1, 0)), max_size=8))
                table = table.take(pa.array(rows if len(table) else [], pa.int64()))
    sink = io.BytesIO()
    pq.write_table(table, sink)
    return sink.getvalue()


def _png_of_size(width: int, height: int) -> bytes:
    """A PNG whose header declares a size that its content has not."""
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    content = b"IDAT" + zlib.compress(bytes(100))
    chunks = [header, content, b"IEND"]
    parts = [struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk)) for chunk in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


@cache
def odd_images() -> list[bytes]:
    images = [
        _png_of_size(*size) for size in ((0, 0), (16, 16), (2**31 - 1, 2**31 - 1), (20_000, 20_000), (9000, 9000))
    ]
    for mode in ("1", "L", "LA", "P", "RGB", "RGBA", "I;16", "I"):
        for size in ((WIDTH, HEIGHT), (1, 1), (64, 2)):
            for kind in ("png", "tiff") if mode == "I" else ("png", "jpeg", "gif", "bmp"):
                buffer = io.BytesIO()
                try:
                    Image.new(mode, size).save(buffer, format=kind)
                except (OSError, KeyError):  # a format that has no such images
                    continue
                images.append(buffer.getvalue())
    return images


@cache
def odd_videos() -> list[bytes]:
    random = np.random.default_rng(0)
    shapes = ((STEPS, 32, 16, 3), (STEPS - 1, HEIGHT, WIDTH, 3), (STEPS + 3, HEIGHT, WIDTH, 3), (1, 2, 2, 3))
    films = [random.integers(0, 256, shape, dtype=np.uint8) for shape in shapes]
    return [encode_video(film, rate) for film in films for rate in (RATE_HZ, 1.0, 1000.0)]


def _mutations(name: str, content: bytes) -> st.SearchStrategy[bytes]:
    """Mutations of a file by what it is."""
    damaged = mutated_bytes(content) | other_contents()
    if name.endswith(".json"):
        fitting = mutated_json(json.loads(content))
    elif name.endswith(".parquet"):
        fitting = mutated_parquet(content)
    elif name.endswith(".png"):
        fitting = st.sampled_from(odd_images())
    elif name.endswith(".mp4"):
        fitting = st.sampled_from(odd_videos())
    else:
        return damaged
    return st.one_of(fitting, fitting, fitting, damaged)


@st.composite
def _cases_of(draw: st.DrawFn, files: Callable[[], dict[str, bytes]]) -> bytes:
    name = draw(st.sampled_from(sorted(files())))
    kind = draw(st.sampled_from(["file"] * 12 + ["remove", "pipe", "socket", "folder", "outside", "loop", "device"]))
    content = draw(_mutations(name, files()[name])) if kind == "file" else b""
    return f"{kind} {name}\n".encode() + content


def folder_cases() -> st.SearchStrategy[bytes]:
    return _cases_of(recorded_files)


@contextmanager
def damaged_folder(files: dict[str, bytes], case: bytes) -> Iterator[Path]:
    """A folder with ``files``, one of them as the case says; what links lead to lies outside of it."""
    kind, name = case.split(b"\n", 1)[0].decode().split(" ", 1)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "folder"
        for other, content in files.items():
            path = folder / other
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        path = folder / name
        original = path.read_bytes()
        path.unlink()
        match kind:
            case "file":
                path.write_bytes(case.split(b"\n", 1)[1])
            case "pipe":
                os.mkfifo(path)
            case "folder":
                path.mkdir()
            case "outside":
                (Path(scratch) / "secret").write_bytes(original)
                path.symlink_to(Path(scratch) / "secret")
            case "loop":
                path.symlink_to(path)
            case "device":
                path.symlink_to("/dev/zero")
            case "socket":
                with socket.socket(socket.AF_UNIX) as server:
                    here = os.getcwd()
                    os.chdir(path.parent)  # the name of a socket is short
                    try:
                        server.bind(path.name)
                    finally:
                        os.chdir(here)
        yield folder


def check_folder(case: bytes) -> bool:
    """What is read is one of the recorded episodes, unless it is the file of frames that was changed."""
    known = [_trajectory(seed).actions.astype(np.float32) for seed in range(2)]
    with damaged_folder(recorded_files(), case) as folder:
        header = case.split(b"\n", 1)[0]
        demonstrations = load_demonstrations(folder)
        assert demonstrations
        for demonstration in demonstrations:
            _check_observation_values(demonstration.observation)
            assert 0 < demonstration.rate_hz < np.inf
            assert isinstance(demonstration.task, str)
            actions = demonstration.trajectory.actions
            assert b"data/" in header or any(np.array_equal(actions, one) for one in known)
            if demonstration.frames is not None:
                frames = list(demonstration.frames())
                assert len(frames) == len(actions)
        task = demonstrations[0].task
        with DatasetWriter(folder, task, "push the cube", RATE_HZ) as writer:
            assert writer.num_episodes == len(demonstrations)
            assert writer.last_seed is None or isinstance(writer.last_seed, int)
        never_opened = any(
            name in header for name in (b"stats.json", b"tasks.parquet", b"README.md", b"calibration.json")
        )
        assert header.startswith((b"file", b"remove")) or never_opened, "something other than a regular file was read"
    return True


# ---- Recordings of others: a robomimic file, a ManiSkill file, a LeRobot folder


@cache
def foreign_files() -> dict[str, bytes]:
    seen, path = observation(), _trajectory(0)
    poses = TRIANGLE.poses(path.triplets[:, 0])
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    command = 2 * path.gripper_state - 1
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        with h5py.File(folder / "robomimic.hdf5", "w") as file:
            data = file.create_group("data")
            settings = {"env_name": "Lift", "env_type": 1, "env_kwargs": {"robots": ["Panda"], "control_freq": 20}}
            data.attrs["env_args"] = json.dumps(settings)
            group = data.create_group("demo_0")
            group["actions"] = np.hstack([np.zeros((STEPS, 6)), command])
            group["obs/robot0_eef_pos"], group["obs/robot0_eef_quat"] = poses[:, :3, 3], quaternions
            group["obs/agentview_image"] = np.tile(seen.rgb, (STEPS, 1, 1, 1))
            group["obs/agentview_depth"] = np.tile(seen.depth[..., None], (STEPS, 1, 1, 1))
            camera = {"intrinsics": seen.intrinsics.tolist(), "extrinsics": seen.camera_pose.tolist()}
            group.attrs["camera_info"] = json.dumps({"agentview": camera})
        with h5py.File(folder / "maniskill.h5", "w") as file:
            group = file.create_group("traj_0")
            group["actions"] = np.hstack([np.zeros((STEPS - 1, 6)), command[1:]])
            group["obs/extra/tcp_pose"] = np.hstack([poses[:, :3, 3], quaternions[:, [3, 0, 1, 2]]])
            group["obs/sensor_data/top/rgb"] = np.tile(seen.rgb, (STEPS, 1, 1, 1))
            group["obs/sensor_data/top/depth"] = np.full((STEPS, HEIGHT, WIDTH, 1), 800, np.int16)
            group["obs/sensor_param/top/intrinsic_cv"] = np.tile(seen.intrinsics, (STEPS, 1, 1))
            group["obs/sensor_param/top/extrinsic_cv"] = np.tile(np.eye(4)[:3], (STEPS, 1, 1))
        described = {
            "env_info": {"env_kwargs": {"robot_uids": "panda", "sim_config": {"control_freq": 20}}},
            "episodes": [{"episode_id": 0, "episode_seed": 3, "success": True}],
        }
        (folder / "maniskill.json").write_text(json.dumps(described))
        _write_lerobot(folder / "lerobot", poses, path)
        return _files(folder)


def _write_lerobot(folder: Path, poses: np.ndarray, path: Trajectory) -> None:
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
    state = np.hstack([poses[:, :3, 3], turns, 100 * (1 - path.gripper_state)])
    png = recorded_files()["start/rgb/chunk-000/file-000.png"]
    columns = {
        "observation.state": pa.array(state.tolist()),
        "observation.depth": pa.array(np.full((STEPS, HEIGHT, WIDTH), 800).tolist()),
        "observation.image": pa.array([{"bytes": png, "path": "frame.png"}] * STEPS),
        "frame_index": np.arange(STEPS),
        "episode_index": np.zeros(STEPS, int),
    }
    rows = {
        "episode_index": [0],
        "tasks": [["push"]],
        "length": [STEPS],
        "data/chunk_index": [0],
        "data/file_index": [0],
    }
    names = ["ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz", "ee.gripper_pos"]
    info = {
        "codebase_version": "v3.0",
        "total_episodes": 1,
        "total_frames": STEPS,
        "fps": 20,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": {
            "observation.state": {"dtype": "float32", "shape": [7], "names": names},
            "observation.depth": {"dtype": "uint16", "shape": [HEIGHT, WIDTH], "names": None},
            "observation.image": {"dtype": "image", "shape": [HEIGHT, WIDTH, 3], "names": None},
        },
    }
    for place, table in (("data/chunk-000", columns), ("meta/episodes/chunk-000", rows)):
        (folder / place).mkdir(parents=True)
        pq.write_table(pa.table(table), folder / place / "file-000.parquet")
    (folder / "meta/info.json").write_text(json.dumps(info))


HDF5_VALUES = [
    np.zeros(()), np.zeros(0), np.zeros((STEPS, 7)), np.full((STEPS, 7), np.nan), np.zeros((2, 3, 3)),
    np.zeros((STEPS, 4)),
    np.zeros((STEPS, 16, 16, 3), np.uint8), np.full((STEPS, 16, 16, 1), np.inf, np.float32), np.zeros((1, 1, 1, 1)),
    np.zeros((STEPS, 3), complex), np.array([b"a"] * STEPS), np.zeros(STEPS, [("a", "f4")]), np.full((STEPS, 3), 1e300),
    np.full((STEPS, 4), 1e300), np.zeros((STEPS, 1)), np.full((STEPS, 7), 1e300), np.ones((STEPS, 3, 4)),
    np.ones((STEPS, 4, 4)),
]  # fmt: skip


@st.composite
def mutated_hdf5(draw: st.DrawFn, original: bytes) -> bytes:
    """A file with datasets or attributes replaced, removed, linked to other files or declared huge."""
    buffer = io.BytesIO(original)
    with h5py.File(buffer, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        for name in draw(st.lists(st.sampled_from(names), min_size=1, max_size=2)):
            try:
                attributes = file[name].attrs
            except (KeyError, RuntimeError):  # gone by an earlier mutation, or a link that leads nowhere
                continue
            match draw(
                st.sampled_from(["replace", "replace", "remove", "link", "soft", "huge", "virtual", "stored", "text"])
            ):
                case "text" if len(attributes):
                    key = draw(st.sampled_from(sorted(attributes)))
                    try:
                        known = json.loads(attributes[key])
                    except ValueError:  # damaged by an earlier mutation
                        continue
                    text = draw(mutated_json(known)).decode(errors="replace")
                    attributes[key] = text.replace("\0", "")[:15_000]  # HDF5 takes no null and 64 KiB of UTF-8
                    continue
                case "replace":
                    value = draw(st.sampled_from(HDF5_VALUES))
                    del file[name]
                    file[name] = value
                case "remove":
                    del file[name]
                case "link":
                    del file[name]
                    file[name] = h5py.ExternalLink("/etc/passwd", "/data")
                case "soft":
                    del file[name]
                    file[name] = h5py.SoftLink(draw(st.sampled_from(["/", "/data", "/nowhere", name])))
                case "huge":
                    del file[name]
                    file.create_dataset(name, shape=(10**6,) * draw(st.integers(1, 4)), dtype="f8", chunks=True)
                case "virtual":
                    del file[name]
                    layout = h5py.VirtualLayout((STEPS, 3), "f8")
                    layout[:] = h5py.VirtualSource("/tmp/other.h5", "data", (STEPS, 3))
                    file.create_virtual_dataset(name, layout)
                case "stored":
                    del file[name]
                    file.create_dataset(name, (STEPS, 3), "f8", external=[("/etc/passwd", 0, STEPS * 24)])
    return buffer.getvalue()


@st.composite
def import_cases(draw: st.DrawFn) -> bytes:
    name = draw(st.sampled_from(sorted(foreign_files())))
    content = foreign_files()[name]
    if name.endswith((".h5", ".hdf5")):
        fitting = mutated_hdf5(content)
        strategy = st.one_of(fitting, fitting, mutated_bytes(content), other_contents())
    else:
        strategy = _mutations(name, content)
    kind = draw(st.sampled_from(["file"] * 12 + ["remove", "pipe", "folder", "outside", "loop", "device"]))
    return f"{kind} {name}\n".encode() + (draw(strategy) if kind == "file" else b"")


def check_import(case: bytes) -> bool:
    seen = observation()
    rig = Rig(
        TRIANGLE,
        intrinsics=seen.intrinsics,
        camera_pose=seen.camera_pose,
        tool=np.eye(4),
        gripper=GripperCommand(open=100, closed=0),
        depth_key="observation.depth",
        depth_unit_m=1e-3,
    )
    with damaged_folder(foreign_files(), case) as folder:
        top = case.split(b"\n", 1)[0].split(b" ", 1)[1].decode().split("/")[0]
        source = folder / (top if top != "maniskill.json" else "maniskill.h5")
        for demonstration in import_demonstrations(source, "push-cube", rig if top == "lerobot" else Rig(TRIANGLE)):
            _check_observation_values(demonstration.observation)
            assert 0 < demonstration.rate_hz < np.inf
            assert np.isfinite(demonstration.trajectory.actions).all()
    return True


# ---- Answers of language models. A case is the text; what must come of it follows from the text alone.

COLUMNS = 10
NUMBERS = re.compile(r"[+-]?\d+(?:\.\d+)?")


@cache
def prompts() -> list[Prompt]:
    """One of each form, fitted to the same demonstrations."""
    random = np.random.default_rng(0)
    keypoints = random.uniform(-0.3, 0.3, (4, 4, 3))
    trajectories = [_trajectory(seed) for seed in range(4)]
    forms = [("world", "sequence"), ("adaptive", "sequence"), ("world", "factorised"), ("adaptive", "factorised")]
    return [write_prompt(keypoints, trajectories, frames, layout) for frames, layout in forms]


@st.composite
def answers(draw: st.DrawFn) -> bytes:
    """Rows of numbers in the forms that models write them in, and damaged ones."""
    count = draw(st.sampled_from([1, 2, STEPS - 1, STEPS, STEPS + 1, 40]))
    number = st.integers(-900, 900) | st.sampled_from([0, 1, -0, 99999, 10**7, 0.5, -1.25, 1e30])
    lines = []
    for _ in range(count):
        row = [draw(number) for _ in range(draw(st.sampled_from([COLUMNS] * 8 + [COLUMNS - 1, COLUMNS + 1, 1, 4])))]
        row[-1] = draw(st.sampled_from([0, 1, 1, 2, -1]))
        separator = draw(st.sampled_from([" "] * 6 + [", ", ",", "\t", " ; ", "|"]))
        form = draw(
            st.sampled_from(["{}"] * 6 + ["[{}]", "({})", "[[{}]]", "step 3: {}", "- {}", "{}.", "**{}**", "`{}`"])
        )
        lines.append(form.format(separator.join(map(str, row))))
    before = draw(
        st.sampled_from([""] * 4 + ["Here it is:\n", "```\n", "<think>\n1 2 3\n</think>\n", "The 10 steps are\n"])
    )
    text = (
        before
        + draw(st.sampled_from(["\n"] * 6 + ["\n\n", "; ", "], ["])).join(lines)
        + draw(st.sampled_from(["", "\n```", "\nDone"]))
    )
    match draw(st.sampled_from(["whole"] * 4 + ["bytes", "text", "long"])):
        case "bytes":
            return draw(mutated_bytes(text.encode()))
        case "text":
            return draw(st.text(max_size=300)).encode(errors="replace")
        case "long":
            return (text + "\n").encode() * draw(st.sampled_from([100, 1000]))
    return text.encode()


def check_answer(case: bytes) -> bool:
    """Every number that is read stands in the text, and an answer that is accepted gives a trajectory."""
    text = case.decode(errors="replace")
    row, rows = read_row(text, COLUMNS), read_rows(text, COLUMNS)
    plain = text.translate(str.maketrans(dict.fromkeys("−–—‒﹣－", "-")))
    there = {float(number) for number in NUMBERS.findall(plain)} | {-float(number) for number in NUMBERS.findall(plain)}
    for read in (row, rows):
        assert read is None or (np.isfinite(read).all() and set(np.ravel(read)) <= there)
    if rows is not None and np.array_equal(rows, np.round(rows)):
        written = "\n".join(write_row(one) for one in rows)
        np.testing.assert_array_equal(read_rows(written, COLUMNS), rows)
    scene = np.random.default_rng(1).uniform(-0.3, 0.3, (4, 3))
    for prompt in prompts():
        count = len(prompt.queries(scene))
        value = prompt.read(0, text) if count else None
        if value is not None and count == 1:
            assert np.isfinite(prompt.trajectory([value], scene).actions).all()
    return rows is not None


TARGETS = {
    name: Target(name, cases.map(Case), check)
    for name, cases, check in (
        ("observations", observation_files(), check_observation),
        ("datasets", folder_cases(), check_folder),
        ("imports", import_cases(), check_import),
        ("plans", plan_files(), check_plan),
        ("answers", answers(), check_answer),
    )
}
