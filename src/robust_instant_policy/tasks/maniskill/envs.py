"""Importing this module registers the environments with gymnasium: ``gymnasium.make("RIP-PushCube-v1")``."""

from robust_instant_policy.tasks.maniskill import (  # noqa: F401  (each registers its own)
    close_cabinet,
    open_drawer,
    pick_banana,
    push_cube,
    push_cube_anywhere,
    sort,
    stack,
    turn_faucet,
    wipe,
)
