"""Rotations to begin a search with."""

import numpy as np
from scipy.spatial.transform import Rotation

from estimation.transform import FloatArray


def rotations(count: int) -> FloatArray:
    """(count, 3, 3), evenly over all rotations. Source: M. Alexa (2022), Super-Fibonacci spirals."""
    golden, psi = np.sqrt(2.0), 1.533751168755204288118041
    s = np.arange(count) + 0.5
    radius, rest = np.sqrt(s / count), np.sqrt(1.0 - s / count)
    alpha, beta = 2.0 * np.pi * s / golden, 2.0 * np.pi * s / psi
    quaternion = [radius * np.sin(alpha), radius * np.cos(alpha), rest * np.sin(beta), rest * np.cos(beta)]
    return np.asarray(Rotation.from_quat(np.column_stack(quaternion)).as_matrix())
