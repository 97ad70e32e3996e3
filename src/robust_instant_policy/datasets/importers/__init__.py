"""Importing recordings: ManiSkill trajectory files, robomimic HDF5 files, LeRobot datasets.

An error lists all data that a file lacks; nothing is assumed. The user can supply missing data.
"""

from robust_instant_policy.datasets.importers.convert import convert_demonstrations, import_demonstrations
from robust_instant_policy.datasets.importers.joints import JointModel
from robust_instant_policy.datasets.importers.source import GripperCommand, Rig

__all__ = ["GripperCommand", "JointModel", "Rig", "convert_demonstrations", "import_demonstrations"]
