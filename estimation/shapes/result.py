"""What a fit gives: the surface, how well it is known, and what is needed to judge it."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtr, chdtrc

from estimation.errors import EstimationError
from estimation.shapes.refusals import Flag
from estimation.shapes.shape import Shape
from estimation.statistics import coverage_factor
from estimation.transform import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Quantity:
    """One parameter with its uncertainty.

    `unit` is "m" or "rad". For points and directions the uncertainties are the largest in any direction.
    `expanded` holds the parameter with 95 % probability; None with too few degrees of freedom for a factor.
    """

    name: str
    value: FloatArray | float
    unit: str
    standard: float
    expanded: float | None


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """The least-squares surface of some points, metres and radians.

    Attributes
    ----------
    shape : the surface; `shape.parameters()` describes it.
    frame : the shape in whose frame (origin, axes u, v, w) the covariance stands.
    parameter_names : of the covariance: small shifts along and tilts about u, v, w of the surface in its own
        frame (a right, or body, perturbation), then changes of radii and angles.
    covariance : (p, p), m and rad, of these.
    sigma_m : standard deviation of the points along the normal, given or found from the residuals; None when
        given for each point or as a matrix.
    dof : degrees of freedom behind sigma: points less unknowns, or infinite when sigma was given.
    redundancy : points used less unknowns.
    rms_m : root of the mean squared distance of the points used.
    weighted_cost : sum of squared residuals over sigma, where sigma was given.
    rejected : places of the points that the outlier gate left out.
    cost, initial_cost : sum of squared distances, m^2 (weighted: without unit), at the end and at the start.
    alternative_ratio : cost of the next best minimum over that of the best one; infinite when there is none.
    """

    shape: Shape
    frame: Shape
    parameter_names: tuple[str, ...]
    covariance: FloatArray
    sigma_m: float | None
    dof: float
    redundancy: int
    rms_m: float
    variance_factor: float | None
    points: int
    rejected: NDArray[np.intp]
    flags: tuple[Flag, ...]
    iterations: int
    initial_cost: float
    cost: float
    stop_reason: str
    alternative_ratio: float
    _points_m: FloatArray
    _weights: FloatArray
    _information: FloatArray

    @property
    def weights(self) -> FloatArray:
        """(n,) 1 over the standard deviations that were given, 0 for rejected points; (0,) for equal ones."""
        return self._weights

    @property
    def surface(self) -> str:
        """ "plane", "sphere", "cylinder", "cone" or "torus"."""
        return self.shape.KIND

    @property
    def units(self) -> tuple[str, ...]:
        """Of the rows of the covariance, "m" or "rad"."""
        return tuple("rad" if self.shape.is_angle(name) else "m" for name in self.parameter_names)

    @cached_property
    def quantities(self) -> Mapping[str, Quantity]:
        """Each parameter with standard and expanded uncertainty (95 %)."""
        values = self.shape.parameters()
        found = {}
        for name, freedoms in self.shape.GROUPS.items():
            places = [self.parameter_names.index(freedom) for freedom in freedoms]
            block = self.covariance[np.ix_(places, places)]
            standard = float(np.sqrt(np.linalg.eigvalsh(block)[-1]))
            unit = self.units[places[0]]
            expanded: float | None
            try:
                expanded = standard * coverage_factor(len(places), dof=self.dof)
            except EstimationError:
                expanded = None
            found[name] = Quantity(name, values[name], unit, standard, expanded)
        return MappingProxyType(found)

    @property
    def p_value(self) -> float | None:
        """Probability of residuals at least as far from the given sigma, on either side, or None."""
        if self.variance_factor is None or self.redundancy == 0:
            return None
        chi2 = self.variance_factor * self.redundancy
        return float(2.0 * min(chdtr(self.redundancy, chi2), chdtrc(self.redundancy, chi2), 0.5))

    def residuals(self) -> FloatArray:
        """(n,) distances in metres, rejected points included."""
        return self.shape.distance(self._points_m)

    def leverage(self) -> FloatArray:
        """(n,) from 0 (checked by the others) to 1 (believed blindly); 0 for rejected points."""
        rows = self.shape.rows(self._points_m)[:-1]
        if len(self._weights):
            rows = rows * self._weights
        return np.asarray(np.einsum("in,in->n", rows, np.linalg.solve(self._information, rows)))

    def standardised(self) -> FloatArray:
        """(n,) residuals over their own standard deviations; 0 where leverage leaves nothing to judge."""
        residual = self.residuals()
        own = np.maximum(1.0 - self.leverage(), 0.0)
        sigma = self._point_sigma(residual)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(own > 1e-9, residual / (sigma * np.sqrt(own)), 0.0)

    def _point_sigma(self, residual: FloatArray) -> FloatArray:
        if self.sigma_m is not None:
            return np.full(len(residual), self.sigma_m)
        return np.asarray(1.0 / np.where(self._weights > 0.0, self._weights, np.inf))

    def diagnostics(self) -> dict[str, Any]:
        """How the optimum was reached."""
        return {
            "iterations": self.iterations,
            "initial_cost": self.initial_cost,
            "final_cost": self.cost,
            "stop_reason": self.stop_reason,
            "next_minimum_cost_ratio": self.alternative_ratio,
            "points": self.points,
            "rejected": len(self.rejected),
        }
