"""ManiSkill's own tasks of the Panda that need no download."""

from robust_instant_policy.tasks.benchmark import Benchmark

PREFIX = "maniskill/"


def _tasks(names: str) -> tuple[str, ...]:
    return tuple(f"{PREFIX}{name}" for name in names.split())


MANISKILL = Benchmark(
    "maniskill",
    groups={
        "without a grasp": _tasks("PushCube PullCube RollBall"),
        "pick and place": _tasks("PickCube StackCube PlaceSphere StackPyramid"),
        "turn, insert, tool": _tasks("LiftPegUpright PegInsertionSide PullCubeTool"),
    },
    protocol=(
        "Scenes, robot, controller and success (at any step) are ManiSkill's; the camera is ours, does not see the "
        "arm, and shows the goals that ManiSkill draws for people only; the demonstrators are ours; the number of "
        "steps is not limited."
    ),
)
