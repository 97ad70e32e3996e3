"""`rip calibrate`: the board to print, the camera, a gripper, a leader arm."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from robust_instant_policy.commands.console import StageConsole
from robust_instant_policy.commands.options import positive
from robust_instant_policy.errors import CellError, UsageError
from robust_instant_policy.files import write_whole
from robust_instant_policy.geometry import make_pose
from robust_instant_policy.robots.calibration import (
    Board,
    BoardPlace,
    CameraCalibration,
    calibrate_tool,
    in_hand,
    on_table,
    pivot,
    touched_place,
)
from robust_instant_policy.robots.calibration.guided import Guide, copied_turns, photograph_places
from robust_instant_policy.robots.camera import Camera
from robust_instant_policy.robots.cameras import make_camera
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.device import connected
from robust_instant_policy.robots.emulation.client import devices_of
from robust_instant_policy.robots.execution import park
from robust_instant_policy.robots.leaders import joint_source, make_leader
from robust_instant_policy.robots.operator import Terminal
from robust_instant_policy.robots.signals import stop_on_signals
from robust_instant_policy.robots.station import Station

DIRECTIONS = (
    "straight down", "tilted forward", "tilted back", "tilted left", "tilted right", "turned by a quarter",
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(required=True, metavar="WHAT")
    usual = Board()
    board = type(parser)(add_help=False)
    board.add_argument("--columns", type=positive, default=usual.columns, help="squares")
    board.add_argument("--rows", type=positive, default=usual.rows, help="squares")
    board.add_argument("--square", type=float, default=usual.square_m, metavar="M", help="edge in metres")
    board.add_argument("--marker", type=float, default=usual.marker_m, metavar="M", help="edge in metres")
    board.add_argument("--dictionary", default=usual.dictionary, help="of the markers")
    cell = type(parser)(add_help=False)
    cell.add_argument("--robot", type=Path, required=True, metavar="FILE", help="file of the cell")

    printed = actions.add_parser("board", parents=[board], help="write the board to print")
    printed.add_argument("--out", type=Path, default=Path("board.pdf"), help=".pdf or .png")
    printed.set_defaults(action=_board)

    camera = actions.add_parser("camera", parents=[cell, board], help="camera to world, with a printed board")
    how = camera.add_mutually_exclusive_group()
    how.add_argument("--touch", metavar="ARM", help="touch the board's corners with this arm (default: the first)")
    how.add_argument("--place", type=float, nargs=4, metavar=("X", "Y", "Z", "YAW"),
                     help="corner A of the board, metres in the world, and the direction A to B, degrees")  # fmt: skip
    how.add_argument("--in-hand", metavar="ARM", help="this arm holds the board")
    camera.add_argument("--places", type=positive, default=6, help="of the board on the table")
    camera.add_argument("--poses", type=positive, default=12, help="of the board in the hand")
    camera.set_defaults(action=_camera)

    tool = actions.add_parser("tool", parents=[cell], help="fingertips and opening of a gripper")
    tool.add_argument("--arm", help="name of the arm (default: the first)")
    tool.add_argument("--out", type=Path, required=True, metavar="FILE", help="the arm's gripper file")
    tool.set_defaults(action=_tool)

    leader = actions.add_parser("leader", parents=[cell], help="joints, signs and offsets of a leader arm")
    leader.add_argument("--arm", help="name of the follower (default: the first)")
    leader.set_defaults(action=_leader)


def run(options: argparse.Namespace) -> int:
    options.action(options)
    return 0


def _board(options: argparse.Namespace) -> None:
    kind = options.out.suffix.lstrip(".").lower()
    if kind not in ("pdf", "png"):
        raise UsageError(f"--out must end in .pdf or .png, not {options.out.name}")
    board = _the_board(options)
    write_whole(options.out, board.page(kind))
    width, height = board.size
    print(
        f"{options.out}: {1e3 * width:.0f} x {1e3 * height:.0f} mm; print without scaling, measure the ruler, and glue "
        "it onto something flat and stiff"
    )


def _camera(options: argparse.Namespace) -> None:
    with _open(options.robot) as cell, ExitStack() as stack:
        file = cell.config.camera_calibration
        if file is None or cell.config.camera is None:
            raise CellError(f'{options.robot}: give the table [camera] calibration = "camera.toml", the file to write')
        board = _the_board(options)
        with cell.terminal.stop.ends_waiting():
            camera = stack.enter_context(connected(make_camera(cell.config.camera, cell.config.path.parent)))
        result = _calibrated(options, cell, camera, board)
    result.save(file)
    print(f"{file}: {result.method}, reprojection error {result.reprojection_px:.2f} px")
    print(f"  left out one by one: {_millimetres(result.left_out_mm)}")
    if result.touched_mm:
        print(f"  touched corners, left out one by one: {_millimetres(result.touched_mm)}")
    if result.depth_scale is None:
        print("  the depth image has too few readings on the board: its unit was not checked")
    else:
        print(f"  depth is {result.depth_scale:.3f} times the board's distance")


def _calibrated(options: argparse.Namespace, cell: _Cell, camera: Camera, board: Board) -> CameraCalibration:
    if options.in_hand:
        with cell.guide(options.in_hand) as guide:
            return in_hand(camera.name, *guide.held_board(camera, board, options.poses), board)
    if options.place:
        x, y, z, yaw = options.place
        turned = Rotation.from_euler("z", yaw, degrees=True).as_matrix()
        place = BoardPlace(make_pose(turned, [x, y, z]), "its stated place")
    else:
        words = [f"close the gripper and touch corner {corner} of the board's pattern" for corner in "ABCD"]
        with cell.guide(options.touch) as guide:
            place = touched_place(guide.poses(words)[:, :3, 3], board)
            cell.park()
    return on_table(camera.name, photograph_places(camera, board, options.places, cell.terminal), board, place)


def _tool(options: argparse.Namespace) -> None:
    with _open(options.robot) as cell:
        with cell.guide(options.arm) as guide:
            touches = []
            for finger in ("on the side of the tool's y", "on the other side"):
                words = [f"open the gripper; touch a fixed point with the finger {finger}, {way}" for way in DIRECTIONS]
                touches.append(pivot(guide.poses(words)))
            index = cell.index(options.arm)
            travels = []
            for what in ("open", "close"):
                guide.poses([f"{what} the gripper, free in the air"])
                travels.append(cell.station.states()[index].finger_travel)
        arm = cell.station.arms[index]
        result = calibrate_tool(arm.name, touches[0], touches[1], arm.triangle.length, travels[1], travels[0])
    result.save(options.out)
    moved = 1e3 * float(np.linalg.norm(result.tool[:3, 3]))
    print(f"  the tool is {moved:.1f} mm from where the arm's model has it")
    print(f"{options.out}: length {result.length:.4f} m, opening {result.opening:.4f} m")
    print(f"  touches, left out one by one: {_millimetres(result.left_out_mm)}")
    print(f'  put gripper = "{options.out}" (relative to {options.robot.name}) into the table of the arm {arm.name}')


def _leader(options: argparse.Namespace) -> None:
    with _open(options.robot) as cell, ExitStack() as stack:
        index = cell.index(options.arm)
        arm = cell.config.arms[index]
        source = joint_source(arm)
        file = arm.leader.options.get("calibration") if arm.leader is not None else None
        if not file:
            raise CellError(
                f'{options.robot}: give the leader of {arm.name} calibration = "leader.toml", the file to write'
            )
        with cell.terminal.stop.ends_waiting():
            stack.enter_context(cell.station)
            stack.enter_context(connected(source))
        cell.park()
        joints = copied_turns(cell.station, source, index, cell.terminal)
    joints.save(cell.config.path.parent / str(file))
    print(f"{file}: channels {joints.channels.tolist()}, signs {joints.signs.astype(int).tolist()}")


@dataclass(frozen=True, eq=False)
class _Cell:
    """The cell and the person; the arms are connected only where they are needed."""

    config: CellConfig
    station: Station
    terminal: Terminal

    def index(self, name: str | None) -> int:
        names = [arm.name for arm in self.config.arms]
        if name is not None and name not in names:
            raise UsageError(f"no arm {name!r} in {self.config.path}; it has {', '.join(names)}")
        return names.index(name) if name else 0

    @contextmanager
    def guide(self, name: str | None) -> Iterator[Guide]:
        """Connects the arms, and the leader of the arm ``name``."""
        index = self.index(name)
        arm = self.config.arms[index]
        leader = make_leader(
            arm, self.station.arms[index], self.station.rate_hz, self.config.path.parent, self.terminal.pressed
        )
        with ExitStack() as stack:
            with self.terminal.stop.ends_waiting():
                stack.enter_context(self.station)
                stack.enter_context(connected(leader))
            yield Guide(self.station, leader, index, self.terminal)

    def park(self) -> None:
        self.terminal.say("the arms go to their park pose")
        park(self.station, self.terminal.stop, self.config.first_run_speed).require_end()


@contextmanager
def _open(robot: Path) -> Iterator[_Cell]:
    with ExitStack() as stack:
        config, _ = stack.enter_context(devices_of(CellConfig.load(robot)))
        terminal = stack.enter_context(Terminal(stack.enter_context(stop_on_signals()), StageConsole().say))
        yield _Cell(config, Station(config), terminal)


def _the_board(options: argparse.Namespace) -> Board:
    return Board(options.columns, options.rows, options.square, options.marker, options.dictionary)


def _millimetres(errors: tuple[float, ...]) -> str:
    return f"median {np.median(errors):.1f} mm, largest {max(errors):.1f} mm ({len(errors)})" if errors else "none"
