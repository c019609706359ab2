"""The problem of choosing measurements: what is known, what could be measured, what shall become certain."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from estimation.errors import EstimationError
from estimation.transform import FloatArray

_NEGLIGIBLE_VARIANCE = 1e-14  # of the largest, in the correlation: such a direction is known exactly


@dataclass(frozen=True, eq=False)
class DesignProblem:
    """m candidate measurements of a state of n unknowns, shared errors among them as states.

    Attributes
    ----------
    covariance : (n, n) of everything uncertain, before. An error that several measurements share is an
        unknown here, so it does not average out. It may be singular.
    rows : (m, n) derivative of each candidate's residual by the state.
    variance : (m,) independent noise of each candidate, in the unit of the residual squared.
    targets : (g, k, n) derivatives of g judged quantities of k components each, such as gated points with
        k = 3. None judges the whole state, in units of its prior.

    Raises
    ------
    EstimationError
        Shapes that do not fit, numbers that are not finite, a variance that is not positive.
    """

    covariance: FloatArray
    rows: FloatArray
    variance: FloatArray
    targets: FloatArray | None = None

    def __post_init__(self) -> None:
        size, count = len(self.covariance), len(self.rows)
        shapes = {
            "covariance": (self.covariance, (size, size)),
            "rows": (self.rows, (count, size)),
            "variance": (self.variance, (count,)),
        }
        if self.targets is not None:
            shapes["targets"] = (self.targets, (*self.targets.shape[:-1], size))
            if self.targets.ndim != 3:
                raise EstimationError(f"Targets of shape {self.targets.shape}", "Give (g, k, n)")
        for name, (values, shape) in shapes.items():
            if values.shape != shape or not np.isfinite(values).all():
                raise EstimationError(
                    f"{name}: shape {values.shape}, expected {shape}, or numbers that are not finite",
                    "Leave out candidates without a valid row",
                )
        if count and not self.variance.min() > 0.0:
            raise EstimationError(
                f"A candidate with a noise variance of {self.variance.min():.3g}",
                "Declare the noise of every measurement: without any, one would suffice",
            )

    def __len__(self) -> int:
        return len(self.rows)

    @cached_property
    def root(self) -> FloatArray:
        """(n, r) with root root^T = covariance, r its rank: the state in units in which it is white."""
        scale = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        scale = np.where(scale > 0.0, scale, 1.0)
        values, axes = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        kept = values > _NEGLIGIBLE_VARIANCE * max(float(values[-1]), 0.0)
        root: FloatArray = scale[:, None] * axes[:, kept] * np.sqrt(values[kept])
        return root

    @cached_property
    def white_rows(self) -> FloatArray:
        """(m, r) rows by the white state, in units of their noise: information is b b^T."""
        columns = self.root.T @ self.rows.T  # passes over all candidates read one state after the other
        columns /= np.sqrt(self.variance)
        return np.asarray(columns.T)

    @cached_property
    def white_targets(self) -> FloatArray:
        """(g, k, r) judged quantities by the white state."""
        if self.targets is None:
            return np.eye(self.root.shape[1])[None]
        return np.asarray(self.targets @ self.root)

    def judged(self, white: FloatArray) -> FloatArray:
        """Covariances Z (g, k, k) of the judged quantities, from that of the white state (r, r)."""
        return np.asarray(self.white_targets @ white @ self.white_targets.swapaxes(-1, -2))

    def white_covariance(
        self, weights: FloatArray | None = None, chosen: NDArray[np.intp] | None = None
    ) -> FloatArray:
        """Covariance (r, r) of the white state after the chosen candidates (or all), `weights` times each."""
        rows = self.white_rows if chosen is None else self.white_rows[chosen]
        weighted = rows if weights is None else rows * weights[:, None]
        information = np.eye(rows.shape[1]) + weighted.T @ rows
        inverse = np.linalg.inv(information)
        return 0.5 * (inverse + inverse.T)

    def after(self, white: FloatArray) -> FloatArray:
        """Covariance (n, n) of the state, from that of the white state (r, r)."""
        return np.asarray(self.root @ white @ self.root.T)
