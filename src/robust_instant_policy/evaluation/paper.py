"""The numbers that the paper prints, in percent, to stand beside one's own (Oh et al. 2025)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robust_instant_policy.evaluation.variant import PAPER_CONFIGS, Variant
from robust_instant_policy.tasks.level import PAPER

if TYPE_CHECKING:  # suites name the tasks of Table I
    from robust_instant_policy.evaluation.statistics import Summary

# Table I: success rates with 10 demonstrations and GPT-4o.
TABLE1_TASKS = (
    "pick-banana", "push-cube", "open-drawer", "close-cabinet", "turn-faucet",
    "aloha-pick-banana", "aloha-hang", "aloha-sweep", "aloha-pick-place", "aloha-cup-upright",
)  # fmt: skip
TABLE1 = {
    "dp": (40, 30, 60, 100, 70, 60, 30, 40, 10, 60),
    "kat-dp": (60, 40, 20, 70, 60, 100, 50, 20, 30, 70),
    "kat": (48, 74, 42, 90, 78, 80, 50, 10, 30, 40),
    "rip-gauss": (40, 70, 50, 90, 90, 70, 60, 60, 40, 70),
    "rip": (60, 100, 70, 100, 90, 100, 90, 70, 50, 70),
}
# Sec. V-B.2, over the five tasks with gripper actions: normal and gripper-based downsampling.
DOWNSAMPLING = {"uniform": 52, "masked": 74}


def is_told(summary: Summary) -> bool:
    """Whether the paper's numbers may stand beside those of ``summary``: scenes of the paper's level, and some variants
    in its configuration.
    """
    return summary.suite.level == PAPER.name and any(one.config in PAPER_CONFIGS for one in summary.variants)


def told(summary: Summary, variant: Variant, task: str) -> int | None:
    """The paper's success rate in percent for a ``variant`` of ``summary`` with the settings of Table I, or of a method
    (such as dp) that is the same in all configurations and stands beside ones in the paper's; else None.
    """
    same = not variant.config or (variant.config in PAPER_CONFIGS and _is_of_table1(variant))
    return table1(variant.method, task) if same and is_told(summary) else None


def _is_of_table1(variant: Variant) -> bool:
    """Whether it has the paper's number of demonstrations and samples, ν and downsampling."""
    usual = Variant(variant.method)
    return all(getattr(variant, name) == getattr(usual, name) for name in ("demos", "queries", "dof", "downsampling"))


def table1(method: str, task: str) -> int | None:
    """The paper's success rate in percent; None where it has none."""
    return dict(zip(TABLE1_TASKS, TABLE1[method], strict=True)).get(task) if method in TABLE1 else None
