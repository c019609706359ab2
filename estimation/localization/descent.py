"""Many poses at once roll down the distances of a few points: the coarse part of every search for a pose."""

from collections.abc import Callable
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from estimation.surfaces import cross
from estimation.transform import FloatArray

# Points (..., 3) in the object -> distances (...) and their gradients (..., 3).
Distance = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
_FIRST_DAMPING: Final = 1e-3
_RIDGE: Final = 1e-9  # of the mean diagonal: a few points on a plane do not hold all freedoms


def descend(
    poses: FloatArray, base_p: FloatArray, distance: Distance, steps: int
) -> tuple[FloatArray, FloatArray]:
    """Damped Gauss-Newton steps of all poses base_T_object (g, 4, 4) at once.

    base_p : (m, 3) points measured on the object; few, because all poses see all of them.

    Returns the poses after `steps` steps, and the mean square distance (g,) of each, m^2.
    """
    poses = poses.copy()
    residual, rows = _rows(poses, base_p, distance)
    cost, damping = np.mean(residual**2, axis=1), np.full(len(poses), _FIRST_DAMPING)
    for _ in range(steps):
        trial = _moved(poses, _steps(residual, rows, damping))
        trial_residual, trial_rows = _rows(trial, base_p, distance)
        trial_cost = np.mean(trial_residual**2, axis=1)
        better = trial_cost < cost
        poses[better], residual[better], rows[better] = (
            trial[better],
            trial_residual[better],
            trial_rows[better],
        )
        cost = np.where(better, trial_cost, cost)
        damping = np.where(better, damping * 0.1, damping * 10.0)
    return poses, cost


def distinct(poses: FloatArray, cost: FloatArray, apart_m: float, radius_m: float, count: int) -> list[int]:
    """Places of the lowest costs, no two of which put any point of the object nearer than `apart_m`.

    radius_m : how far points of the object are from its origin.
    """
    chosen: list[int] = []
    corners = radius_m * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, -1, -1.0]])
    placed = np.einsum("gij,kj->gki", poses[:, :3, :3], corners) + poses[:, None, :3, 3]
    for place in np.argsort(cost, kind="stable").tolist():
        gaps = np.linalg.norm(placed[chosen] - placed[place], axis=2).max(axis=1, initial=0.0)
        if not chosen or gaps.min() > apart_m:
            chosen.append(place)
        if len(chosen) == count:
            break
    return chosen


def _rows(poses: FloatArray, base_p: FloatArray, distance: Distance) -> tuple[FloatArray, FloatArray]:
    """Residuals (g, m) and minus their derivatives (g, m, 6) by right perturbations."""
    object_p = (base_p - poses[:, None, :3, 3]) @ poses[:, :3, :3]
    residual, gradient = distance(object_p)
    return residual, np.concatenate([gradient, cross(object_p, gradient)], axis=2)


def _steps(residual: FloatArray, rows: FloatArray, damping: FloatArray) -> FloatArray:
    normal = rows.swapaxes(1, 2) @ rows
    right = np.einsum("gmk,gm->gk", rows, residual)
    diagonal = np.einsum("gkk->gk", normal)
    # Rotations and translations have different units, and so different means.
    floor = _RIDGE * np.repeat(diagonal.reshape(-1, 2, 3).mean(axis=2), 3, axis=1) + np.finfo(float).tiny
    places = np.arange(6)
    normal[:, places, places] += damping[:, None] * diagonal + floor
    return np.asarray(np.linalg.solve(normal, right[:, :, None])[:, :, 0])


def _moved(poses: FloatArray, step: FloatArray) -> FloatArray:
    moved = poses.copy()
    moved[:, :3, 3] += np.einsum("gij,gj->gi", poses[:, :3, :3], step[:, :3])
    moved[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(step[:, 3:]).as_matrix()
    return moved
