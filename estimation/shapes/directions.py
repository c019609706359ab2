"""Starts for surfaces of revolution: a linear fit for each of many directions of the axis.

The square of the distance from an axis of direction w is a polynomial of degree 2 in the coordinates, so all
that a linear fit needs for any w are the moments of the ten monomials up to that degree, summed once.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from estimation.shapes.shape import frame_of
from estimation.transform import FloatArray

_DIRECTIONS: Final = 400  # on the half sphere: neighbours are 7 deg apart
_KEPT: Final = 5  # directions of least cost, each at least this far from the better ones:
_APART: Final = np.cos(np.radians(15.0))
_RIDGE: Final = 1e-13  # of the largest moment: directions without curvature stay solvable
_SMALLEST_STEEPNESS: Final = 1e-6  # square of the slope, of a cone that looks like a cylinder
_STEEPEST: Final = np.tan(np.radians(89.9))


@dataclass(frozen=True, slots=True, eq=False)
class Revolved:
    """A surface of revolution whose radius at `point` is `radius`, and grows by `slope` along `axis`."""

    axis: FloatArray
    point: FloatArray
    square: float  # of the radius
    slope: float = 0.0

    @property
    def radius(self) -> float:
        return float(np.sqrt(self.square))


class Revolutions:
    """Cylinders and cones near points (n, 3) that are centred and of size 1."""

    def __init__(self, points: FloatArray) -> None:
        monomials = _monomials(points)
        self._moments = monomials @ monomials.T / len(points)
        self._directions = np.vstack(
            [half_sphere(_DIRECTIONS), principal(points), _quadric_axes(self._moments)]
        )
        frames = frame_of(self._directions)
        self._u, self._v, self._w = frames[:, :, 0], frames[:, :, 1], frames[:, :, 2]

    def cylinders(self) -> list[Revolved]:
        """The best directions, with axis and radius."""
        rho_square, (u, v, _, one, _) = self._features()
        solution, error = self._solved(np.stack([u, v, one], axis=1), rho_square)
        square = solution[:, 2] + (solution[:, 0] ** 2 + solution[:, 1] ** 2) / 4.0
        cost = np.where(square > 0.0, error / np.maximum(4.0 * square, 1e-12), np.inf)
        return [
            Revolved(self._w[i], self._point(i, solution[i]), float(square[i]))
            for i in self._best(cost, self._directions)
        ]

    def cones(self) -> list[Revolved]:
        """The best directions, with axis, a point on it, and the radius and slope there."""
        rho_square, (u, v, w, one, w_square) = self._features()
        # rho^2 is best for slender cones, w^2 for flat ones, whose steepness would be near infinity
        slender, error = self._solved(np.stack([u, v, w, one, w_square], axis=1), rho_square)
        flat, flat_error = self._solved(np.stack([u, v, w, one, rho_square], axis=1), w_square)
        with np.errstate(divide="ignore", invalid="ignore"):
            turned = np.column_stack([-flat[:, :4], np.ones(len(flat))]) / flat[:, 4:]
            turned_error = flat_error / flat[:, 4] ** 2
        return [*self._cones(slender, error, w_square), *self._cones(turned, turned_error, w_square)]

    def _cones(self, solution: FloatArray, error: FloatArray, w_square: FloatArray) -> list[Revolved]:
        """The best of u^2 + v^2 = a u + b v + c w + d + steepness w^2."""
        middle = solution[:, 3] + (solution[:, 0] ** 2 + solution[:, 1] ** 2) / 4.0  # rho^2 where w = 0
        steepness = solution[:, 4]
        mean = middle + steepness * (w_square @ self._moments[0])
        with np.errstate(divide="ignore", invalid="ignore"):
            cost = error / (1.0 + np.maximum(steepness, 0.0)) / (4.0 * mean)
        cost[~np.isfinite(cost) | (steepness > _STEEPEST**2) | (mean <= 1e-12)] = np.inf
        found = []
        for i in self._best(cost, self._directions):
            slope = float(np.sqrt(max(steepness[i], _SMALLEST_STEEPNESS)))
            square = float(max(middle[i], 1e-6 * mean[i]))
            # the term in w is 2 radius slope: it says to which side the cone opens
            axis = self._w[i] if solution[i, 2] >= 0.0 else -self._w[i]
            found.append(Revolved(axis, self._point(i, solution[i]), square, slope))
        return found

    def _features(self) -> tuple[FloatArray, tuple[FloatArray, ...]]:
        """Rows (m, 10) over the monomials: u^2 + v^2, and u, v, w, 1, w^2, for each direction."""
        count = len(self._directions)
        zero, one = np.zeros((count, 10)), np.zeros((count, 10))
        one[:, 0] = 1.0
        linear = []
        for axis in (self._u, self._v, self._w):
            row = zero.copy()
            row[:, 1:4] = axis
            linear.append(row)
        x, y, z = self._w.T
        w_square = zero.copy()
        w_square[:, 4:] = np.stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z], axis=1)
        rho_square = -w_square
        rho_square[:, 4:7] += 1.0
        return rho_square, (*linear, one, w_square)

    def _solved(self, rows: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Least squares (m, k) of targets (m, 10) by rows (m, k, 10), and the mean squares (m,) left."""
        weighted = rows @ self._moments
        normal = weighted @ rows.swapaxes(1, 2)
        right = np.einsum("mkt,mt->mk", weighted, target)
        scale = np.einsum("mkk->m", normal)
        normal += _RIDGE * scale[:, None, None] * np.eye(rows.shape[1])
        solution = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
        left = target - np.einsum("mk,mkt->mt", solution, rows)
        error = np.einsum("mt,mt->m", left @ self._moments, left)
        return solution, np.maximum(error, 0.0)

    def _point(self, i: int, solution: FloatArray) -> FloatArray:
        """On the axis, where w = 0."""
        return np.asarray((self._u[i] * solution[0] + self._v[i] * solution[1]) / 2.0)

    def _best(self, cost: FloatArray, directions: FloatArray) -> list[int]:
        """Places of the least costs that are well apart from each other."""
        chosen: list[int] = []
        for i in np.argsort(cost, kind="stable")[:200]:
            apart = np.abs(directions[chosen] @ directions[i]) < _APART
            if np.isfinite(cost[i]) and apart.all():
                chosen.append(int(i))
            if len(chosen) == _KEPT:
                break
        return chosen


def _monomials(points: FloatArray) -> FloatArray:
    """(10, n): 1, x, y, z, x^2, y^2, z^2, xy, xz, yz."""
    x, y, z = points.T
    return np.stack([np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z])


def half_sphere(count: int) -> FloatArray:
    """Directions (count, 3), evenly spread: a Fibonacci spiral."""
    number = np.arange(count)
    z = (number + 0.5) / count
    turn = number * np.pi * (3.0 - np.sqrt(5.0))
    rho = np.sqrt(1.0 - z * z)
    return np.column_stack([rho * np.cos(turn), rho * np.sin(turn), z])


def principal(points: FloatArray) -> FloatArray:
    """Principal directions (3, 3) of the points: the axis of a long cylinder, or of a ring."""
    return np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]


def _quadric_axes(moments: FloatArray) -> FloatArray:
    """Principal directions (3, 3) of the quadric nearest to the points: exact for points without noise."""
    _, vectors = np.linalg.eigh(moments)
    xx, yy, zz, xy, xz, yz = vectors[4:, 0]
    quadric = np.array([[2 * xx, xy, xz], [xy, 2 * yy, yz], [xz, yz, 2 * zz]])
    return np.asarray(np.linalg.eigh(quadric)[1].T)
