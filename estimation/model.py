"""What an estimator asks of measurements: residuals at given values, with derivatives and noise."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from estimation.belief import Belief, Value
from estimation.errors import EstimationError
from estimation.posterior import After
from estimation.surfaces import cross
from estimation.transform import FloatArray, Transform


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Residuals of observations at one state, with their derivatives.

    `jacobian[block]` is (m, w) by the full perturbation of a block: w = 6 for a pose (right, form A),
    the vector's length otherwise. `noise[source]` is (m,) variance, m^2; independent rows. `group` rows in
    succession make one observation: the outlier gate keeps or rejects them together.

    A vector observation with a full covariance is whitened by its model, and scaled so that its rows
    are in metres again; so is an angle.
    """

    residual_m: FloatArray
    jacobian: Mapping[str, FloatArray]
    noise: Mapping[str, FloatArray]
    group: int = 1

    @property
    def noise_variance(self) -> FloatArray:
        """Q as a diagonal (m,), m^2: sum of K_s^2 sigma_s^2 over the sources."""
        total: FloatArray = np.zeros(len(self.residual_m))
        for variance in self.noise.values():
            total += variance
        return total

    def dense(self, belief: Belief) -> FloatArray:
        """Jacobian (m, n) by the active freedoms, in the order of the belief's state."""
        dense = np.zeros((len(self.residual_m), belief.size))
        for name, matrix in self.jacobian.items():
            if name in belief:
                dense[:, belief.index(name)] = matrix[:, belief.block(name).active]
        return dense


Point = tuple[FloatArray, Rows, FloatArray]  # z, rows there, Jacobian (m, n) by z


class Model(Protocol):
    """Measurements that were taken, as a function of what they depend on."""

    def __len__(self) -> int:
        """Number of rows m."""

    def rows(self, values: Mapping[str, Value]) -> Rows:
        """Rows at these values of the blocks. Raises EstimationError when a block is missing."""

    def weighed_at(self, values: Mapping[str, Value]) -> "Model":
        """The model that whitens its rows as it does at `values`, wherever it is evaluated.

        With fixed weights the estimator has one cost to lower. A model of scalar rows, which whitens
        nothing, returns itself.
        """


class Ended(IntEnum):
    """Why a descent ended; at the first two it has found a minimum."""

    SMALL = 0
    FLOOR = 1
    STUCK = 2
    LONG = 3
    INFINITE = 4


class DescentLimits(NamedTuple):
    """When a descent gives up; `rounding` is relative to the cost, `rounding_m` of a residual."""

    iterations: int
    polishing_steps: int
    rounding_m: float
    rounding: float
    largest_damping: float


class Passes(NamedTuple):
    """Descents one after another: tolerances in standard deviations, and least variance of a row, m^2."""

    most: int
    first_tolerance: float
    tolerance: float
    least_variance: float


class Descent(NamedTuple):
    """Where descents ended, the last of them for what is one number.

    `costs` of each accepted iterate, one tuple for each descent; `gradient` is the largest, and like
    `last_step` in standard deviations.
    """

    ended: Ended
    point: Point
    costs: tuple[tuple[float, ...], ...]
    gradient: float
    last_step: float


class CompiledModel(Protocol):
    """A model and a chart of its state in one piece: the same numbers without a call for each step."""

    @property
    def after(self) -> After:
        """As `posterior.after`."""

    def at(self, z: FloatArray) -> Point:
        """Rows at z (n,)."""

    def descent(
        self, z: FloatArray, weight: FloatArray, prior: FloatArray, tolerance: float, limits: DescentLimits
    ) -> Descent:
        """Levenberg-Marquardt from z with weights (m,) and prior rows (n,).

        Raises DegenerateGeometry where the rows leave an unknown open, EstimationError where they are not
        finite.
        """

    def reweighted(
        self,
        z: FloatArray,
        used: NDArray[np.bool_],
        prior: FloatArray,
        passes: Passes,
        limits: DescentLimits,
    ) -> Descent:
        """Descents from z with the weights of each where the one before it ended; raises as `descent`."""


def compiled_model(model: Model, belief: Belief, root: FloatArray) -> CompiledModel | None:
    """The compiled form of a model that has one for such a belief; r0 = root z as in `Chart`."""
    make = getattr(model, "compiled", None)
    return None if make is None else make(belief, root)


def evaluate(belief: Belief, model: Model) -> Rows:
    """Rows at the belief's values."""
    return model.rows(values_of(belief))


def values_of(belief: Belief) -> dict[str, Value]:
    """Value of each block by its name."""
    return {block.name: block.value for block in belief.blocks}


def pose_of(values: Mapping[str, Value], name: str) -> Transform:
    """The pose of that name; raises EstimationError when it is missing."""
    value = values.get(name)
    if not isinstance(value, Transform):
        raise EstimationError(
            f"The belief has no pose {name!r}, only {', '.join(values) or 'nothing'}",
            "Run the phase that adds it first",
        )
    return value


def vector_of(values: Mapping[str, Value], name: str, size: int | None = None) -> FloatArray:
    """The vector of that name; raises EstimationError when it is missing or not of that size."""
    value = values.get(name)
    if value is None or isinstance(value, Transform):
        raise EstimationError(
            f"The belief has no vector {name!r}, only {', '.join(values) or 'nothing'}",
            "Add the block with its prior first",
        )
    if size is not None and value.size != size:
        raise EstimationError(f"Block {name!r} holds {value.size} numbers, {size} are used", "Check it")
    return value


def pose_rows(gradient: FloatArray, points: FloatArray) -> FloatArray:
    """g^T [I | -[p]x] (m, 6), the change of g . H p with H; g and p (m, 3) in the perturbed frame."""
    return np.concatenate([gradient, cross(points, gradient)], axis=1)
