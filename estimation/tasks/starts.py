"""Starts without a guess: with one rotation given, the rest is a linear problem; so try rotations.

A point at the near end of the arm is s + E p, with the origin s and the axes E of the sensor; at the far end
R_i (s + E p) + t_i. For planes of the object with R_object given, and for points of it with E given, what is
left is linear, and is solved for all rotations of a grid at once.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimation.transform import FloatArray, Transform

_RIDGE: Final = 1e-9  # of the mean diagonal: unknowns that these data do not see stay at zero
_WELL_DETERMINED: Final = 1e-3  # smallest over largest singular value
SMALLEST_GAP_RAD: Final = np.deg2rad(20.0)  # two starts closer than this roll into the same minimum


def rotations(count: int = 576) -> FloatArray:
    """(count, 3, 3), evenly over all rotations. Source: M. Alexa (2022), Super-Fibonacci spirals."""
    golden, psi = np.sqrt(2.0), 1.533751168755204288118041
    s = np.arange(count) + 0.5
    t = s / count
    radius, rest = np.sqrt(t), np.sqrt(1.0 - t)
    alpha, beta = 2.0 * np.pi * s / golden, 2.0 * np.pi * s / psi
    quaternion = [radius * np.sin(alpha), radius * np.cos(alpha), rest * np.sin(beta), rest * np.cos(beta)]
    return Rotation.from_quat(np.column_stack(quaternion)).as_matrix()


def directions(count: int = 256) -> FloatArray:
    """(count, 3, 3) rotations whose z axes are evenly over all directions: for what has no spin."""
    i = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1.0 - 2.0 * i / count), np.pi * (1.0 + np.sqrt(5.0)) * i
    return np.asarray(Rotation.from_euler("ZY", np.column_stack([azimuth, polar])).as_matrix())


def on_planes(
    pose: FloatArray, sensor_p: FloatArray, normal: FloatArray, offset_m: FloatArray, grid: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Starts from readings on planes of an object.

    Parameters
    ----------
    pose : (m, 4, 4) far_T_near of each reading.
    sensor_p : (m, 3) readings in the frame of the sensor.
    normal, offset_m : (m, 3), (m,) plane normal . p = offset of each reading, in the object.
    grid : (g, 3, 3) rotations of the object to try.

    Returns
    -------
    near_T_sensor (g, 4, 4), far_T_object (g, 4, 4).
    """
    far_n = np.einsum("gij,mj->gmi", grid, normal)
    near_n = np.einsum("gmi,mij->gmj", far_n, pose[:, :3, :3])
    target = offset_m - np.einsum("gmi,mi->gm", far_n, pose[:, :3, 3])
    used = np.flatnonzero(np.abs(sensor_p).max(axis=0) > 0.0)
    along = [sensor_p[None, :, axis, None] * near_n for axis in used]
    design = np.concatenate([near_n, -far_n, *along], axis=2)
    solution = least_squares(design, target)
    axes = np.zeros((len(grid), 3, 3))
    for column, axis in enumerate(used):
        axes[:, :, axis] = solution[:, 6 + 3 * column : 9 + 3 * column]
    mount = nearest_rotation(_completed(axes, used))
    # The axes were free to have any length: once they are rotations, place the origins anew.
    turned = np.einsum("gij,mj->gmi", mount, sensor_p)
    remaining = target - np.einsum("gmi,gmi->gm", near_n, turned)
    design = np.concatenate([near_n, -far_n], axis=2)
    origins = least_squares(design, remaining)
    return _poses(mount, origins[:, :3]), _poses(grid, origins[:, 3:])


def on_points(
    pose: FloatArray, sensor_p: FloatArray, marker_p: FloatArray, grid: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Starts from readings of known points of an object; `grid` (g, 3, 3) are rotations of the sensor.

    marker_p (m, 3) in the object; others as in `on_planes`. With one marker only, the object's frame has no
    rotation and its origin is where the marker is. Returns the root mean square distance (g,), m, as well.
    """
    count, rows = len(grid), len(pose)
    turned = np.einsum("mij,gjk,mk->gmi", pose[:, :3, :3], grid, sensor_p)
    target = -(turned + pose[:, :3, 3])
    spread = marker_p - marker_p.mean(axis=0)
    single = not np.abs(spread).max() > 1e-9
    near = np.broadcast_to(pose[None, :, :3, :3], (count, rows, 3, 3))
    minus = np.broadcast_to(-np.eye(3), (count, rows, 3, 3))
    parts = [near, minus]
    if not single:  # rotation of the object as nine free numbers, row by row
        parts.append(
            np.broadcast_to(
                -np.einsum("ij,mk->mijk", np.eye(3), spread).reshape(rows, 3, 9), (count, rows, 3, 9)
            )
        )
    design = np.concatenate(parts, axis=3).reshape(count, 3 * rows, -1)
    solution = least_squares(design, target.reshape(count, -1))
    holder = np.broadcast_to(np.eye(3), (count, 3, 3))
    if not single:
        holder = nearest_rotation(solution[:, 6:].reshape(count, 3, 3))
        held = np.einsum("gij,mj->gmi", holder, spread)
        design = np.concatenate(parts[:2], axis=3).reshape(count, 3 * rows, 6)
        target = target + held
        solution = least_squares(design, target.reshape(count, -1))
    residual = np.einsum("gmk,gk->gm", design, solution) - target.reshape(count, -1)
    centre = solution[:, 3:6] - np.einsum("gij,j->gi", holder, marker_p.mean(axis=0))
    return _poses(grid, solution[:, :3]), _poses(holder, centre), _rms(residual)


def on_one_point(pose: FloatArray, sensor_p: FloatArray) -> FloatArray | None:
    """Rotation (3, 3) of a sensor that sees one point from all poses; None where it cannot be told so.

    pose (m, 4, 4) far_T_near, sensor_p (m, 3). Nine free numbers stand for the rotation, which makes it all
    linear: it takes points that are spread in space.
    """
    rows, near = len(pose), pose[:, :3, :3]
    axes = np.einsum("mij,mk->mijk", near, sensor_p).reshape(rows, 3, 9)
    minus = np.broadcast_to(-np.eye(3), (rows, 3, 3))
    design = np.concatenate([near, minus, axes], axis=2).reshape(3 * rows, 15)
    singular = np.linalg.svd(design / np.maximum(np.linalg.norm(design, axis=0), 1e-12), compute_uv=False)
    if rows < 5 or singular[-1] < _WELL_DETERMINED * singular[0]:
        return None
    solution = least_squares(design[None], -pose[:, :3, 3].reshape(1, -1))[0]
    return nearest_rotation(solution[6:].reshape(3, 3))


def spun(frame: Transform) -> Transform:
    """The frame with its x axis turned about its z axis, to where only z decides."""
    matrix = frame.matrix.copy()
    axes = np.zeros((1, 3, 3))
    axes[0, :, 2] = matrix[:3, 2]
    matrix[:3, :3] = _completed(axes, np.array([2]))[0]
    return Transform(frame.target, frame.source, matrix)


def facing(plane: Transform, front_p: FloatArray, spot_p: FloatArray) -> Transform:
    """The frame of a plane z = 0 with `front_p` (m, 3) in front of it and its origin amid spots (m, 3).

    Readings tell neither; about an origin far away, tilts would be worth more than they are.
    """
    middle = spot_p.mean(axis=0)
    matrix = plane.matrix.copy()
    matrix[:3, 3] += plane.vectors(np.array([middle[0], middle[1], 0.0]))
    if front_p[:, 2].mean() < 0.0:
        matrix[:3, 1:3] *= -1.0
    return spun(Transform(plane.target, plane.source, matrix))


def best(
    cost: FloatArray, *turns: FloatArray, count: int = 6, apart_rad: float = SMALLEST_GAP_RAD
) -> list[int]:
    """Places of the lowest costs whose rotations (g, 3, 3), any of `turns`, are not close to a better one.

    Of what has no spin, give (g, 3, 1): the z axes. Without any rotation all count as different.
    """
    chosen: list[int] = []
    nearest = [np.cos(apart_rad) if turn.shape[2] == 1 else 1.0 + 2.0 * np.cos(apart_rad) for turn in turns]
    for place in np.argsort(cost, kind="stable").tolist():
        close = np.full(len(chosen), bool(turns))
        for turn, limit in zip(turns, nearest, strict=True):
            close &= np.einsum("cij,ij->c", turn[chosen], turn[place]) > limit
        if not close.any():
            chosen.append(place)
        if len(chosen) == count:
            break
    return chosen


def nearest_rotation(matrices: FloatArray) -> FloatArray:
    """The rotation (..., 3, 3) next to each matrix, in the sense of least squares."""
    u, _, v = np.linalg.svd(matrices)
    u = u.copy()
    u[..., :, 2] *= np.linalg.det(u @ v)[..., None]
    return np.asarray(u @ v)


def _completed(axes: FloatArray, used: NDArray[np.intp]) -> FloatArray:
    """Matrices (g, 3, 3) whose columns `used` are given: unit vectors, the others square to them."""
    if len(used) == 3:
        return axes
    if len(used) == 2:
        other = 3 - int(used.sum())
        a, b = axes[:, :, (other + 1) % 3], axes[:, :, (other + 2) % 3]
        axes = axes.copy()
        axes[:, :, other] = _unit(np.cross(a, b))
        axes[:, :, (other + 1) % 3], axes[:, :, (other + 2) % 3] = _unit(a), _unit(b)
        return axes
    if len(used) == 0:
        return np.broadcast_to(np.eye(3), axes.shape)
    z = _unit(axes[:, :, int(used[0])])
    helper = np.eye(3)[np.argmin(np.abs(z), axis=1)]
    x = _unit(np.cross(helper, z))
    completed = np.empty_like(axes)
    first = int(used[0])
    completed[:, :, first], completed[:, :, (first + 1) % 3] = z, x
    completed[:, :, (first + 2) % 3] = np.cross(z, x)
    return completed


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))


def least_squares(design: FloatArray, target: FloatArray) -> FloatArray:
    """Least squares (g, u) of many problems (g, m, u), (g, m) at once."""
    normal = design.swapaxes(1, 2) @ design
    diagonal = np.maximum(np.einsum("gii->gi", normal), 1e-300)
    scale = 1.0 / np.sqrt(np.where(diagonal > _RIDGE * diagonal.max(), diagonal, diagonal.max()))
    scaled = normal * scale[:, :, None] * scale[:, None, :] + _RIDGE * np.eye(normal.shape[1])
    right = np.einsum("gmu,gm->gu", design, target) * scale
    return np.asarray(np.linalg.solve(scaled, right[:, :, None])[:, :, 0] * scale)


def _poses(rotation: FloatArray, origin: FloatArray) -> FloatArray:
    poses = np.zeros((len(rotation), 4, 4))
    poses[:, :3, :3], poses[:, :3, 3], poses[:, 3, 3] = rotation, origin, 1.0
    return poses


def _rms(residual: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(residual**2, axis=1)))
