"""Replicas of a laser's hand-eye on a plane.

Flange poses and variances are shared: in numpy, residuals and gradients of all replicas are a few products
of small matrices.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from estimation.errors import EstimationError
from estimation.replicas import LARGEST_ITERATIONS, TOLERANCE
from estimation.transform import FloatArray

try:
    from estimation.replicas import chord_kernels as kernels
except ImportError:  # numba is optional: numpy gives the same numbers
    kernels = None  # type: ignore[assignment]

COMPILED: Final = kernels is not None
State = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
Axes = tuple[FloatArray, FloatArray]
Variances = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class PlaneHandEye:
    """Replicas of a laser's hand-eye on one plane.

    origin_m, beam : (k, 3) the laser's origin on the flange and its unit direction.
    normal, offset_m : (k, 3), (k,) the plane normal . p = offset.
    covariance : (8, 8) at the mean solution: the origin, two shifts of the beam along the axes `beam_across`
        (3, 2), two of the normal along `normal_across` (small: radians), and the offset.
    iterations : of the slowest replica.
    """

    origin_m: FloatArray
    beam: FloatArray
    normal: FloatArray
    offset_m: FloatArray
    covariance: FloatArray
    beam_across: FloatArray
    normal_across: FloatArray
    iterations: int


def plane_hand_eye(
    rotations: FloatArray,
    positions_m: FloatArray,
    ranges_m: FloatArray,
    variances: Variances,
    start: tuple[FloatArray, FloatArray, FloatArray, float],
) -> PlaneHandEye:
    """The hand-eye of each replica.

    rotations, positions_m : (n, 3, 3), (n, 3) of the flange in the base.
    ranges_m : (k, n) readings, one row for each replica.
    variances : (n,) of each range, and (n,) of what else moves its residual, m^2. Weights follow from them at
        each replica's own solution, as the estimator's do; with zeros in the first they stand still.
    start : origin, beam, normal and offset near the solution of the mean readings.

    Raises EstimationError where the plan does not determine the mean solution, or a replica does not settle.
    """
    origin_0, beam_0, normal_0, offset_0 = start
    mean = ranges_m.mean(axis=0)[None]
    state = (origin_0[None], beam_0[None], normal_0[None], np.array([offset_0]))
    for _ in range(LARGEST_ITERATIONS):  # Gauss-Newton on the mean readings
        hessian, across = _hessian(rotations, positions_m, mean[0], variances, state)
        step = -_gradient(rotations, positions_m, mean, variances, state, across) @ np.linalg.inv(hessian)
        state = _moved(state, step, across)
        if np.max(np.abs(step) * np.sqrt(np.diag(hessian))) < TOLERANCE:
            break
    else:
        raise EstimationError("The mean of the replicas did not settle", "Check the plan and the start")
    hessian, across = _hessian(rotations, positions_m, mean[0], variances, state)
    covariance = np.asarray(np.linalg.inv(hessian), dtype=np.float64)
    chord = _by_kernels if COMPILED else _by_numpy
    (origin, beam, normal, offset), iterations = chord(
        rotations, positions_m, ranges_m, variances, state, across, covariance
    )
    if iterations < 0:
        raise EstimationError(
            f"A replica did not settle in {LARGEST_ITERATIONS} iterations",
            "The noise is too large for the linear result: run the estimator itself on each replica",
        )
    return PlaneHandEye(origin, beam, normal, offset, covariance, *across, iterations)


def _by_kernels(
    rotations: FloatArray,
    positions_m: FloatArray,
    ranges_m: FloatArray,
    variances: Variances,
    mean: State,
    across: Axes,
    covariance: FloatArray,
) -> tuple[State, int]:
    """Where each replica ends, and the iterations of the slowest, or -1."""
    origin, beam, normal, offset = (part[0] for part in mean)
    states = np.tile(np.array([*origin, 0.0, 0.0, 0.0, 0.0, offset]), (len(ranges_m), 1))
    iterations = kernels.hand_eye(
        np.ascontiguousarray(rotations.reshape(-1, 9).T),
        np.ascontiguousarray(positions_m.T),
        np.ascontiguousarray(ranges_m),
        np.ascontiguousarray(variances[0]),
        np.ascontiguousarray(variances[1]),
        np.column_stack([across[0], beam]),
        np.column_stack([across[1], normal]),
        covariance,
        np.sqrt(np.diag(covariance)),
        TOLERANCE,
        LARGEST_ITERATIONS,
        states,
    )
    units = []
    for pair, lead, first in ((across[0], beam, 3), (across[1], normal, 5)):
        moved = lead + states[:, first : first + 2] @ pair.T
        units.append(moved / np.sqrt(np.einsum("ki,ki->k", moved, moved))[:, None])
    return (states[:, :3].copy(), units[0], units[1], states[:, 7].copy()), iterations


def _by_numpy(
    rotations: FloatArray,
    positions_m: FloatArray,
    ranges_m: FloatArray,
    variances: Variances,
    mean: State,
    across: Axes,
    covariance: FloatArray,
) -> tuple[State, int]:
    """As `_by_kernels`, all replicas at once."""
    origin, beam, normal, offset = (np.repeat(part, len(ranges_m), axis=0) for part in mean)
    deviations = np.sqrt(np.diag(covariance))
    open_ = np.arange(len(ranges_m))  # not settled yet: the last few take several times as long
    for iteration in range(1, LARGEST_ITERATIONS + 1):
        state = (origin[open_], beam[open_], normal[open_], offset[open_])
        step = -_gradient(rotations, positions_m, ranges_m[open_], variances, state, across) @ covariance
        origin[open_], beam[open_], normal[open_], offset[open_] = _moved(state, step, across)
        open_ = open_[~(np.max(np.abs(step) / deviations, axis=1) < TOLERANCE)]
        if not open_.size:
            return (origin, beam, normal, offset), iteration
    return (origin, beam, normal, offset), -1


def _gradient(
    rotations: FloatArray,
    positions_m: FloatArray,
    ranges_m: FloatArray,
    variances: Variances,
    state: State,
    across: Axes,
) -> FloatArray:
    """(k, 8) of half the cost, with e = n . (R (t + d u) + p) - c."""
    origin, beam, normal, offset = state
    turns = rotations.reshape(len(rotations), 9)
    count = len(origin)
    by_origin = (normal[:, :, None] * origin[:, None, :]).reshape(count, 9) @ turns.T
    by_beam = (normal[:, :, None] * beam[:, None, :]).reshape(count, 9) @ turns.T
    weights = 1.0 / (variances[0] * by_beam**2 + variances[1])
    error = weights * (by_origin + ranges_m * by_beam + normal @ positions_m.T - offset[:, None])
    at_origin = (error @ turns).reshape(count, 3, 3)  # sums of w e R, and of w e d R
    at_range = ((error * ranges_m) @ turns).reshape(count, 3, 3)
    by_t = np.einsum("kji,kj->ki", at_origin, normal)
    by_u = np.einsum("kji,kj->ki", at_range, normal)
    by_n = (
        np.einsum("kij,kj->ki", at_origin, origin)
        + np.einsum("kij,kj->ki", at_range, beam)
        + error @ positions_m
    )
    beam_across, normal_across = across
    return np.column_stack(
        [
            by_t,
            _tangent(by_u, beam, beam_across),
            _tangent(by_n, normal, normal_across),
            -error.sum(axis=1),
        ]
    )


def _tangent(by_vector: FloatArray, unit: FloatArray, across: FloatArray) -> FloatArray:
    """Derivatives by the two coordinates of `_turned`, from those by the unit vector itself."""
    lead = np.cross(across[:, 0], across[:, 1])
    length = unit @ lead  # unit = (lead + across z) length
    along = np.einsum("ki,ki->k", by_vector, unit)
    return np.asarray((by_vector - along[:, None] * unit) @ across * length[:, None])


def _moved(state: State, step: FloatArray, across: Axes) -> State:
    origin, beam, normal, offset = state
    return (
        origin + step[:, :3],
        _turned(beam, step[:, 3:5], across[0]),
        _turned(normal, step[:, 5:7], across[1]),
        offset + step[:, 7],
    )


def _turned(unit: FloatArray, step: FloatArray, across: FloatArray) -> FloatArray:
    """Unit vectors with their coordinates in the plane across the mean direction moved by `step`."""
    lead = np.cross(across[:, 0], across[:, 1])
    moved = unit / (unit @ lead)[:, None] + step @ across.T
    return np.asarray(moved / np.sqrt(np.einsum("ki,ki->k", moved, moved))[:, None])


def _hessian(
    rotations: FloatArray, positions_m: FloatArray, ranges_m: FloatArray, variances: Variances, state: State
) -> tuple[FloatArray, Axes]:
    """(8, 8) of Gauss and Newton at one solution, and the axes across its beam and normal."""
    origin, beam, normal = (part[0] for part in state[:3])
    across = (_across(beam), _across(normal))
    by_t = np.einsum("nji,j->ni", rotations, normal)
    point = np.einsum("nij,nj->ni", rotations, origin + ranges_m[:, None] * beam) + positions_m
    jacobian = np.column_stack(
        [by_t, ranges_m[:, None] * by_t @ across[0], point @ across[1], np.full(len(point), -1.0)]
    )
    weights = 1.0 / (variances[0] * (by_t @ beam) ** 2 + variances[1])
    scale = np.linalg.norm(np.sqrt(weights)[:, None] * jacobian, axis=0)
    singular = np.linalg.svd(np.sqrt(weights)[:, None] * jacobian / scale, compute_uv=False)
    if len(jacobian) < 8 or singular[-1] < 1e-9 * singular[0]:
        raise EstimationError("The plan leaves a freedom of the hand-eye open", "Tilt the tool in more ways")
    return np.asarray(jacobian.T @ (weights[:, None] * jacobian)), across


def _across(unit: FloatArray) -> FloatArray:
    """(3, 2) two axes across a unit vector, right-handed with it."""
    helper = np.eye(3)[np.argmin(np.abs(unit))]
    first = np.cross(helper, unit)
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(unit, first)])
