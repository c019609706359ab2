"""Starts roll down: damped Gauss-Newton steps of many mounts and objects at once, on a few readings."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.surfaces import cross
from estimation.tasks.chain import moved_poses
from estimation.transform import FloatArray

_FIRST_DAMPING: Final = 1e-3
_RIDGE: Final = 1e-9  # of the mean diagonal of a unit: freedoms that these readings do not see stay
_STANDSTILL: Final = 1e-3  # of the cost: when no start gains as much, all are where they end
_CAUCHY: Final = 3.5  # medians of the distances, beyond which they weigh less
_SMALLEST_SCALE_M: Final = 1e-9
_SMALLEST_RADIUS_M: Final = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class OnPlanes:
    """Readings (m,) each on a plane normal . p = offset of the object, (m, 3) and (m,)."""

    normal: FloatArray
    offset_m: FloatArray

    def see(self, object_p: FloatArray, radius_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distances (g, m) of points (g, m, 3), and their gradients."""
        distance = np.einsum("gmi,mi->gm", object_p, self.normal) - self.offset_m
        return distance, np.broadcast_to(self.normal, object_p.shape)

    def at(self, rows: NDArray[np.intp]) -> "OnPlanes":
        """Some readings."""
        return OnPlanes(self.normal[rows], self.offset_m[rows])


@dataclass(frozen=True, slots=True, eq=False)
class OnSphere:
    """Readings all on the sphere about the origin of the object."""

    def see(self, object_p: FloatArray, radius_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distances (g, m) of points (g, m, 3) from spheres of radius (g,), and their gradients."""
        length = np.maximum(np.linalg.norm(object_p, axis=2), 1e-9)
        return length - radius_m[:, None], object_p / length[:, :, None]

    def at(self, rows: NDArray[np.intp]) -> "OnSphere":
        """Some readings."""
        return self


@dataclass(frozen=True, slots=True, eq=False)
class Few:
    """Readings to make starts from: poses far_T_near (m, 4, 4), points (m, 3), and what they are on."""

    pose: FloatArray
    sensor_p: FloatArray
    target: OnPlanes | OnSphere

    def thinned(self, count: int) -> "Few":
        """At most so many of them, from first to last."""
        rows = np.unique(np.linspace(0, len(self.pose) - 1, count).astype(np.intp))
        return Few(self.pose[rows], self.sensor_p[rows], self.target.at(rows))


@dataclass(frozen=True, slots=True, eq=False)
class Rolled:
    """Starts: near_T_sensor and far_T_object (g, 4, 4), radius (g,), and mean square distance (g,), m^2."""

    mount: FloatArray
    holder: FloatArray
    radius_m: FloatArray
    square_m2: FloatArray

    def at(self, places: list[int] | NDArray[np.intp]) -> "Rolled":
        """Some of them."""
        return Rolled(self.mount[places], self.holder[places], self.radius_m[places], self.square_m2[places])


def rolled(readings: Few, start: Rolled, free: NDArray[np.bool_], steps: int, robust: bool = False) -> Rolled:
    """Where the starts are after some steps; none is worse than it was.

    Parameters
    ----------
    free : (13,) freedoms that move: [t; phi] of the mount and of the object, right perturbations, and radius.
    robust : Cauchy's loss, with the scale that half of the readings of each start have where it begins; and
        of the squared distances the mean of the three quarters that are smallest.
    """
    mount, holder, radius = start.mount.copy(), start.holder.copy(), start.radius_m.copy()
    residual, rows = _rows(readings, mount, holder, radius)
    scale = np.full((len(mount), 1), np.inf)
    if robust:
        scale = np.maximum(_CAUCHY * np.median(np.abs(residual), axis=1, keepdims=True), _SMALLEST_SCALE_M)
    cost, damping = _cost(residual, scale), np.full(len(mount), _FIRST_DAMPING)
    for _ in range(steps):
        step = np.zeros((len(mount), 13))
        weight = 1.0 / np.sqrt(1.0 + (residual / scale) ** 2)
        weighted = weight[:, :, None] * rows[:, :, free]
        step[:, free] = _steps(weight * residual, weighted, free, damping)
        trial = moved_poses(mount, step[:, :6]), moved_poses(holder, step[:, 6:12]), radius + step[:, 12]
        trial_residual, trial_rows = _rows(readings, *trial)
        trial_cost = _cost(trial_residual, scale)
        better = (trial_cost < cost) & ((trial[2] > _SMALLEST_RADIUS_M) | (trial[2] == radius))
        now = mount, holder, radius, residual, rows
        for old, new in zip(now, (*trial, trial_residual, trial_rows), strict=True):
            old[better] = new[better]
        if not (better & (trial_cost < (1.0 - _STANDSTILL) * cost)).any():
            break
        cost = np.where(better, trial_cost, cost)
        damping = np.where(better, damping * 0.1, damping * 10.0)
    if robust:
        most = -(-3 * residual.shape[1] // 4)
        cost = np.mean(np.sort(residual**2, axis=1)[:, :most], axis=1)
    return Rolled(mount, holder, radius, cost)


def _cost(residual: FloatArray, scale: FloatArray) -> FloatArray:
    """Mean (g,) of the loss of distances (g, m), for scales (g, 1); infinite ones mean their squares."""
    if np.isinf(scale).all():
        return np.asarray(np.mean(residual**2, axis=1))
    return np.asarray(np.mean(scale**2 * np.log1p((residual / scale) ** 2), axis=1))


def _rows(
    readings: Few, mount: FloatArray, holder: FloatArray, radius_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Distances (g, m) and their derivatives (g, m, 13)."""
    pose, sensor_p = readings.pose, readings.sensor_p
    arm = pose[:, :3, :3]
    near_p = sensor_p @ mount[:, :3, :3].swapaxes(1, 2) + mount[:, None, :3, 3]
    far_p = (near_p.swapaxes(0, 1) @ arm.swapaxes(1, 2)).swapaxes(0, 1) + pose[:, :3, 3]
    object_p = (far_p - holder[:, None, :3, 3]) @ holder[:, :3, :3]
    residual, gradient = readings.target.see(object_p, radius_m)
    far_g = gradient @ holder[:, :3, :3].swapaxes(1, 2)
    sensor_g = (far_g.swapaxes(0, 1) @ arm).swapaxes(0, 1) @ mount[:, :3, :3]
    rows = np.empty((*residual.shape, 13))
    rows[:, :, :3], rows[:, :, 3:6] = sensor_g, cross(sensor_p, sensor_g)
    rows[:, :, 6:9], rows[:, :, 9:12], rows[:, :, 12] = -gradient, -cross(object_p, gradient), -1.0
    return residual, rows


def _steps(
    residual: FloatArray, rows: FloatArray, free: NDArray[np.bool_], damping: FloatArray
) -> FloatArray:
    normal = rows.swapaxes(1, 2) @ rows
    right = -(rows.swapaxes(1, 2) @ residual[:, :, None])
    diagonal = np.einsum("gkk->gk", normal)
    angle = np.array([*[False] * 3, *[True] * 3] * 2 + [False])[free]
    mean = np.where(
        angle,
        np.sum(diagonal * angle, axis=1, keepdims=True),
        np.sum(diagonal * ~angle, axis=1, keepdims=True),
    ) / len(angle)
    places = np.arange(len(angle))
    normal[:, places, places] += damping[:, None] * diagonal + _RIDGE * mean + np.finfo(float).tiny
    return np.asarray(np.linalg.solve(normal, right)[:, :, 0])
