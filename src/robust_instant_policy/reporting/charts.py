"""Interactive charts of a plan: paths in 3-D, weights, and every action dimension over time."""

from functools import partial
from typing import Any

import numpy as np
import plotly.graph_objects as go
from markupsafe import Markup
from plotly.subplots import make_subplots

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray, GripperTriangle
from robust_instant_policy.policies.policy import Plan
from robust_instant_policy.reporting.pictures import keypoint_colour
from robust_instant_policy.robots.path import MeasuredPath, Sweep
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX

MM = 1000.0
AXIS_STEPS = 6  # gripper axes drawn along the robust trajectory
AXIS_LENGTH_M = 0.03
AXIS_COLOURS = ("#d62728", "#2ca02c", "#1f77b4")  # of x, y and z
AXIS_NAMES = ("gripper x", "gripper y (opening)", "gripper z (approach)")
CAMERA = {"eye": {"x": 1.5, "y": -1.6, "z": 1.2}, "center": {"x": 0, "y": 0, "z": -0.2}}  # shows all of it
COLUMNS = 3  # of charts side by side
MAX_POINTS = 8_000  # of the point cloud under the paths
WEIGHT_COLOURS = "Viridis_r"  # dark: followed, pale: ignored
ROBUST_COLOUR = "#111111"
HALLUCINATED_COLOUR = "#d1495b"
CANDIDATE_COLOURS = (
    "#2e86ab", "#3fa34d", "#a06cd5", "#e09f3e", "#17817b", "#7d4f50", "#5c6f91", "#b56576", "#6b8f71", "#8d99ae",
)  # fmt: skip
DIMENSIONS = tuple(f"{point} {axis}" for point in ("gripper point", "fingertip 1", "fingertip 2") for axis in "xyz")


def chart(figure: go.Figure) -> Markup:
    """HTML of ``figure`` for a page that holds plotly's script already."""
    config = {"displaylogo": False, "responsive": True}
    return Markup(figure.to_html(include_plotlyjs=False, full_html=False, config=config))


def candidate_name(plan: Plan, index: int) -> str:
    return f"candidate {index + 1}" + (" (hallucinated)" if plan.hallucinated[index] else "")


def candidate_colour(plan: Plan, index: int) -> str:
    return HALLUCINATED_COLOUR if plan.hallucinated[index] else CANDIDATE_COLOURS[index % len(CANDIDATE_COLOURS)]


def paths_in_space(plan: Plan, observation: Observation) -> go.Figure:
    """Paths between the fingertips in the world, candidates coloured by weight, with the gripper's axes along the
    robust one and what its fingertips sweep, over the points that the camera saw."""
    figure = _seen(observation)
    for index, candidate in enumerate(plan.candidates):
        weight = np.interp(candidate.times, plan.trajectory.times, plan.weights[index])
        shade = {"color": weight, "colorscale": WEIGHT_COLOURS, "cmin": 0, "cmax": 1}
        marker = {"size": 3, "symbol": "x" if plan.hallucinated[index] else "circle", "colorbar": _bar("weight", 0.6)}
        for arm in range(candidate.num_arms):
            _add_points(
                figure,
                candidate.tool_points[:, arm],
                candidate_name(plan, index),
                in_legend=False,
                mode="lines+markers",
                line={**shade, "width": 4},
                marker={**shade, **marker, "showscale": index == 0 and arm == 0},
                customdata=np.stack([weight, np.arange(len(candidate))], axis=1),
                hovertemplate="step %{customdata[1]:.0f}, weight %{customdata[0]:.2f}<extra>%{fullData.name}</extra>",
            )
    for arm in range(plan.trajectory.num_arms):
        _add_robust_path(figure, plan, arm)
    keypoints = plan.keypoints.reshape(-1, 3)
    numbers = range(len(keypoints))
    dots = {"size": 5, "color": [keypoint_colour(k) for k in numbers]}
    _add_points(figure, keypoints, "keypoints", mode="markers+text", text=[str(k) for k in numbers], marker=dots)
    return _in_space(figure)


def swept_space(sweep: Sweep, observation: Observation) -> go.Figure:
    """The path between the fingertips from where the arms are parked, and the arms' links along it, pale at first and
    dark at the end, over the points that the camera saw."""
    figure = _seen(observation)
    gap = np.full((*sweep.links.shape[:2], 1, 3), np.nan)  # between the lines of two links
    links = np.concatenate([sweep.links, gap], axis=2).reshape(-1, 3)
    seconds = np.repeat(sweep.seconds, 3 * sweep.links.shape[1])
    line = {"width": 6, "color": seconds, "colorscale": WEIGHT_COLOURS, "colorbar": _bar("seconds", 0.6)}
    _add_points(figure, links, "links of the arms", line=line, hoverinfo="skip")
    for arm in range(sweep.tools.shape[1]):
        line = {"color": ROBUST_COLOUR, "width": 6}
        _add_points(figure, sweep.tools[:, arm], "between the fingertips", arm == 0, line=line)
    return _in_space(figure)


def executed_paths(plan: Plan, path: MeasuredPath) -> go.Figure:
    """The planned trajectory, and the commanded and measured paths between the fingertips, in the world."""
    figure = go.Figure()
    for arm in range(plan.trajectory.num_arms):
        marker = {"color": ROBUST_COLOUR, "size": 3}
        _add_points(figure, plan.trajectory.tool_points[:, arm], "planned", arm == 0, mode="markers", marker=marker)
        for points, name, colour in (
            (path.commanded_tools, "commanded", CANDIDATE_COLOURS[0]),
            (path.measured_tools, "measured", HALLUCINATED_COLOUR),
        ):
            _add_points(figure, points[:, arm], name, arm == 0, line={"color": colour, "width": 4})
    return _in_space(figure)


def _seen(observation: Observation) -> go.Figure:
    """The points that the camera saw."""
    figure = go.Figure()
    points, colours = observation.points(MAX_POINTS)
    marker = {"size": 2, "color": [f"rgb({r},{g},{b})" for r, g, b in colours]}
    _add_points(figure, points.astype(np.float32), "camera", mode="markers", marker=marker, hoverinfo="skip")
    return figure


def _in_space(figure: go.Figure) -> go.Figure:
    axes = {f"{axis}axis_title": f"world {axis} [mm]" for axis in "xyz"}
    figure.update_layout(
        height=620, margin=dict.fromkeys("lrtb", 0), legend={"x": 0, "y": 1},
        scene={"aspectmode": "data", "camera": CAMERA, **axes},
    )  # fmt: skip
    return figure


def _bar(title: str, length: float = 1.0) -> dict[str, Any]:
    """A bar with the colours' meaning."""
    return {"title": title, "thickness": 14, "len": length}


def _add_points(
    figure: go.Figure, points: FloatArray, name: str, in_legend: bool = True, mode: str = "lines", **look: Any
) -> None:
    """``points (N, 3)`` in metres, drawn in millimetres; those of one name are shown and hidden together."""
    x, y, z = (points * MM).T
    figure.add_scatter3d(x=x, y=y, z=z, name=name, legendgroup=name, showlegend=in_legend, mode=mode, **look)


def _add_robust_path(figure: go.Figure, plan: Plan, arm: int) -> None:
    line, marker = {"color": ROBUST_COLOUR, "width": 9}, {"color": ROBUST_COLOUR, "size": 3}
    points = plan.trajectory.tool_points[:, arm]
    _add_points(figure, points, "robust trajectory", arm == 0, "lines+markers", line=line, marker=marker)
    triplets = plan.trajectory.triplets[:, arm]
    for finger in (1, 2):
        line = {"color": ROBUST_COLOUR, "width": 3, "dash": "dot"}
        _add_points(figure, triplets[:, finger], "its fingertips", arm == 0 and finger == 1, line=line)
    poses = GripperTriangle.from_triplets(triplets).poses(triplets)
    for step in np.unique(np.linspace(0, len(poses) - 1, AXIS_STEPS).astype(int)):
        origin, rotation = poses[step, :3, 3], poses[step, :3, :3]
        for axis, (colour, name) in enumerate(zip(AXIS_COLOURS, AXIS_NAMES, strict=True)):
            ends, first = np.stack([origin, origin + AXIS_LENGTH_M * rotation[:, axis]]), bool(step == 0 and arm == 0)
            _add_points(figure, ends, name, first, line={"color": colour, "width": 5}, hoverinfo="name")


def weights_over_time(plan: Plan) -> go.Figure:
    """Weight of every candidate at every step of the plan, as a heat map."""
    names = [candidate_name(plan, index) for index in range(len(plan.candidates))]
    figure = go.Figure(
        go.Heatmap(
            z=plan.weights, x=list(range(plan.weights.shape[1])), y=names, zmin=0, zmax=1, colorscale=WEIGHT_COLOURS,
            colorbar=_bar("weight"), xgap=1, ygap=2,
            hovertemplate="%{y}, step %{x}: weight %{z:.2f}<extra></extra>",
        )
    )  # fmt: skip
    figure.update_layout(
        height=140 + 26 * len(names), margin={"l": 10, "r": 10, "t": 40, "b": 45}, template="simple_white"
    )
    figure.update_xaxes(title_text="step of the robust trajectory")
    figure.update_yaxes(autorange="reversed", automargin=True)
    return figure


def dimensions_over_time(plan: Plan) -> go.Figure:
    """Every action dimension over normalised time: candidates, robust mean, and the scale band."""
    arms = plan.trajectory.num_arms
    names = [
        (f"arm {arm + 1} " if arms > 1 else "") + name
        for arm in range(arms)
        for name in (*(f"{d}, world [mm]" for d in DIMENSIONS), "gripper state (0 open, 1 closed)")
    ]
    rows = -(-len(names) // COLUMNS)
    figure = make_subplots(
        rows=rows, cols=COLUMNS, subplot_titles=names, vertical_spacing=0.28 / rows, horizontal_spacing=0.06
    )
    times = plan.trajectory.times
    for dimension in range(len(names)):
        unit = 1.0 if dimension % ACTION_DIM == STATE_INDEX else MM
        place = {"row": dimension // COLUMNS + 1, "col": dimension % COLUMNS + 1}
        add = partial(figure.add_scatter, mode="lines", showlegend=dimension == 0, **place)
        mean, scale = plan.trajectory.actions[:, dimension] * unit, plan.scale[:, dimension] * unit
        if scale.any():
            x, y = np.concatenate([times, times[::-1]]), np.concatenate([mean + scale, (mean - scale)[::-1]])
            band = {"fill": "toself", "fillcolor": "rgba(0,0,0,0.13)", "line": {"width": 0}, "hoverinfo": "skip"}
            add(x=x, y=y, name="robust mean ± scale", legendgroup="band", **band)
        for index, candidate in enumerate(plan.candidates):
            dash = "dot" if plan.hallucinated[index] else "solid"
            line = {"color": candidate_colour(plan, index), "width": 1.6, "dash": dash}
            values = candidate.actions[:, dimension] * unit
            add(x=candidate.times, y=values, name=candidate_name(plan, index), legendgroup=str(index), line=line)
        line = {"color": ROBUST_COLOUR, "width": 2.6}
        add(x=times, y=mean, name="robust mean", legendgroup="mean", line=line)
        figure.update_xaxes(title_text="normalised time" if place["row"] == rows else None, **place)
    figure.update_layout(
        height=210 * rows + 60,
        margin={"l": 40, "r": 10, "t": 70, "b": 40},
        template="simple_white",
        legend={"orientation": "h", "y": 1 + 0.22 / rows, "yanchor": "bottom"},
    )
    figure.update_annotations(font_size=13)
    return figure
