"""Student's t-regression: what several candidate trajectories agree on, and which of them are hallucinated."""

from robust_instant_policy.regression.diagnosis import Diagnosis, diagnose
from robust_instant_policy.regression.gripper import RobustTrajectory, robust_gripper_trajectory
from robust_instant_policy.regression.mixture import StudentTMixture
from robust_instant_policy.regression.network import StudentTNetwork
from robust_instant_policy.regression.student_t import StudentTRegression

__all__ = [
    "Diagnosis",
    "RobustTrajectory",
    "StudentTMixture",
    "StudentTNetwork",
    "StudentTRegression",
    "diagnose",
    "robust_gripper_trajectory",
]
