"""The ranges of the joints: no target outside them is sent to an arm."""

import numpy as np
from numpy.typing import ArrayLike

from estimation.errors import DeviceError
from estimation.transform import FloatArray


def within_limits(target_rad: ArrayLike, lower_rad: FloatArray, upper_rad: FloatArray) -> FloatArray:
    """The target (joints,). Raises DeviceError for another shape, values that are no numbers, or outside."""
    target = np.asarray(target_rad, dtype=np.float64)
    if target.shape != lower_rad.shape or not np.isfinite(target).all():
        raise DeviceError(
            f"Joint target of shape {target.shape} with values {target}",
            f"Give {len(lower_rad)} finite angles",
        )
    outside = np.flatnonzero((target < lower_rad) | (target > upper_rad))
    if outside.size:
        i = int(outside[0])
        low, value, high = np.degrees((lower_rad[i], target[i], upper_rad[i]))
        raise DeviceError(
            f"Target of joint {i + 1} is {value:.3f} deg, limits {low:.3f} to {high:.3f} deg",
            "Choose a pose inside the joint limits",
        )
    return target
