"""Some of many points, such that they stand for all."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.transform import FloatArray

_GOLDEN: Final = (np.sqrt(5.0) - 1.0) / 2.0
_MIXER: Final = np.uint64(0x9E3779B97F4A7C15)  # spreads the bits of a number (Fibonacci hashing)
_ALONG: Final = (0.7390851, 0.5671433, 0.3644247)  # a direction in which no grid repeats itself


def spread(count: int, most: int) -> NDArray[np.intp]:
    """Places of at most `most` of `count` points, even but in step with no regular scan."""
    if count <= most:
        return np.arange(count)
    return np.unique((np.arange(most) * _GOLDEN % 1.0 * count).astype(np.intp))


def distinct_share(points_m: FloatArray, most: int) -> tuple[int, int]:
    """How many different points there are, and among how many.

    Of many points only some are looked at, chosen by what they are: equal ones together or not at all.
    """
    count = len(points_m)
    if count > most:
        hashed = np.ascontiguousarray(points_m).view(np.uint64)[:, 0] * _MIXER
        points_m = points_m[hashed < np.uint64(2**64 * (most / count))]
    x, y, z = points_m.T
    key = _ALONG[0] * x + _ALONG[1] * y + _ALONG[2] * z  # no matrix product: equal points round equally
    return len(np.unique(key)), len(key)


def step_of(values_m: FloatArray) -> float:
    """Decimal step in metres or inches to which all of the values are rounded, 0 if there is none."""
    for exponent in range(3, 10):
        for unit_m in (1.0, 0.0254):
            step = unit_m * 10.0**-exponent
            units = values_m / step
            if np.abs(units - np.round(units)).max() < 1e-6 + 1e-15 * np.abs(units).max():
                return step
    return 0.0
