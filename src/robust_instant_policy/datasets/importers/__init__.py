"""Demonstrations that others have: ManiSkill trajectory files, robomimic HDF5, LeRobot datasets.

What such a file lacks for a demonstration is said, all of it at once, and never made up; what the user knows
besides can be given.
"""

from robust_instant_policy.datasets.importers.convert import convert_demonstrations, import_demonstrations
from robust_instant_policy.datasets.importers.source import GripperCommand, Rig

__all__ = ["GripperCommand", "Rig", "convert_demonstrations", "import_demonstrations"]
