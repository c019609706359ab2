"""Compiled rows and descent of a sensor that sees planes; `chain` and `fitting` hold the same in numpy.

A setup is, in this order: root (n, n) of the chart; mount (4, 4) and its active freedoms; object (4, 4) and
its active freedoms; poses (m, 4, 4) base_T_flange of each reading; readings (m, 3) in the sensor; normals
(m, 3) and offsets (m,) of the planes in the object; covariance of the poses (m, 6, 6) and of the readings
(m, 3, 3).
"""

import math
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from estimation import posterior
from estimation.chart import moved
from estimation.model import Ended
from estimation.transform import FloatArray

Vector = tuple[float, float, float]
Setup = tuple[Any, ...]
Limits = tuple[int, int, float, float, float]
Evaluated = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
after = numba.njit(cache=True)(posterior.after)
SMALL, FLOOR, STUCK, LONG, INFINITE = (int(ended) for ended in Ended)


@numba.njit(cache=True)
def _point(pose: FloatArray, p: Vector) -> Vector:
    x, y, z = p
    return (
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3],
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3],
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3],
    )


@numba.njit(cache=True)
def _forth(pose: FloatArray, direction: Vector) -> Vector:
    x, y, z = direction
    return (
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z,
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z,
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z,
    )


@numba.njit(cache=True)
def _back(pose: FloatArray, direction: Vector) -> Vector:
    x, y, z = direction
    return (
        pose[0, 0] * x + pose[1, 0] * y + pose[2, 0] * z,
        pose[0, 1] * x + pose[1, 1] * y + pose[2, 1] * z,
        pose[0, 2] * x + pose[1, 2] * y + pose[2, 2] * z,
    )


@numba.njit(cache=True)
def _fill(row: FloatArray, g: Vector, p: Vector, s: float) -> None:
    """s [g, p x g] into `row` (6,)."""
    row[0], row[1], row[2] = s * g[0], s * g[1], s * g[2]
    row[3] = s * (p[1] * g[2] - p[2] * g[1])
    row[4] = s * (p[2] * g[0] - p[0] * g[2])
    row[5] = s * (p[0] * g[1] - p[1] * g[0])


@numba.njit(cache=True)
def _products(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
    """a @ b + c @ d of matrices so small that calling a library takes longer."""
    total = np.zeros((a.shape[0], b.shape[1]))
    for i in range(total.shape[0]):
        row = total[i]
        for k in range(a.shape[1]):
            first, second = a[i, k], c[i, k]
            for j in range(len(row)):
                row[j] += first * b[k, j] + second * d[k, j]
    return total


@numba.njit(cache=True)
def _product(a: FloatArray, b: FloatArray) -> FloatArray:
    """a @ b, likewise."""
    total = np.zeros((a.shape[0], b.shape[1]))
    for i in range(total.shape[0]):
        row = total[i]
        for k in range(a.shape[1]):
            for j in range(len(row)):
                row[j] += a[i, k] * b[k, j]
    return total


@numba.njit(cache=True)
def _normal(jacobian: FloatArray, weight: FloatArray, prior: FloatArray) -> FloatArray:
    """J^T W^2 J (n, n) with the prior rows (n,) on its diagonal."""
    count, size = jacobian.shape
    normal, row = np.zeros((size, size)), np.empty(size)
    for i in range(count):
        for j in range(size):
            row[j] = weight[i] * jacobian[i, j]
        for j in range(size):
            for k in range(size):
                normal[j, k] += row[j] * row[k]
    for j in range(size):
        normal[j, j] += prior[j]
    return normal


@numba.njit(cache=True)
def _gradient(jacobian: FloatArray, weighted: FloatArray) -> FloatArray:
    """J^T weighted (n,)."""
    gradient = np.zeros(jacobian.shape[1])
    for i in range(jacobian.shape[0]):
        for j in range(jacobian.shape[1]):
            gradient[j] += jacobian[i, j] * weighted[i]
    return gradient


@numba.njit(cache=True)
def _rows(places: tuple[FloatArray, FloatArray], setup: Setup) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Signed distances (m,) from the planes, and derivatives by mount and object (m, 6), both at `places`."""
    mount, holder = places
    poses, sensor_p, normals, offsets = setup[5], setup[6], setup[7], setup[8]
    count = len(offsets)
    residual, by_mount, by_object = np.empty(count), np.empty((count, 6)), np.empty((count, 6))
    for i in range(count):
        pose = poses[i]
        p = (sensor_p[i, 0], sensor_p[i, 1], sensor_p[i, 2])
        far = _point(pose, _point(mount, p))
        there = _back(holder, (far[0] - holder[0, 3], far[1] - holder[1, 3], far[2] - holder[2, 3]))
        g = (normals[i, 0], normals[i, 1], normals[i, 2])
        residual[i] = g[0] * there[0] + g[1] * there[1] + g[2] * there[2] - offsets[i]
        _fill(by_object[i], g, there, -1.0)
        _fill(by_mount[i], _back(mount, _back(pose, _forth(holder, g))), p, 1.0)
    return residual, by_mount, by_object


@numba.njit(cache=True)
def _variances(mount: FloatArray, by_mount: FloatArray, setup: Setup) -> tuple[FloatArray, FloatArray]:
    """Variances (m,) of the rows, m^2: from the poses and from the readings."""
    sensor_p, of_poses, of_readings = setup[6], setup[9], setup[10]
    count, twist = len(by_mount), np.empty(6)
    from_poses, from_readings = np.zeros(count), np.zeros(count)
    for i in range(count):
        g = (by_mount[i, 0], by_mount[i, 1], by_mount[i, 2])
        for j in range(3):
            for k in range(3):
                from_readings[i] += g[j] * of_readings[i, j, k] * g[k]
        near = _point(mount, (sensor_p[i, 0], sensor_p[i, 1], sensor_p[i, 2]))
        _fill(twist, _forth(mount, g), near, 1.0)
        for j in range(6):
            for k in range(6):
                from_poses[i] += twist[j] * of_poses[i, j, k] * twist[k]
    return from_poses, from_readings


@numba.njit(cache=True)
def _at(z: FloatArray, setup: Setup) -> tuple[tuple[FloatArray, FloatArray], FloatArray, FloatArray]:
    """Mount and object at z (n,), and their B^-1 root, (6, n) each."""
    root, own = setup[0], len(setup[2])
    change = _product(root, z.reshape(-1, 1))[:, 0]
    mount, mount_chart = moved(setup[1], change[:own], setup[2])
    holder, holder_chart = moved(setup[3], change[own:], setup[4])
    return (mount, holder), _product(mount_chart, root[:own]), _product(holder_chart, root[own:])


@numba.njit(cache=True)
def _linear(z: FloatArray, setup: Setup) -> tuple[FloatArray, FloatArray]:
    """Residuals (m,) and their Jacobian (m, n) by z."""
    places, along_mount, along_object = _at(z, setup)
    residual, by_mount, by_object = _rows(places, setup)
    return residual, _products(by_mount, along_mount, by_object, along_object)


@numba.njit(cache=True)
def evaluated(z: FloatArray, setup: Setup) -> Evaluated:
    """At z (n,): residuals (m,), derivatives by mount and object (m, 6), variances (m,) from poses and from
    readings, and the Jacobian (m, n) by z.
    """
    places, along_mount, along_object = _at(z, setup)
    residual, by_mount, by_object = _rows(places, setup)
    from_poses, from_readings = _variances(places[0], by_mount, setup)
    jacobian = _products(by_mount, along_mount, by_object, along_object)
    return residual, by_mount, by_object, from_poses, from_readings, jacobian


@numba.njit(cache=True)
def _solved(normal: FloatArray, right: FloatArray) -> FloatArray:
    """As `chart.solved`, for one right side (n,)."""
    diagonal = np.diag(normal)
    if not diagonal.min() > 0.0:
        raise np.linalg.LinAlgError("an element of the diagonal is not positive")
    scale = 1.0 / np.sqrt(diagonal)
    scaled, solution = np.empty(normal.shape), np.zeros(len(scale))
    for j in range(len(scale)):
        for k in range(len(scale)):
            scaled[j, k] = normal[j, k] * scale[j] * scale[k]
    inverse = np.linalg.inv(scaled)  # a solution takes ten times as long to compile
    for j in range(len(scale)):
        for k in range(len(scale)):
            solution[j] += scale[j] * inverse[j, k] * scale[k] * right[k]
    return solution


@numba.njit(cache=True)
def _steps(
    z: FloatArray, weight: FloatArray, prior: FloatArray, tolerance: float, limits: Limits, setup: Setup
) -> tuple[int, FloatArray, FloatArray, float, float]:
    """What `descent` gives but for the rows."""
    most, polishing, rounding_m, rounding, largest_damping = limits
    error, jacobian = _linear(z, setup)
    residual = weight * error
    cost = np.dot(residual, residual) + np.dot(z, prior * z)
    costs = np.empty(most + 1)
    costs[0] = cost
    damping, growth, last_step, polished, steepest = 0.0, 2.0, np.inf, 0, np.inf
    for number in range(most):
        normal = _normal(jacobian, weight, prior)
        gradient = _gradient(jacobian, weight * residual) + prior * z
        newton = _solved(normal, -gradient)
        expected = max(-np.dot(gradient, newton), 0.0)
        steepest = np.max(np.abs(gradient) / np.sqrt(np.diag(normal)))
        if steepest <= tolerance and min(last_step, math.sqrt(expected)) <= tolerance:
            return SMALL, z, costs[: number + 1], steepest, last_step
        if polished >= polishing:
            return FLOOR, z, costs[: number + 1], steepest, last_step
        at_floor = expected <= rounding_m * np.linalg.norm(residual * weight) + rounding * cost
        polished += at_floor
        while True:
            if damping == 0.0 or at_floor:
                step = newton
            else:
                step = _solved(normal + damping * np.diag(np.diag(normal)), -gradient)
            trial = z + step
            error, jacobian = _linear(trial, setup)
            trial_residual = weight * error
            trial_cost = np.dot(trial_residual, trial_residual) + np.dot(trial, prior * trial)
            if not math.isfinite(trial_cost):
                return INFINITE, z, costs[: number + 1], steepest, last_step
            promised = -np.dot(step, 2.0 * gradient + normal @ step)
            gain = (cost - trial_cost) / promised
            if trial_cost <= cost or at_floor:
                trial_cost = min(trial_cost, cost)
                break
            if damping > largest_damping:
                return STUCK, z, costs[: number + 1], steepest, last_step
            damping, growth = max(damping * growth, 1e-3), growth * 2.0
        damping = 0.0 if gain > 0.9 else damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
        growth = 2.0
        last_step = math.sqrt(max(np.dot(step, normal @ step), 0.0))
        z, residual, cost = trial, trial_residual, trial_cost
        costs[number + 1] = cost
    return LONG, z, costs, steepest, last_step


@numba.njit(cache=True)
def descent(
    z: FloatArray, weight: FloatArray, prior: FloatArray, tolerance: float, limits: Limits, setup: Setup
) -> tuple[int, FloatArray, Evaluated, FloatArray, NDArray[np.intp], float, float]:
    """Levenberg-Marquardt of `fitting`, step by step the same; raises LinAlgError where an unknown is open.

    limits: iterations, polishing steps, rounding of a residual (m) and of the cost, largest damping.
    Returns how it ended (`SMALL`, `FLOOR`, `STUCK`, `LONG`, `INFINITE`), z, `evaluated` there, the costs
    (1, .) on the way and how many there are, the gradient and the last step in standard deviations.
    """
    ended, z, costs, steepest, last_step = _steps(z, weight, prior, tolerance, limits, setup)
    lengths = np.array([len(costs)])
    return ended, z, evaluated(z, setup), costs.reshape(1, -1), lengths, steepest, last_step


@numba.njit(cache=True)
def reweighted(
    z: FloatArray,
    used: NDArray[np.bool_],
    prior: FloatArray,
    passes: tuple[int, float, float, float],
    limits: Limits,
    setup: Setup,
) -> tuple[int, FloatArray, Evaluated, FloatArray, NDArray[np.intp], float, float]:
    """The passes of `fitting.reweighted`: how many at most, tolerances of the first and of the others, and
    the least variance of a row (m^2).

    Returns what `descent` does of the last, with the costs (p, .) of all passes.
    """
    most, first_tolerance, last_tolerance, least_variance = passes
    costs, lengths = np.empty((most, limits[0] + 1)), np.zeros(most, dtype=np.intp)
    found = evaluated(z, setup)
    variance = np.maximum(found[3] + found[4], least_variance)
    ended, steepest, last_step, done = LONG, np.inf, np.inf, 0
    for number in range(most):
        tolerance = last_tolerance if number else first_tolerance
        weight = used / np.sqrt(variance)
        ended, z, course, steepest, last_step = _steps(z, weight, prior, tolerance, limits, setup)
        lengths[number], done = len(course), number + 1
        costs[number, : len(course)] = course
        found = evaluated(z, setup)
        latest = np.maximum(found[3] + found[4], least_variance)
        settled = np.max(np.abs(latest / variance - 1.0)) < last_tolerance
        variance = latest
        if ended > FLOOR or (settled and number):
            break
    return ended, z, found, costs, lengths[:done], steepest, last_step
