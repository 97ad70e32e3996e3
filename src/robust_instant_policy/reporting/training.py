"""What a training came to, to look at: how the loss fell, and samples beside demonstrations."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    from robust_instant_policy.policies.diffusion.training import Rehearsal, Trained

REHEARSED = 3  # demonstrations that are drawn
SMOOTHED = 20  # steps over which the drawn loss is averaged


class TrainedPolicy(Protocol):
    """A policy that was fitted by training, and can say what it would do where it was shown what to do."""

    trained_: Trained

    def rehearse(self, count: int) -> list[Rehearsal]: ...


def training_picture(policy: TrainedPolicy) -> bytes:
    """SVG: the loss over the steps, and the first arm's palm in each of some demonstrations, shown and sampled."""
    from matplotlib.figure import Figure

    losses, rehearsals = policy.trained_.losses, policy.rehearse(REHEARSED)
    figure = Figure(figsize=(4 + 3 * len(rehearsals), 3), layout="constrained")
    curve, *axes = figure.subplots(1, 1 + len(rehearsals), width_ratios=[1.3] + [1] * len(rehearsals))
    smooth = np.convolve(losses, np.ones(SMOOTHED) / SMOOTHED, mode="valid") if len(losses) > SMOOTHED else losses
    curve.semilogy(losses, color="0.8", linewidth=0.5)
    curve.semilogy(np.arange(len(smooth)) + len(losses) - len(smooth), smooth, color="black")
    curve.set(xlabel="step of training", ylabel="loss", title="loss")
    for index, (axis, rehearsal) in enumerate(zip(axes, rehearsals, strict=True)):
        for place, name in enumerate("xyz"):
            colour = f"C{place}"
            axis.plot(1e3 * rehearsal.samples[:, :, place].T, color=colour, linewidth=0.8, linestyle="--")
            axis.plot(1e3 * rehearsal.shown[:, place], color=colour, linewidth=1.6, alpha=0.6, label=name)
        axis.set(xlabel="step", title=f"demonstration {index}")
    axes[0].set_ylabel("palm, mm")
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside right upper", title="solid: shown\ndashed: sampled"
    )
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg")
    return buffer.getvalue()
