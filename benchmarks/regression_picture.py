"""Draws docs/images/regression.svg: five candidates, two of them hallucinated, their mean and the robust trajectory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from contaminated_trajectories import draw_scene

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.regression import StudentTNumbers, StudentTRegression

PICTURE = Path(__file__).parents[1] / "docs" / "images" / "regression.svg"
WIDTH, HEIGHT, STRIP, MARGIN = 640.0, 260.0, 70.0, 36.0
COLUMN = 0  # gripper point, x
COLOURS = {"clean": "#9aa5b1", "hallucinated": "#e5484d", "mean": "#f0a020", "robust": "#1f6feb"}


def line(x: FloatArray, y: FloatArray, colour: str, width: float, dash: str = "") -> str:
    corners = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    return (
        f'<polyline points="{corners}" fill="none" stroke="{colour}" stroke-width="{width}" stroke-dasharray="{dash}"/>'
    )


def label(x: float, y: float, text: str, colour: str = "#57606a") -> str:
    return f'<text x="{x:.0f}" y="{y:.0f}" fill="{colour}" font-size="12" font-family="sans-serif">{text}</text>'


def main() -> None:
    scene = draw_scene(6, "piecewise", 5, 2, "drift")
    points = [candidate[:, :9] for candidate in scene.candidates]
    times = scene.times
    fit = StudentTRegression(groups=np.zeros(9)).fit(points)
    mean = StudentTNumbers(dof=np.inf).fit(points).mean(times)
    values = np.concatenate([candidate[:, COLUMN] for candidate in points])
    low, high = values.min(), values.max()

    def across(t: FloatArray) -> FloatArray:
        return MARGIN + t * (WIDTH - 2 * MARGIN)

    def up(value: FloatArray, bottom: float, size: float, least: float, most: float) -> FloatArray:
        return bottom - (value - least) / (most - least) * size

    bottom = HEIGHT - 12
    shapes = []
    for candidate, wrong in zip(points, scene.hallucinated, strict=True):
        clock = np.linspace(0, 1, len(candidate))
        colour = COLOURS["hallucinated" if wrong else "clean"]
        shapes.append(line(across(clock), up(candidate[:, COLUMN], bottom, HEIGHT - 50, low, high), colour, 1.2))
    for curve, name, dash in ((mean, "mean", "5 3"), (fit.mean(times), "robust", "")):
        shapes.append(
            line(across(times), up(curve[:, COLUMN], bottom, HEIGHT - 50, low, high), COLOURS[name], 2.2, dash)
        )
    base = HEIGHT + STRIP
    for weight, wrong in zip(fit.weights, scene.hallucinated, strict=True):
        clock = np.linspace(0, 1, len(weight))
        colour = COLOURS["hallucinated" if wrong else "clean"]
        shapes.append(line(across(clock), up(weight, base, STRIP - 20, 0, 1), colour, 1.6))
    names = {
        "clean": "candidates",
        "hallucinated": "hallucinated",
        "mean": "mean",
        "robust": "robust (ν = 1.5)",
    }
    shapes += [label(MARGIN + 130 * k, 18, text, COLOURS[name]) for k, (name, text) in enumerate(names.items())]
    shapes.append(label(MARGIN, HEIGHT + 12, "weight of each candidate, 0 to 1, over time"))
    PICTURE.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH:.0f} {base + 12:.0f}">'
        f'<rect width="100%" height="100%" fill="white"/>{"".join(shapes)}</svg>\n'
    )


if __name__ == "__main__":
    main()
