"""Is the truth inside the stated region? Compares a belief with a simulated truth; for tests only."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from estimation.belief import Belief
from estimation.transform import FloatArray, log_pose
from simulators.world.truth import Truth


def laser_error(belief: Belief, truth: Truth) -> FloatArray:
    """Right perturbation (5,) from the estimated to the true mount; turning about the beam does not count."""
    between = belief.transform("laser").inverse().matrix @ truth.flange_T_laser
    beam = between[:3, 2]
    return np.concatenate([between[:3, 3], [np.arctan2(-beam[1], beam[2]), np.arctan2(beam[0], beam[2])]])


def part_error(belief: Belief, truth: Truth) -> FloatArray:
    """Right perturbation (6,) from the estimated to the true pose of the part."""
    return log_pose(belief.transform("part").inverse().matrix @ truth.base_T_part)


def nees(error: FloatArray, covariance: FloatArray) -> float:
    """Normalised estimation error squared: chi-square with m degrees of freedom when honest."""
    return float(error @ np.linalg.solve(covariance, error))


@dataclass(frozen=True, slots=True)
class Honesty:
    """NEES of one quantity over many cells."""

    dimension: int
    values: FloatArray

    @property
    def inside(self) -> int:
        """Cells whose truth lies inside the 95 % region."""
        return int(np.sum(self.values <= chi2.ppf(0.95, self.dimension)))

    @property
    def mean_over_dimension(self) -> float:
        """ANEES: 1 when honest."""
        return float(np.mean(self.values) / self.dimension)

    def __str__(self) -> str:
        low, high = self.band(0.99)
        return (
            f"inside the 95 % region {self.inside} of {len(self.values)}, "
            f"mean NEES/m {self.mean_over_dimension:.3f}, 99 % band {low:.3f} to {high:.3f}"
        )

    def band(self, probability: float) -> tuple[float, float]:
        """Where the mean over the dimension lies with this probability, when honest."""
        dof = self.dimension * len(self.values)
        low, high = chi2.ppf([(1 - probability) / 2, (1 + probability) / 2], dof) / dof
        return float(low), float(high)
