"""The prior of a belief as a chart of the state: whitened coordinates, and rows as functions of them."""

import math
from collections.abc import Sequence
from copy import copy

import numpy as np

from estimation.belief import Belief, Value
from estimation.errors import DegenerateGeometry, EstimationError
from estimation.model import Model, Rows
from estimation.transform import FloatArray, Transform

Point = tuple[FloatArray, Rows, FloatArray]  # z, rows there, Jacobian (m, n) by z


class Chart:
    """The prior as a chart: r0 = L z with z ~ N(0, I), and rows as functions of z.

    A flat freedom is its own coordinate (m, rad), with no prior row: `prior_rows` (n,) is 0 there, else 1.
    """

    def __init__(self, belief: Belief, model: Model, consider: Sequence[str] = ()) -> None:
        self.belief, self.model = belief, model
        # Blocks to consider only: in the chart they are exactly known, so that nothing moves them.
        free = np.ones(belief.size, dtype=np.bool_)
        for name in consider:
            free[belief.index(name)] = False
        self.root = square_root(np.where(np.outer(free, free), belief.prior_covariance, 0.0))
        self.prior_rows = prior_rows(belief, self.root)
        self.considers = bool(consider)

    def weighed_at(self, z: FloatArray) -> "Chart":
        """The same chart of a model that keeps the whitening it has at z."""
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
                xi = np.zeros(6)
                xi[block.active] = change
                rotation, right = rotation_and_right_jacobian(xi[3:])
                moved = np.eye(4)
                moved[:3, :3], moved[:3, 3] = rotation, xi[:3]
                inverse = np.zeros((6, 6))
                inverse[:3, :3], inverse[3:, 3:] = rotation.T, right
                values[block.name] = Transform(
                    block.value.target, block.value.source, block.value.matrix @ moved
                )
                charts[block.name] = inverse[:, block.active]
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
        if not np.isfinite(rows.residual_m).all() or not np.isfinite(dense).all():
            raise EstimationError("A residual is not a finite number", "Check joints, readings and priors")
        return rows, dense

    def evaluate(self, z: FloatArray) -> Point:
        """Rows at z, with their Jacobian by z. Raises EstimationError when they are not finite."""
        rows, dense = self.linear(z)
        return z, rows, dense @ self.root


def prior_rows(belief: Belief, root: FloatArray) -> FloatArray:
    """(n,) weight of z^2 in the joint cost: 1, or 0 if flat, which then has a column in `root` as well."""
    flat = np.flatnonzero(belief.flat)
    root[flat, flat] = 1.0
    weight = np.ones(belief.size)
    weight[flat] = 0.0
    return weight


def solved(normal: FloatArray, right: FloatArray) -> FloatArray:
    """normal^-1 right for a positive definite matrix, whatever the units of its unknowns."""
    diagonal = np.diag(normal)
    try:
        if not diagonal.min(initial=1.0) > 0.0:
            raise np.linalg.LinAlgError
        scale = 1.0 / np.sqrt(diagonal)
        scaled = np.linalg.solve(normal * np.outer(scale, scale), (right.T * scale).T)
    except np.linalg.LinAlgError as error:
        raise DegenerateGeometry(
            "The measurements do not determine every unknown", "Measure from more and other directions"
        ) from error
    return np.asarray((scaled.T * scale).T)


def square_root(covariance: FloatArray) -> FloatArray:
    """L (n, n) with L L^T = covariance, which may be singular."""
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


def rotation_and_right_jacobian(rotation_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Exp(phi) and Jr(phi), (3, 3) each: Exp(phi + d) = Exp(phi) Exp(Jr d), to first order in d; rad."""
    x, y, z = rotation_rad.tolist()
    angle2 = x * x + y * y + z * z
    angle = math.sqrt(angle2)
    if angle < 1e-3:  # the series are exact to rounding here, the closed forms are not
        first, second, third = 1 - angle2 / 6, 0.5 - angle2 / 24, 1 / 6 - angle2 / 120
    else:
        first, second = math.sin(angle) / angle, (1 - math.cos(angle)) / angle2
        third = (angle - math.sin(angle)) / (angle2 * angle)
    return _turning(x, y, z, first, second, angle2), _turning(x, y, z, -second, third, angle2)


def _turning(x: float, y: float, z: float, odd: float, even: float, angle2: float) -> FloatArray:
    """I + odd [phi]x + even [phi]x^2 (3, 3), written out: products of arrays take three times as long."""
    own = 1.0 - even * angle2
    xy, xz, yz = even * x * y, even * x * z, even * y * z
    ox, oy, oz = odd * x, odd * y, odd * z
    return np.array(
        [
            [own + even * x * x, xy - oz, xz + oy],
            [xy + oz, own + even * y * y, yz - ox],
            [xz - oy, yz + ox, own + even * z * z],
        ]
    )
