"""Positioners anywhere, and points of objects on their tables: turns of its own about lines in space."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimation.tasks.positioner import PositionerPlanes, PositionerPoints, PositionerSphere, PositionerTask
from estimation.tasks.turning import Turning
from tests.estimation.tasks.cells import BALL_M, RADIUS_M, anywhere, block_faces
from tests.estimation.twin import DEG, MM

FloatArray = NDArray[np.float64]
ANGLE_RAD, POINT_M = 0.001 * DEG, 0.01 * MM


@dataclass(frozen=True)
class PositionerCell:
    """A problem; its axes, each a point and a direction where all angles are zero; object on the table."""

    problem: Any
    axes: tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
    object: FloatArray


def turned(axis: tuple[FloatArray, FloatArray], angle: FloatArray, points: FloatArray) -> FloatArray:
    """Points (m, 3), each turned by its angle (m,) about an axis."""
    point, direction = axis
    turn = Rotation.from_rotvec(angle[:, None] * direction)
    return np.asarray(point + turn.apply(points - point))


def direction(rng: np.random.Generator) -> FloatArray:
    """A unit vector."""
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def positioner_cell(
    rng: np.random.Generator,
    kind: str = "points",
    count: int = 16,
    each: int = 1,
    still: tuple[int, ...] = (),
    known: bool = False,
    angle_rad: float = ANGLE_RAD,
    turns_deg: tuple[float, float] = (70.0, 170.0),
) -> PositionerCell:
    """`each` points at each of `count` poses: markers told apart, or touches of sphere or block."""
    axes = [(rng.uniform(-1.0, 1.0, 3), direction(rng)) for _ in range(2)]
    if np.linalg.norm(np.cross(axes[0][1], axes[1][1])) < 0.3:
        axes[1] = (axes[1][0], np.roll(axes[1][1], 1))
    angle = rng.uniform(-1.0, 1.0, (count, 2)) * np.array(turns_deg) * DEG
    angle[:, list(still)] = 0.3
    pose = np.repeat(np.arange(count), each)
    placed = anywhere(rng, 0.2)
    placed[:3, 3] += axes[1][0]
    if kind == "points":
        own = rng.uniform(-0.2, 0.2, (each, 3))
        local, extra = np.tile(own, (count, 1)), {"marker_index": np.tile(np.arange(each), count)}
        if known:
            extra["markers_m"] = own
    elif kind == "sphere":
        local = np.array([direction(rng) for _ in pose]) * (RADIUS_M + BALL_M)
        extra = {"ball_radius_m": BALL_M, "radius_m": RADIUS_M}
    else:
        faces = block_faces()
        face = np.tile(np.arange(each) % len(faces), count)
        normal = np.array([faces[i].axis for i in face])
        along = rng.uniform(-0.04, 0.04, normal.shape)
        along -= np.einsum("mi,mi->m", along, normal)[:, None] * normal
        local = np.array([faces[i].point_m for i in face]) + along + BALL_M * normal
        extra = {"ball_radius_m": BALL_M, "faces": faces, "face_index": face}
    points = local @ placed[:3, :3].T + placed[:3, 3]
    points = turned(axes[0], angle[pose, 0], turned(axes[1], angle[pose, 1], points))
    noise = np.where(np.isin([0, 1], still), 0.0, angle_rad)
    kinds: dict[str, type[PositionerTask]] = {
        "points": PositionerPoints,
        "sphere": PositionerSphere,
        "planes": PositionerPlanes,
    }
    problem = kinds[kind](
        motion=Turning(angle + rng.normal(size=angle.shape) * noise, angle_rad),
        points_m=points + rng.normal(size=points.shape) * POINT_M,
        covariance=POINT_M**2 * np.eye(3),
        pose_index=pose,
        **extra,
    )
    return PositionerCell(problem, (axes[0], axes[1]), placed)
