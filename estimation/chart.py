"""The prior of a belief as a chart of the state: whitened coordinates, and rows as functions of them."""

import math
from collections.abc import Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray

from estimation.belief import Belief, Value
from estimation.compiling import compiled, plain_copy
from estimation.errors import DegenerateGeometry, EstimationError
from estimation.model import Model, Point, Rows, compiled_model
from estimation.transform import FloatArray, Transform

Vector = tuple[float, float, float]


class Chart:
    """The prior as a chart: r0 = L z with z ~ N(0, I), and rows as functions of z.

    A flat freedom is its own coordinate (m, rad), with no prior row: `prior_rows` (n,) is 0 there, else 1.
    """

    def __init__(self, belief: Belief, model: Model, consider: Sequence[str] = ()) -> None:
        self.belief, self.model = belief, model
        # Blocks to consider only: in the chart they are exactly known, so that nothing moves them.
        prior = belief.prior_covariance
        for name in consider:
            prior = prior.copy()
            prior[belief.index(name)] = prior[:, belief.index(name)] = 0.0
        self.root = square_root(prior)
        self.prior_rows = prior_rows(belief, self.root)
        self.considers = bool(consider)
        self.compiled = compiled_model(model, belief, self.root)

    def weighed_at(self, z: FloatArray) -> "Chart":
        """The same chart of a model that keeps the whitening it has at z."""
        if self.compiled is not None:  # scalar rows, which whiten nothing
            return self
        chart = copy(self)
        chart.model = self.model.weighed_at(self.at(z)[0])
        return chart

    def at(self, z: FloatArray) -> tuple[dict[str, Value], dict[str, FloatArray]]:
        """Values at z, and for each pose B^-1 (6, a): a change of r0 as a right perturbation there."""
        deviation = self.root @ z
        values: dict[str, Value] = {}
        charts: dict[str, FloatArray] = {}
        for block in self.belief.blocks:
            change = deviation[self.belief.index(block.name)]
            if isinstance(block.value, Transform):
                matrix, charts[block.name] = moved(plain_copy(block.value.matrix), change, block.active)
                values[block.name] = Transform(block.value.target, block.value.source, matrix)
            else:
                values[block.name] = block.value + change
        return values, charts

    def linear(self, z: FloatArray) -> tuple[Rows, FloatArray]:
        """Rows at z, with their Jacobian (m, n) by r0. Raises EstimationError when they are not finite."""
        values, charts = self.at(z)
        rows = self.model.rows(values)
        dense = np.zeros((len(rows.residual_m), self.belief.size))
        for name, matrix in rows.jacobian.items():
            if name in self.belief:
                dense[:, self.belief.index(name)] = matrix @ charts[name] if name in charts else matrix
        _require_finite(rows, dense)
        return rows, dense

    def evaluate(self, z: FloatArray) -> Point:
        """Rows at z, with their Jacobian by z. Raises EstimationError when they are not finite."""
        if self.compiled is not None:
            point = self.compiled.at(z)
            _require_finite(*point[1:])
            return point
        rows, dense = self.linear(z)
        return z, rows, dense @ self.root


def not_finite() -> EstimationError:
    """What is raised when a residual is infinite or not a number."""
    return EstimationError("A residual is not a finite number", "Check joints, readings and priors")


def _require_finite(rows: Rows, jacobian: FloatArray) -> None:
    if not np.isfinite(rows.residual_m).all() or not np.isfinite(jacobian).all():
        raise not_finite()


def prior_rows(belief: Belief, root: FloatArray) -> FloatArray:
    """(n,) weight of z^2 in the joint cost: 1, or 0 if flat, which then has a column in `root` as well."""
    flat = belief.flat
    root[flat, flat] = 1.0
    return np.where(flat, 0.0, 1.0)


def solved(normal: FloatArray, right: FloatArray) -> FloatArray:
    """normal^-1 right for a positive definite matrix, whatever the units of its unknowns."""
    diagonal = np.diag(normal)
    try:
        if not diagonal.min(initial=1.0) > 0.0:
            raise np.linalg.LinAlgError
        scale = 1.0 / np.sqrt(diagonal)
        scaled = np.linalg.solve(normal * np.outer(scale, scale), (right.T * scale).T)
    except np.linalg.LinAlgError as error:
        raise undetermined() from error
    return np.asarray((scaled.T * scale).T)


def undetermined() -> DegenerateGeometry:
    """What is raised when normal equations cannot be solved."""
    return DegenerateGeometry(
        "The measurements do not determine every unknown", "Measure from more and other directions"
    )


def square_root(covariance: FloatArray) -> FloatArray:
    """L (n, n) with L L^T = covariance, which may be singular."""
    if not covariance.any():  # all flat, or all exactly known
        return np.zeros(covariance.shape)
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(std > 0.0, std, 1.0)
    correlation = covariance / np.outer(scale, scale)
    try:
        root = np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:  # singular: something is known exactly
        values, vectors = np.linalg.eigh(correlation)
        # Symmetric, so that an unknown without covariance keeps a zero row and a zero column of its own.
        root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return scale[:, None] * root


@compiled
def _turning(x: float, y: float, z: float, odd: float, even: float) -> tuple[Vector, Vector, Vector]:
    """I + odd [v]x + even [v]x^2 (3, 3) of v = (x, y, z), written out: products of arrays take far longer."""
    own = 1.0 - even * (x * x + y * y + z * z)
    xy, xz, yz = even * x * y, even * x * z, even * y * z
    ox, oy, oz = odd * x, odd * y, odd * z
    return (
        (own + even * x * x, xy - oz, xz + oy),
        (xy + oz, own + even * y * y, yz - ox),
        (xz - oy, yz + ox, own + even * z * z),
    )


@compiled
def moved(pose: FloatArray, change: FloatArray, active: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
    """A pose (4, 4) moved by r0 = `change` (k,) of its `active` freedoms, and B^-1 (6, k) there.

    B^-1 turns a further change of r0 into a right perturbation: R^T for the translation, Jr for the rotation.
    """
    xi = np.zeros(6)
    for i in range(len(active)):
        xi[active[i]] = change[i]
    x, y, z = xi[3], xi[4], xi[5]
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle < 1e-3:  # the series are exact to rounding here, the closed forms are not
        first, second, third = 1.0 - square / 6.0, 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    else:
        first, second = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
        third = (angle - math.sin(angle)) / (square * angle)
    turn = _turning(x, y, z, first, second)
    right = _turning(x, y, z, -second, third)
    matrix, inverse = np.empty((4, 4)), np.zeros((6, len(active)))
    for i in range(4):
        matrix[i, 3] = pose[i, 3]
        for j in range(3):
            matrix[i, j] = 0.0
            matrix[i, 3] += pose[i, j] * xi[j]
            for k in range(3):
                matrix[i, j] += pose[i, k] * turn[k][j]
    for j in range(len(active)):
        column = active[j]
        for i in range(3):
            if column < 3:
                inverse[i, j] = turn[column][i]
            else:
                inverse[3 + i, j] = right[i][column - 3]
    return matrix, inverse
