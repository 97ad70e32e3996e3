"""Importing this module registers the five environments with gymnasium: ``gymnasium.make("RIP-PushCube-v1")``."""

from robust_instant_policy.tasks.maniskill.close_cabinet import CloseCabinetEnv
from robust_instant_policy.tasks.maniskill.open_drawer import OpenDrawerEnv
from robust_instant_policy.tasks.maniskill.pick_banana import PickBananaEnv
from robust_instant_policy.tasks.maniskill.push_cube import PushCubeEnv
from robust_instant_policy.tasks.maniskill.turn_faucet import TurnFaucetEnv

__all__ = ["CloseCabinetEnv", "OpenDrawerEnv", "PickBananaEnv", "PushCubeEnv", "TurnFaucetEnv"]
