"""Coverage counted: how often a stated region holds the truth, with bounds on what the count proves."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import special

from estimation.errors import EstimationError
from estimation.statistics import coverage_factor
from estimation.transform import FloatArray

Verdict = Literal["honest", "claims too much", "claims too little"]


def normalised_error_squared(error: FloatArray, covariance: FloatArray) -> float:
    """NEES e^T P^-1 e of an error (m,): chi-square with m degrees of freedom when P (m, m) is honest."""
    return float(error @ np.linalg.solve(covariance, error))


def rate_bounds(count: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Clopper-Pearson bounds of a rate of which `count` in `trials` were seen, two-sided."""
    if not 0 <= count <= trials or trials < 1:
        raise EstimationError(f"{count} of {trials}", "Count no more than there were")
    tail = (1.0 - confidence) / 2.0
    low = 0.0 if count == 0 else float(special.betaincinv(count, trials - count + 1, tail))
    high = 1.0 if count == trials else float(special.betaincinv(count + 1, trials - count, 1.0 - tail))
    return low, high


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """NEES (n,) of one quantity with m freedoms over many cells, and how many cells were refused."""

    dimension: int
    nees: FloatArray
    refused: int = 0

    @property
    def cells(self) -> int:
        """All of them, refused ones included."""
        return len(self.nees) + self.refused

    @property
    def inside(self) -> int:
        """Cells whose truth lies inside the stated 95 % region."""
        return int(np.sum(self.nees <= coverage_factor(self.dimension) ** 2))

    @property
    def share(self) -> float:
        """Of the cells that were not refused."""
        return self.inside / max(len(self.nees), 1)

    def bounds(self, confidence: float = 0.95) -> tuple[float, float]:
        """What the count proves of the share."""
        return rate_bounds(self.inside, len(self.nees), confidence)

    @property
    def mean_over_dimension(self) -> float:
        """ANEES / m: 1 when honest, more when too much is claimed."""
        return float(np.mean(self.nees) / self.dimension)

    def band(self, probability: float = 0.999) -> tuple[float, float]:
        """Where `mean_over_dimension` of an honest estimator lies with this probability."""
        half_dof = 0.5 * self.dimension * len(self.nees)
        tail = (1.0 - probability) / 2.0
        low, high = special.gammaincinv(half_dof, [tail, 1.0 - tail])
        return float(low / half_dof), float(high / half_dof)

    def merged(self, other: "Coverage") -> "Coverage":
        """Of both sets of cells."""
        if self.dimension != other.dimension:
            raise EstimationError(
                f"Coverage in {self.dimension} and in {other.dimension} dimensions", "Keep them apart"
            )
        return Coverage(self.dimension, np.concatenate([self.nees, other.nees]), self.refused + other.refused)

    @property
    def verdict(self) -> Verdict:
        """What the cells prove, with 99.9 %: the stated covariance is too small, too large, or neither."""
        low_share, high_share = self.bounds(0.999)
        low, high = self.band()
        if high_share < 0.95 or self.mean_over_dimension > high:
            return "claims too much"
        if low_share > 0.95 or self.mean_over_dimension < low:
            return "claims too little"
        return "honest"

    @property
    def accepted(self) -> bool:
        """For campaigns of thousands: 93.5 % to 96.5 % inside, mean NEES in its band, at most 5 % refused."""
        low, high = self.band()
        return (
            0.935 <= self.share <= 0.965
            and low <= self.mean_over_dimension <= high
            and self.refused <= math.floor(0.05 * self.cells)
        )
