"""What makes a set of measurements good: one number of the covariance that it leaves, and its derivative.

With Z the covariance of the judged quantities, a measurement takes a a^T / (1 + s) off it. To first order a
criterion falls by a^T W a / (1 + s), where W is its derivative by Z. So W alone drives the greedy choice, the
exchange and the lower bound; a new criterion is one more (value, weight) pair. W is given by its axes, which
is how it is used.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from estimation.transform import FloatArray

Axes = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, slots=True)
class Criterion:
    """A variance to be made small.

    Attributes
    ----------
    value : of Z (g, k, k), the covariances of g judged quantities; in their unit squared.
    weight : (Z, sharpness) to W (g, k, k), positive semi-definite, as eigenvalues (g, k) and axes, columns
        of (g, k, k). For a logarithmic criterion W is the derivative of the logarithm of the value; otherwise
        trace(W Z) never exceeds the value.
    logarithmic : the logarithm of the value is convex in the number of repetitions of each measurement;
        otherwise trace(W Z) is, for W held.
    """

    name: str
    value: Callable[[FloatArray], float]
    weight: Callable[[FloatArray, float], Axes]
    logarithmic: bool

    def efficiency(self, bound: float, value: float) -> float:
        """Share of the best possible, at most 1: the lower bound over what was reached."""
        return bound / value if value > 0.0 else 1.0


def _determinant(judged: FloatArray) -> float:
    """Geometric mean of all principal variances."""
    logs = np.linalg.slogdet(judged)[1]
    return float(np.exp(logs.sum() / (judged.shape[0] * judged.shape[1])))


def _determinant_weight(judged: FloatArray, sharpness: float) -> Axes:
    values, axes = np.linalg.eigh(judged)
    smallest = max(float(values.max()), 1e-300) * np.finfo(np.float64).eps
    return 1.0 / (np.maximum(values, smallest) * values.size), axes


def _trace(judged: FloatArray) -> float:
    """Arithmetic mean of all principal variances."""
    return float(np.trace(judged, axis1=1, axis2=2).mean() / judged.shape[1])


def _trace_weight(judged: FloatArray, sharpness: float) -> Axes:
    count, size = judged.shape[:2]
    return np.full((count, size), 1.0 / (count * size)), np.broadcast_to(np.eye(size), judged.shape)


def _largest(judged: FloatArray) -> float:
    """The largest principal variance of all quantities."""
    return float(np.linalg.eigvalsh(judged)[:, -1].max())


def _largest_weight(judged: FloatArray, sharpness: float) -> Axes:
    """Nearly the worst axis, but smooth: each axis by its eigenvalue to a power, trace 1."""
    values, axes = np.linalg.eigh(judged)
    shares = (np.maximum(values, 0.0) / max(float(values.max()), 1e-300)) ** sharpness
    return np.asarray(shares / shares.sum()), axes


D: Final = Criterion("D", _determinant, _determinant_weight, logarithmic=True)
A: Final = Criterion("A", _trace, _trace_weight, logarithmic=False)
E: Final = Criterion("E", _largest, _largest_weight, logarithmic=False)
WORST: Final = Criterion("worst", _largest, _largest_weight, logarithmic=False)

# With gated points as the judged quantities A is the I criterion and "worst" the G criterion; E is "worst"
# of one quantity, the whole state.
CRITERIA: Final[Mapping[str, Criterion]] = {criterion.name: criterion for criterion in (D, A, E, WORST)}
SHARPNESS: Final = 16.0  # for choosing: higher sees the worst axis alone and swings from one to the next
