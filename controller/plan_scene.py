"""The plan in 3-D: what stands in the cell, where the sensors go, and how well the part will be known."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from controller.cellfile import Cell
from controller.dry_run import PlannedPhase
from controller.knowledge import all_faces, part_corners_m
from controller.planning.estimated import corner_points
from controller.planning.steps import Step
from estimation.statistics import coverage_factor
from estimation.transform import FloatArray

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

COLOURS: Final = ("#1d5b8f", "#c25e00", "#1a7f4b", "#7a3f98", "#b3261e", "#00838f")
STANDING: Final = "#8d99a6"
BRACKET: Final = "#b8c0c8"  # from the flange to a sensor
ELLIPSOID: Final = 0.12  # largest half axis, as a share of the part's diagonal
ROUND: Final = (1.0, 2.0, 5.0)


def scene_of(cell: Cell, phases: Sequence[PlannedPhase]) -> tuple["Figure", float]:
    """The scene, and how many times its ellipsoids are enlarged (0: there are none)."""
    import plotly.graph_objects as go

    figure = go.Figure()
    _add_standing(figure, cell)
    for number, phase in enumerate(phases):
        steps = [step for step in phase.plan.steps if step.kind in ("laser", "touch", "noise")]
        if steps:
            _add_poses(figure, cell, phase.name, steps, COLOURS[number % len(COLOURS)])
    magnified = _add_ellipsoids(figure, cell, phases)
    axis = {"backgroundcolor": "#f6f8fa", "gridcolor": "#dde2e7", "dtick": 0.2}
    figure.update_layout(
        title="Poses: where the sensor stands, and what it measures (m)",
        height=760,
        margin={"l": 0, "r": 0, "t": 50, "b": 0},
        legend={"itemsizing": "constant", "y": 0.95, "x": 0.99, "xanchor": "right"},
        scene={
            "aspectmode": "data",
            "xaxis": {"title": "x (m)", **axis},
            "yaxis": {"title": "y (m)", **axis},
            "zaxis": {"title": "z (m)", **axis},
            "camera": {"eye": {"x": 0.85, "y": -1.05, "z": 0.75}, "center": {"x": 0.0, "y": 0.0, "z": -0.15}},
        },
    )
    return figure, magnified


def _add_standing(figure: "Figure", cell: Cell) -> None:
    """Part, plate, bar, sphere and the foot of the robot, each with its name."""
    part = cell.part.transform().points(
        np.concatenate([face.triangles for face in all_faces(cell)]).reshape(-1, 3)
    )
    _add_mesh(figure, part, cell.part.name, 0.55)
    half = np.array(cell.plate.size_m) / 2
    square = np.array([[x, y, 0.0] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, -1), (1, 1), (-1, 1))])
    plate = cell.plate.transform().points(square * [*half, 0.0])
    _add_mesh(figure, plate, "plate", 0.55)
    ends = cell.bar.transform().points(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, cell.bar.length_m]]))
    ball = cell.sphere.transform().origin_m
    for centre in ends:
        _add_surface(figure, centre + cell.bar.sphere_radius_m * _unit_sphere(), STANDING, 0.9)
    _add_surface(figure, ball + cell.sphere.radius_m * _unit_sphere(), STANDING, 0.9)
    _add_lines(figure, ends, "", STANDING, width=6)
    foot = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, cell.robot.joints[0].d_m]])
    _add_lines(figure, foot, "", "#3c4650", width=14)
    labels = {
        cell.part.name: [*part.mean(axis=0)[:2], part[:, 2].max() + 0.14],
        "plate": [*plate.min(axis=0)[:2], plate[0, 2]],
        "bar": [*ends.mean(axis=0)[:2], ends[0, 2] - 0.05],
        "sphere": [*ball[:2], ball[2] - 0.05],
        "robot": [0.0, 0.0, foot[1, 2] + 0.04],
    }
    x, y, z = np.array(list(labels.values())).T
    font = {"size": 14, "color": "#1f2933"}
    figure.add_scatter3d(x=x, y=y, z=z, mode="text", text=list(labels), textfont=font, showlegend=False)


def _add_poses(figure: "Figure", cell: Cell, name: str, steps: Sequence[Step], colour: str) -> None:
    """A thin line from the flange to the sensor, a thick one from there to a dot where it measures."""
    flange = cell.robot.arm_model().flange_pose(np.array([step.joints_rad for step in steps]))
    laser = flange @ cell.laser.mount.transform().matrix
    probe = flange @ cell.probe.mount.transform().matrix
    touches = np.array([step.kind == "touch" for step in steps])
    sensor = np.where(touches[:, None, None], probe, laser)
    way_m = np.array([step.expected_m for step in steps])
    measured = sensor[:, :3, 3] + way_m[:, None] * sensor[:, :3, 2]
    where = list(dict.fromkeys(step.object for step in steps))
    label = f"{name}: {len(steps)} on {' and '.join(where)}"
    _add_lines(figure, _segments(flange[:, :3, 3], sensor[:, :3, 3]), "", BRACKET, width=1, group=name)
    _add_lines(figure, _segments(sensor[:, :3, 3], measured), label, colour, width=3, group=name)
    x, y, z = measured.T
    dots = {"size": 2.5, "color": colour}
    texts = [f"{step.id} on {step.feature}" for step in steps]
    figure.add_scatter3d(
        x=x, y=y, z=z, mode="markers", marker=dots, text=texts, legendgroup=name, showlegend=False, name=name
    )


def _add_ellipsoids(figure: "Figure", cell: Cell, phases: Sequence[PlannedPhase]) -> float:
    """Of the corners of the part, after the last phase that locates it."""
    known = [phase for phase in phases if phase.plan.gated and "part" in (phase.plan.belief or ())]
    if not known or (belief := known[-1].plan.belief) is None:
        return 0.0
    values, axes = np.linalg.eigh(corner_points(cell, belief)[0].covariance(belief))
    half_m = coverage_factor(3) * np.sqrt(np.maximum(values, 0.0))
    corners = cell.part.transform().points(part_corners_m(cell))
    wanted = ELLIPSOID * float(np.linalg.norm(np.ptp(corners, axis=0))) / max(float(half_m.max()), 1e-9)
    decade = 10.0 ** np.floor(np.log10(wanted))
    magnified = float(max(step * decade for step in ROUND if step * decade <= wanted))
    colour = COLOURS[list(phases).index(known[-1]) % len(COLOURS)]
    for number, (centre, axis, length) in enumerate(zip(corners, axes, half_m, strict=True)):
        surface = centre + (_unit_sphere() * magnified * length) @ axis.T
        name = f"{known[-1].name}: corners, {magnified:.0f} times" if number == 0 else ""
        _add_surface(figure, surface, colour, 0.35, name, group="ellipsoids")
    return magnified


def _unit_sphere() -> FloatArray:
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 17), np.linspace(0, np.pi, 9))
    return np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1)


def _segments(start: FloatArray, end: FloatArray) -> FloatArray:
    """Points (3 m, 3) of separate lines: a gap after each."""
    return np.stack([start, end, np.full_like(start, np.nan)], axis=1).reshape(-1, 3)


def _add_surface(
    figure: "Figure", points: FloatArray, colour: str, opacity: float, name: str = "", group: str = ""
) -> None:
    x, y, z = np.moveaxis(points, -1, 0)
    figure.add_surface(
        x=x,
        y=y,
        z=z,
        showscale=False,
        opacity=opacity,
        colorscale=[[0, colour], [1, colour]],
        name=name,
        legendgroup=group,
        showlegend=bool(name),
        hoverinfo="skip",
    )


def _add_mesh(figure: "Figure", corners: FloatArray, name: str, opacity: float) -> None:
    i, j, k = np.arange(len(corners)).reshape(-1, 3).T
    x, y, z = corners.T
    figure.add_mesh3d(
        x=x, y=y, z=z, i=i, j=j, k=k, color=STANDING, opacity=opacity, name=name, flatshading=True
    )


def _add_lines(
    figure: "Figure", points: FloatArray, name: str, colour: str, width: int, group: str = ""
) -> None:
    x, y, z = points.T
    figure.add_scatter3d(
        x=x,
        y=y,
        z=z,
        mode="lines",
        name=name,
        line={"color": colour, "width": width},
        legendgroup=group,
        showlegend=bool(name),
        hoverinfo="skip",
    )
