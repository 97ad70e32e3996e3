"""Where the paper's numbers may be shown beside measured ones."""

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
    """The paper's success rate in percent for a ``variant`` with the settings of Table I, or for a method without a
    configuration (such as dp), in a comparable ``summary``; else None.
    """
    usual = Variant(variant.method)  # of Table I
    settings = ("demos", "queries", "dof", "downsampling")
    is_usual = all(getattr(variant, name) == getattr(usual, name) for name in settings)
    same = not variant.config or (variant.config in PAPER_CONFIGS and is_usual)
    return table1(variant.method, task) if same and is_comparable(summary) else None
