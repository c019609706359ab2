"""Some of many points, such that they stand for all."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.transform import FloatArray

_GOLDEN: Final = (np.sqrt(5.0) - 1.0) / 2.0
_SPARSE: Final = 4  # times as many points: no place of a sample comes twice
_MOST_COPIES: Final = 5
_ALONG: Final = (0.7390851, 0.5671433, 0.3644247)  # a direction in which no grid repeats itself


def spread(count: int, most: int) -> NDArray[np.intp]:
    """Places of at most `most` of `count` points, even but in step with no regular scan."""
    if count <= most:
        return np.arange(count)
    places = (np.arange(most) * _GOLDEN % 1.0 * count).astype(np.intp)
    return np.sort(places) if count > _SPARSE * most else np.unique(places)


def distinct(points_m: FloatArray) -> int:
    """How many different points there are."""
    x, y, z = points_m.T
    key = _ALONG[0] * x + _ALONG[1] * y + _ALONG[2] * z  # no matrix product: equal points round equally
    return len(np.unique(key))


def repeated_share(points_m: FloatArray, places: NDArray[np.intp]) -> float:
    """Share of the points at `places` that come again at once, or where a file stacked on itself has them.

    For points so many that looking at all of them takes longer than fitting a surface.
    """
    count, here = len(points_m), points_m[places]
    steps = (1, *(count // copies for copies in range(2, _MOST_COPIES + 1)))
    return max(float(np.mean((here == points_m[(places + step) % count]).all(axis=1))) for step in steps)


def step_of(values_m: FloatArray) -> float:
    """Decimal step in metres or inches to which all of the values are rounded, 0 if there is none."""
    for exponent in range(3, 10):
        for unit_m in (1.0, 0.0254):
            step = unit_m * 10.0**-exponent
            units = values_m / step
            if np.abs(units - np.round(units)).max() < 1e-6 + 1e-15 * np.abs(units).max():
                return step
    return 0.0
