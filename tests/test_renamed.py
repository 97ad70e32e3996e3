"""Old spellings of public names: they work for one version, with a warning."""

import importlib

import numpy as np
import pytest

from robust_instant_policy.errors import UsageError
from robust_instant_policy.regression import StudentTRegression, robust_gripper_trajectory


@pytest.mark.parametrize(
    ("package", "old", "module", "new"),
    [
        ("policies", "KeypointContext", "policies", "Settings"),
        ("policies", "InstantPolicy", "policies", "KeypointActionTokens"),
        ("datasets", "write_page", "reporting.demonstrations", "write_page"),
        ("perception", "keypoints_page", "reporting.keypoints", "keypoints_page"),
    ],
)
def test_an_old_name_is_the_new_one(package, old, module, new):
    with pytest.warns(DeprecationWarning, match=f"{old} is .*{module}.{new} now"):
        found = getattr(importlib.import_module(f"robust_instant_policy.{package}"), old)
    assert found is getattr(importlib.import_module(f"robust_instant_policy.{module}"), new)


def test_a_name_that_never_was_is_no_attribute():
    for package in ("policies", "datasets", "perception"):
        with pytest.raises(AttributeError, match=f"{package}' has no attribute 'nosuch'"):
            importlib.import_module(f"robust_instant_policy.{package}").nosuch  # noqa: B018


def test_the_old_name_of_curvature():
    candidates = [np.random.default_rng(q).normal(0, 0.01, (12, 3)) for q in range(4)]
    new = StudentTRegression(groups=np.zeros(3), curvature=[0.01, 0.02]).fit(candidates)
    with pytest.warns(DeprecationWarning, match="curvature"):
        old = StudentTRegression(groups=np.zeros(3), bends=[0.01, 0.02]).fit(candidates)
    assert np.array_equal(old.mean(), new.mean())
    with pytest.raises(UsageError, match="curvature"), pytest.warns(DeprecationWarning, match="bends"):
        StudentTRegression(curvature=[0.01, 0.02], bends=[0.01, 0.02])
    with pytest.raises(UsageError, match="curvature"), pytest.warns(DeprecationWarning, match="bends"):
        robust_gripper_trajectory([np.zeros((4, 10))], curvature=[0.01, 0.02], bends=[0.01, 0.02])
