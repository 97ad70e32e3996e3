"""Importing recordings: ManiSkill trajectory files, robomimic HDF5 files, LeRobot datasets.

If a file lacks data of a demonstration, an error lists all of it; nothing is assumed. The user can supply missing data.
"""

from robust_instant_policy.datasets.importers.convert import convert_demonstrations, import_demonstrations
from robust_instant_policy.datasets.importers.joints import JointModel
from robust_instant_policy.datasets.importers.source import GripperCommand, Rig

__all__ = ["GripperCommand", "JointModel", "Rig", "convert_demonstrations", "import_demonstrations"]
