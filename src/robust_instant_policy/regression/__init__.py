"""Student's t-regression: what several candidate trajectories agree on, and which of them are hallucinated."""

from robust_instant_policy.regression.diagnosis import Diagnosis, diagnose
from robust_instant_policy.regression.em import DEFAULT_DOF, fit_numbers
from robust_instant_policy.regression.gripper import RobustTrajectory, robust_gripper_trajectory
from robust_instant_policy.regression.mixture import StudentTMixture
from robust_instant_policy.regression.network import StudentTNetwork
from robust_instant_policy.regression.numbers import StudentTNumbers
from robust_instant_policy.regression.student_t import StudentTRegression

__all__ = [
    "DEFAULT_DOF",
    "Diagnosis",
    "RobustTrajectory",
    "StudentTMixture",
    "StudentTNetwork",
    "StudentTNumbers",
    "StudentTRegression",
    "diagnose",
    "fit_numbers",
    "robust_gripper_trajectory",
]
