"""A self-contained page with the findings of `sanity.check_demonstrations` and the start images."""

from collections.abc import Sequence

import numpy as np

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.geometry import project
from robust_instant_policy.reporting.pages import render
from robust_instant_policy.reporting.pictures import REFERENCE_WIDTH, Line, Mark, Picture, picture, svg_points
from robust_instant_policy.reporting.tables import NONE, Table
from robust_instant_policy.sanity import Finding, SetReport, errors
from robust_instant_policy.sanity.contact import GripperPath
from robust_instant_policy.sanity.view import View

RAISED_TINT = np.array([0.0, 200.0, 255.0])  # of what stands above the table
UNKNOWN_TINT = np.array([255.0, 0.0, 160.0])  # of pixels without a steady depth
TINT = 0.45
PATH_COLOUR, GRASP_COLOUR = "#ffffff", "#d9730d"


def check_page(
    title: str,
    demonstrations: Sequence[Demonstration],
    report: SetReport,
    observation: Observation | None = None,
    found: Sequence[Finding] = (),
) -> str:
    """HTML of a ``report`` on ``demonstrations``, and of what was ``found`` in a new ``observation``."""
    every = (*report.findings, *found)
    return render(
        "check.html",
        title=title,
        wrong=len(errors(every)),
        findings=report.findings,
        facts=_facts(demonstrations, report),
        contacts=_contacts(report),
        demonstrations=[
            _picture(one.observation, f"demonstration {index}", one) for index, one in enumerate(demonstrations)
        ],
        scene=None if observation is None else _picture(observation, "new scene"),
        scene_findings=found,
    )


def _facts(demonstrations: Sequence[Demonstration], report: SetReport) -> dict[str, str]:
    facts = {"demonstrations": str(len(demonstrations))}
    known = report.reference
    if known is None:
        return facts
    a, b, c, d = known.plane
    evidence = known.evidence
    return facts | {
        "paths that touch something": f"{evidence.touching:.0%}",
        "consistency around the gripper": f"{evidence.surroundings.score:.2f}",
        "spread of the objects": f"{known.scene_spread_m * 100:.1f} cm",
        "table plane (normal, offset in m)": f"{a:.3f}, {b:.3f}, {c:.3f}; {d:.3f}",
        "camera": "moves, or differs" if known.scenery is None else "fixed",
    }


def _contacts(report: SetReport) -> Table | None:
    if report.reference is None:
        return None
    evidence = report.reference.evidence
    rows = []
    for index, (contact, likeness) in enumerate(zip(evidence.contacts, evidence.surroundings.likeness, strict=True)):
        grasps = ", ".join(_mm(gap) for gap in contact.grasps) or NONE
        rows.append(
            (str(index), _mm(contact.path), grasps, _mm(contact.lowest), _mm(contact.buried), f"{likeness:.2f}")
        )
    head = (
        "demonstration", "gap of the path [mm]", "gaps where the gripper closes [mm]", "lowest fingertip [mm]",
        "gripper point behind a surface [mm]", "like the others",
    )  # fmt: skip
    return Table(head, tuple(rows), "Gaps are 0 where the path passes through what the image shows.")


def _mm(metres: float) -> str:
    return f"{metres * 1e3:.0f}"


def _picture(observation: Observation, caption: str, demonstration: Demonstration | None = None) -> Picture:
    view = View.of(observation)
    height, width = observation.depth.shape
    rows, cols = (np.arange(n) // view.every for n in (height, width))
    raised = view.raised[rows][:, cols]
    unknown = np.isnan(view.depth)[rows][:, cols]
    rgb = observation.rgb.astype(np.float64)
    rgb[raised] += TINT * (RAISED_TINT - rgb[raised])
    rgb[unknown] += TINT * (UNKNOWN_TINT - rgb[unknown])
    lines, marks = [], []
    if demonstration is not None:
        scale = width / REFERENCE_WIDTH
        for arm in range(demonstration.trajectory.num_arms):
            points = svg_points(demonstration.trajectory.tool_points[:, arm], observation)
            lines.append(Line(points, PATH_COLOUR, 1.2 * scale, title="middle of the fingertips"))
        closings = GripperPath.of(demonstration.trajectory).closings.reshape(-1, 3)
        pixels = project(closings, observation.intrinsics, observation.camera_pose) + 0.5
        marks = [Mark(float(u), float(v), "", GRASP_COLOUR, "a gripper closes here") for u, v in pixels]
    return picture(rgb.astype(np.uint8), caption, lines, marks)
