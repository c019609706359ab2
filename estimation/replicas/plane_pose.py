"""Replicas of the pose of an object from points on its planes."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from estimation.errors import EstimationError
from estimation.replicas import LARGEST_ITERATIONS, TOLERANCE
from estimation.surfaces import cross
from estimation.transform import FloatArray, Transform

try:
    from estimation.replicas import chord_kernels as kernels
except ImportError:  # numba is optional: numpy gives the same numbers
    kernels = None  # type: ignore[assignment]

COMPILED: Final = kernels is not None


@dataclass(frozen=True, slots=True, eq=False)
class PlanePoses:
    """Replicas of an object's pose.

    rotations, origins_m : (k, 3, 3), (k, 3) of base_T_object.
    covariance : (6, 6) at the mean solution, of right perturbations (form A), order (t, phi), m and rad.
    iterations : of the slowest replica.
    """

    rotations: FloatArray
    origins_m: FloatArray
    covariance: FloatArray
    iterations: int


def plane_poses(
    base_p: FloatArray, normals: FloatArray, offsets_m: FloatArray, weights: FloatArray, start: Transform
) -> PlanePoses:
    """The pose of each replica.

    base_p : (k, n, 3) measured points, one set for each replica.
    normals, offsets_m : (n, 3), (n,) of the plane normal . p = offset, in the object, on which each lies.
    weights : (n,) one over the variance of a point along its normal, 1/m^2.
    start : base_T_object near the solution of the mean points.

    Raises EstimationError where the points leave a freedom open, or a replica does not settle.
    """
    rotation, origin = start.rotation[None].copy(), start.matrix[None, :3, 3].copy()
    mean = base_p.mean(axis=0)[None]
    for _ in range(LARGEST_ITERATIONS):  # Gauss-Newton on the mean points
        rows, residual = _rows(mean, normals, offsets_m, rotation, origin)
        covariance = _covariance(rows[0], weights)
        step = -(residual * weights) @ rows[0] @ covariance
        rotation, origin = _moved(rotation, origin, step)
        if np.max(np.abs(step[0]) / np.sqrt(np.diag(covariance))) < TOLERANCE:
            break
    else:
        raise EstimationError("The mean of the replicas did not settle", "Check the points and the start")
    covariance = _covariance(_rows(mean, normals, offsets_m, rotation, origin)[0][0], weights)
    chord = _by_kernels if COMPILED else _by_numpy
    rotations, origins = (np.repeat(part, len(base_p), axis=0) for part in (rotation, origin))
    iterations = chord(base_p, normals, offsets_m, weights, covariance, rotations, origins)
    if iterations < 0:
        raise EstimationError(
            f"A replica did not settle in {LARGEST_ITERATIONS} iterations",
            "The noise is too large for the linear result: run the estimator itself on each replica",
        )
    return PlanePoses(rotations, origins, covariance, iterations)


def _by_kernels(
    base_p: FloatArray,
    normals: FloatArray,
    offsets_m: FloatArray,
    weights: FloatArray,
    covariance: FloatArray,
    rotations: FloatArray,
    origins: FloatArray,
) -> int:
    """Moves the poses to the optimum of each replica; the iterations of the slowest, or -1."""
    return kernels.plane_pose(
        np.ascontiguousarray(base_p.swapaxes(1, 2)),
        np.ascontiguousarray(normals.T),
        np.ascontiguousarray(offsets_m),
        np.ascontiguousarray(weights),
        covariance,
        np.sqrt(np.diag(covariance)),
        TOLERANCE,
        LARGEST_ITERATIONS,
        rotations,
        origins,
    )


def _by_numpy(
    base_p: FloatArray,
    normals: FloatArray,
    offsets_m: FloatArray,
    weights: FloatArray,
    covariance: FloatArray,
    rotations: FloatArray,
    origins: FloatArray,
) -> int:
    """As `_by_kernels`, all replicas at once."""
    deviations = np.sqrt(np.diag(covariance))
    open_ = np.arange(len(base_p))
    for iteration in range(1, LARGEST_ITERATIONS + 1):
        rows, residual = _rows(base_p[open_], normals, offsets_m, rotations[open_], origins[open_])
        step = -np.einsum("kn,kni->ki", residual * weights, rows) @ covariance
        rotations[open_], origins[open_] = _moved(rotations[open_], origins[open_], step)
        open_ = open_[~(np.max(np.abs(step) / deviations, axis=1) < TOLERANCE)]
        if not open_.size:
            return iteration
    return -1


def _rows(
    base_p: FloatArray, normals: FloatArray, offsets_m: FloatArray, rotations: FloatArray, origins: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives (k, n, 6) by a right perturbation, and residuals (k, n)."""
    object_p = (base_p - origins[:, None]) @ rotations
    across = cross(object_p, normals)
    rows = -np.concatenate([np.broadcast_to(normals, object_p.shape), across], axis=2)
    return rows, np.einsum("kni,ni->kn", object_p, normals) - offsets_m


def _moved(rotations: FloatArray, origins: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    turned = rotations @ Rotation.from_rotvec(step[:, 3:]).as_matrix()
    return turned, origins + np.einsum("kij,kj->ki", rotations, step[:, :3])


def _covariance(rows: FloatArray, weights: FloatArray) -> FloatArray:
    """(6, 6) of a solution with rows (n, 6). Raises EstimationError where a freedom is open."""
    weighted = np.sqrt(weights)[:, None] * rows
    scale = np.maximum(np.linalg.norm(weighted, axis=0), np.finfo(np.float64).tiny)
    singular = np.linalg.svd(weighted / scale, compute_uv=False)
    if len(rows) < 6 or not singular[-1] > 1e-9 * singular[0]:
        raise EstimationError(
            "The points leave a freedom of the object open", "Measure on planes in three directions"
        )
    return np.asarray(np.linalg.inv(weighted.T @ weighted))
