"""`rip train`: a trained method on the screen, and a picture of what it learned."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robust_instant_policy.console import StageConsole, TrainingScreen
from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.datasets.files import write_whole
from robust_instant_policy.errors import UnknownNameError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.policies import TRAINED_METHODS, KeypointContext, make_trained_policy
from robust_instant_policy.policies.training import Training
from robust_instant_policy.tasks import TASK_NAMES, make_task

if TYPE_CHECKING:
    from robust_instant_policy.policies.diffusion.training import Rehearsal

REHEARSED = 3  # demonstrations that are drawn
SMOOTHED = 20  # steps over which the drawn loss is averaged


def train(task: str, method: str, demos: Path, limit: int | None, training: Training) -> None:
    """Train ``method`` on the first ``limit`` demonstrations of ``task`` in the folder ``demos``, or all of them.

    The checkpoint goes to ``training.checkpoints``, and beside it a picture of the loss and of samples.
    """
    if method not in TRAINED_METHODS:
        raise UnknownNameError("trained method", method, TRAINED_METHODS)
    screen = StageConsole()
    demonstrations = load_demonstrations(demos, task=task, limit=limit)
    policy = make_trained_policy(
        method, KeypointContext(workspace=_workspace(task)), replace(training, report=TrainingScreen(screen))
    )
    with screen.stage(f"{method} on {len(demonstrations)} demonstrations"):
        policy.fit(demonstrations)
    trained = policy.trained_
    picture = trained.path.with_suffix(".svg")
    write_whole(picture, _picture(trained.losses, policy.rehearse(REHEARSED)))
    screen.say(f"{trained.path}: {len(trained.losses)} steps in {trained.seconds:.0f} s")
    screen.say(f"{picture}: how the loss fell, and samples beside demonstrations")


def _picture(losses: np.ndarray, rehearsals: Sequence[Rehearsal]) -> bytes:
    """SVG: the loss over the steps, and the first arm's palm in each of ``rehearsals``, shown and sampled."""
    from matplotlib.figure import Figure

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


def _workspace(task: str) -> FloatArray | None:
    """The task's, so that the same keypoints are found as when it is evaluated; None for a task of one's own."""
    if task not in TASK_NAMES:
        return None
    simulated = make_task(task)
    try:
        return simulated.workspace
    finally:
        simulated.close()
