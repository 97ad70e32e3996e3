"""Leaders, each behind the protocol of `robots.leader`: leader arms, a keyboard, a gamepad, a SpaceMouse."""

from collections.abc import Callable
from pathlib import Path

from robust_instant_policy.errors import CellError
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.robots.cameras import made_by
from robust_instant_policy.robots.cell import ArmConfig
from robust_instant_policy.robots.leader import Leader
from robust_instant_policy.robots.leaders.arm_leader import ArmLeader, JointSource
from robust_instant_policy.robots.leaders.gamepad import GamepadSource
from robust_instant_policy.robots.leaders.jog import JogLeader, JogSource, KeyboardSource
from robust_instant_policy.robots.leaders.joint_map import JointMap
from robust_instant_policy.robots.leaders.lerobot_source import LeRobotSource
from robust_instant_policy.robots.leaders.spacemouse import SpaceMouseSource

__all__ = ["ArmLeader", "JogLeader", "JointMap", "joint_source", "make_leader"]

ARM_KINDS = ("aloha", "gello", "lerobot")
JOG_KINDS = ("keyboard", "gamepad", "spacemouse")


def make_leader(config: ArmConfig, arm: Arm, rate_hz: float, folder: Path, pressed: Callable[[str], str]) -> Leader:
    """The leader of an arm of a cell, not connected; ``folder`` has the cell's file, ``pressed`` is `Operator.pressed`.

    Raises `CellError` for an unknown kind or key, and for a leader that is not calibrated.
    """
    if config.leader is None:
        raise CellError(f'{config.name} has no leader: give it a table, such as leader = {{ kind = "keyboard" }}')
    section, kind = config.leader.section(), config.leader.kind
    if kind in JOG_KINDS:
        jog: JogSource = KeyboardSource(pressed)
        if kind == "gamepad":
            jog = GamepadSource(section.text("device", "/dev/input/js0"), rate_hz)
        elif kind == "spacemouse":
            jog = SpaceMouseSource(section.text("device", ""), rate_hz)
        section.finish()
        return JogLeader(jog, arm)
    source = joint_source(config)  # raises for an unknown kind, too
    file = section.text("calibration", "")
    return ArmLeader(source, _joint_map(kind, file, folder, config.name, len(arm.home)), arm.finger_travel)


def joint_source(config: ArmConfig) -> JointSource:
    """The device of a leader arm, without its calibration. Raises `CellError` for another kind of leader."""
    if config.leader is None or config.leader.kind not in ARM_KINDS:
        kind = "no leader" if config.leader is None else f"a leader of kind {config.leader.kind!r}"
        raise CellError(
            f"{config.name} has {kind}; leader arms are {', '.join(ARM_KINDS)}, others: {', '.join(JOG_KINDS)}"
        )
    section, kind, name = config.leader.section(), config.leader.kind, f"leader of {config.name}"
    section.text("calibration", "")
    source: JointSource
    if kind == "lerobot":
        device = made_by(section.text("factory"), config.leader.where)
        unit = section.text("unit", "degrees", ("degrees", "radians"))
        source = LeRobotSource(name, device, section.text("keys").split(), unit == "degrees")
    else:
        from robust_instant_policy.robots.leaders import dynamixel_source as servos

        usual = servos.ALOHA_SERVOS if kind == "aloha" else servos.GELLO_SERVOS
        baud = section.whole("baud", 1_000_000 if kind == "aloha" else 57_600, least=1)
        wanted = section.array("servos", (None,), usual)
        numbers = wanted.astype(int).tolist()
        if (wanted != numbers).any() or len(set(numbers)) < len(numbers) or not 0 <= min(numbers) <= max(numbers) < 253:
            raise section.error("servos", "must be different whole numbers from 0 to 252, the IDs of the servos")
        timeout_ms = section.number("timeout_ms", servos.TIMEOUT_MS, 1.0, 1e3)
        source = servos.DynamixelSource(name, section.text("port"), baud, numbers, timeout_ms)
    section.finish()
    return source


def _joint_map(kind: str, file: str, folder: Path, name: str, num_joints: int) -> JointMap:
    if not file and kind == "aloha":
        from robust_instant_policy.robots.leaders.dynamixel_source import aloha_map

        return aloha_map()
    path = folder / file
    if not file or not path.exists():
        raise CellError(
            f'the leader of {name} is not calibrated: give its table calibration = "leader.toml", and run: '
            f"rip calibrate leader --robot FILE --arm {name}"
        )
    joints = JointMap.load(path)
    if len(joints.channels) != num_joints:
        raise CellError(f"{path} is of a leader with {len(joints.channels)} joints; {name} has {num_joints}")
    return joints
