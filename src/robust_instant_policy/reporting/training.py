"""Figure about a trained method: the loss, and samples beside demonstrations."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from robust_instant_policy.evaluation.experiment import training_file
from robust_instant_policy.evaluation.variant import Variant
from robust_instant_policy.files import write_whole
from robust_instant_policy.reporting.figures import encode

if TYPE_CHECKING:  # what it describes needs the extra "train"
    from robust_instant_policy.policies.diffusion.training import TrainedPolicy

SAMPLED_DEMONSTRATIONS = 3  # that are drawn
LOSS_WINDOW = 20  # steps over which the drawn loss is averaged


def keep_training_picture(out: Path, task: str, variant: Variant, policy: TrainedPolicy) -> None:
    """Write the figure about ``policy`` to the run's folder ``out``, unless it exists."""
    path = out / training_file(task, variant)
    if not path.exists():
        write_whole(path, training_picture(policy))


def training_picture(policy: TrainedPolicy) -> bytes:
    """SVG: the loss over the steps, and the first arm's gripper point in some demonstrations, shown and sampled."""
    losses, rehearsals = policy.trained_.losses, policy.rehearse(SAMPLED_DEMONSTRATIONS)
    figure = Figure(figsize=(4 + 3 * len(rehearsals), 3), layout="constrained")
    curve, *axes = figure.subplots(1, 1 + len(rehearsals), width_ratios=[1.3] + [1] * len(rehearsals))
    window = np.ones(LOSS_WINDOW) / LOSS_WINDOW
    smooth = np.convolve(losses, window, mode="valid") if len(losses) > LOSS_WINDOW else losses
    curve.semilogy(losses, color="0.8", linewidth=0.5)
    curve.semilogy(np.arange(len(smooth)) + len(losses) - len(smooth), smooth, color="black")
    curve.set(xlabel="training step", ylabel="loss", title="loss")
    for index, (axis, rehearsal) in enumerate(zip(axes, rehearsals, strict=True)):
        for place, name in enumerate("xyz"):
            colour = f"C{place}"
            axis.plot(1e3 * rehearsal.samples[:, :, place].T, color=colour, linewidth=0.8, linestyle="--")
            axis.plot(1e3 * rehearsal.shown[:, place], color=colour, linewidth=1.6, alpha=0.6, label=name)
        axis.set(xlabel="step", title=f"demonstration {index}")
    axes[0].set_ylabel("gripper point [mm]")
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside right upper", title="solid: shown\ndashed: sampled"
    )
    return encode(figure, "svg")
