"""Which of the paper's numbers may stand beside rows of one's own."""

from __future__ import annotations

from robust_instant_policy.evaluation.paper import table1
from robust_instant_policy.evaluation.statistics import Summary
from robust_instant_policy.evaluation.variant import PAPER_CONFIGS, Variant
from robust_instant_policy.tasks.level import PAPER


def is_comparable(summary: Summary) -> bool:
    """Whether the paper's numbers may stand beside those of ``summary``: scenes of the paper's level, and some variants
    in its configuration.
    """
    return summary.suite.level == PAPER.name and any(one.config in PAPER_CONFIGS for one in summary.variants)


def paper_rate(summary: Summary, variant: Variant, task: str) -> int | None:
    """The paper's success rate in percent for a ``variant`` of ``summary`` with the settings of Table I, or of a method
    (such as dp) that is the same in all configurations and stands beside ones in the paper's; else None.
    """
    same = not variant.config or (variant.config in PAPER_CONFIGS and _is_of_table1(variant))
    return table1(variant.method, task) if same and is_comparable(summary) else None


def _is_of_table1(variant: Variant) -> bool:
    """Whether it has the paper's number of demonstrations and samples, ν and downsampling."""
    usual = Variant(variant.method)
    return all(getattr(variant, name) == getattr(usual, name) for name in ("demos", "queries", "dof", "downsampling"))
