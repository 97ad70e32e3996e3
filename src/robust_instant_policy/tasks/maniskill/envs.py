"""Importing this module registers the environments with gymnasium: ``gymnasium.make("RIP-PushCube-v1")``."""

from robust_instant_policy.tasks.maniskill.close_cabinet import CloseCabinetEnv
from robust_instant_policy.tasks.maniskill.open_drawer import OpenDrawerEnv
from robust_instant_policy.tasks.maniskill.pick_banana import PickBananaEnv
from robust_instant_policy.tasks.maniskill.push_cube import PushCubeEnv
from robust_instant_policy.tasks.maniskill.push_cube_anywhere import PushCubeAnywhereEnv
from robust_instant_policy.tasks.maniskill.sort import SortEnv
from robust_instant_policy.tasks.maniskill.stack import StackEnv
from robust_instant_policy.tasks.maniskill.turn_faucet import TurnFaucetEnv
from robust_instant_policy.tasks.maniskill.wipe import WipeEnv

__all__ = [
    "CloseCabinetEnv",
    "OpenDrawerEnv",
    "PickBananaEnv",
    "PushCubeAnywhereEnv",
    "PushCubeEnv",
    "SortEnv",
    "StackEnv",
    "TurnFaucetEnv",
    "WipeEnv",
]
