"""The plan as one HTML file that needs nothing else: poses in the cell, ellipsoids, curves, budgets."""

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from controller.cellfile import Cell
from controller.dry_run import PlannedPhase
from controller.knowledge import all_faces, part_corners_m
from controller.planning.estimated import corner_points
from estimation.statistics import coverage_factor
from estimation.transform import FloatArray

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

MAGNIFIED: Final = 200.0  # ellipsoids of tenths of a millimetre beside arms of a metre
COLOURS: Final = ("#1d5b8f", "#c25e00", "#1a7f4b", "#7a3f98", "#b3261e", "#5f6368")
STANDING: Final = "#c3c9d0"


def page_of(cell: Cell, phases: Sequence[PlannedPhase]) -> str:
    """The page; it holds its own copy of the drawing library, so that it opens without a network."""
    figures = [_scene(cell, phases)]
    figures += [_curve(phase) for phase in phases if phase.plan.curve_U_m]
    figures += [_budget(phase) for phase in phases if phase.plan.worst is not None]
    parts = [
        figure.to_html(full_html=False, include_plotlyjs=number == 0) for number, figure in enumerate(figures)
    ]
    title = escape(f"Plan of {cell.name}{', simulated' if cell.simulated else ''}")
    style = "body{font-family:sans-serif;max-width:70rem;margin:2rem auto;color:#1f2933}"
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f"<style>{style}</style></head><body><h1>{title}</h1>"
        f"<p>Cell file {cell.digest[:12]}. Nothing has moved: everything lies where the cell file says. "
        f"Ellipsoids are 95 %, {MAGNIFIED:.0f} times enlarged.</p>{''.join(parts)}</body></html>\n"
    )


def _scene(cell: Cell, phases: Sequence[PlannedPhase]) -> "Figure":
    import plotly.graph_objects as go

    figure = go.Figure()
    part = cell.part.transform()
    triangles = np.concatenate([face.triangles for face in all_faces(cell)])
    _add_mesh(figure, part.points(triangles.reshape(-1, 3)), "part", 0.6)
    half = np.array(cell.plate.size_m) / 2
    corners = np.array([[x, y, 0.0] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, -1), (1, 1), (-1, 1))])
    _add_mesh(figure, cell.plate.transform().points(corners * [*half, 0.0]), "plate", 0.6)
    ends = cell.bar.transform().points(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, cell.bar.length_m]]))
    _add_lines(figure, ends, "bar", STANDING, width=8)
    arm = cell.robot.arm_model()
    for number, phase in enumerate(phases):
        steps = [step for step in phase.plan.steps if step.kind in ("laser", "touch", "reference")]
        if not steps:
            continue
        flange = arm.flange_pose(np.array([step.joints_rad for step in steps]))
        laser = flange @ cell.laser.mount.transform().matrix
        ball = flange @ cell.probe.mount.transform().matrix
        lines = []
        for row, step in enumerate(steps):
            start = laser[row] if step.kind == "laser" else ball[row]
            end = start[:3, 3] + step.expected_m * start[:3, 2]
            lines += [flange[row, :3, 3], start[:3, 3], end, np.full(3, np.nan)]
        colour = COLOURS[number % len(COLOURS)]
        _add_lines(figure, np.array(lines), f"{phase.name}: {len(steps)}", colour)
        _add_ellipsoids(figure, cell, phase, colour)
    figure.update_layout(
        title="Poses: flange, sensor, and where it measures (m)",
        height=700,
        scene={"aspectmode": "data", "xaxis_title": "x", "yaxis_title": "y", "zaxis_title": "z"},
    )
    return figure


def _add_ellipsoids(figure: "Figure", cell: Cell, phase: PlannedPhase, colour: str) -> None:
    """Of the corners of the part, where the phase locates it."""
    belief = phase.plan.belief
    if belief is None or "part" not in belief:
        return
    points, _ = corner_points(cell, belief)
    values, axes = np.linalg.eigh(points.covariance(belief))
    factor = MAGNIFIED * coverage_factor(3) * np.sqrt(np.maximum(values, 0.0))
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 17), np.linspace(0, np.pi, 9))
    sphere = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1)
    corners = cell.part.transform().points(part_corners_m(cell))
    for centre, axis, length in zip(corners, axes, factor, strict=True):
        surface = centre + (sphere * length) @ axis.T
        figure.add_surface(
            x=surface[..., 0],
            y=surface[..., 1],
            z=surface[..., 2],
            showscale=False,
            opacity=0.5,
            colorscale=[[0, colour], [1, colour]],
        )


def _curve(phase: PlannedPhase) -> "Figure":
    import plotly.graph_objects as go

    values = np.array(phase.plan.curve_U_m) * 1e3
    figure = go.Figure(go.Scatter(x=np.arange(len(values)), y=values, name="U at the worst gated point"))
    if phase.limit_m is not None:
        figure.add_hline(y=phase.limit_m * 1e3, line_dash="dash", annotation_text="limit")
    figure.update_layout(
        title=f"{phase.name}: uncertainty against the number of measurements",
        xaxis_title="measurements, in the order of choice",
        yaxis_title="U (mm, 95 %)",
        yaxis_type="log",
        height=380,
    )
    return figure


def _budget(phase: PlannedPhase) -> "Figure":
    import plotly.graph_objects as go

    worst = phase.plan.worst
    shares: dict[str, Any] = {} if worst is None else dict(worst.shares)
    figure = go.Figure(
        go.Bar(x=[100.0 * share for share in shares.values()], y=list(shares), orientation="h")
    )
    point = "" if worst is None else f" at {worst.name}, U = {worst.U_m * 1e3:.3f} mm"
    figure.update_layout(
        title=f"{phase.name}: what makes the uncertainty{point}",
        xaxis_title="share of the variance (%)",
        yaxis_autorange="reversed",
        height=340,
    )
    return figure


def _add_mesh(figure: "Figure", corners: FloatArray, name: str, opacity: float) -> None:
    i, j, k = np.arange(len(corners)).reshape(-1, 3).T
    x, y, z = corners.T
    figure.add_mesh3d(x=x, y=y, z=z, i=i, j=j, k=k, color=STANDING, opacity=opacity, name=name)


def _add_lines(figure: "Figure", points: FloatArray, name: str, colour: str, width: int = 2) -> None:
    x, y, z = points.T
    line = {"color": colour, "width": width}
    figure.add_scatter3d(x=x, y=y, z=z, mode="lines", name=name, line=line)
