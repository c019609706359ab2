"""Compiled principal axes of the covariances of many points of one uncertain pose."""

import math

import numba
import numpy as np

from estimation.transform import FloatArray


@numba.njit(cache=True, error_model="numpy")
def point_axes(points: FloatArray, matrix: FloatArray) -> FloatArray:
    """Standard deviations (m, 3), the longest first, of points (m, 3) with the pose's covariance (6, 6).

    J P J^T with J = [I | -[p]x], and the trigonometric solution of its characteristic polynomial. Source:
    O. K. Smith (1961), Eigenvalues of a symmetric 3 x 3 matrix.
    """
    axes = np.empty((len(points), 3))
    half = np.empty((3, 3))
    p = matrix
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for j in range(3):  # J times the columns of turns
            half[0, j] = p[0, 3 + j] + z * p[4, 3 + j] - y * p[5, 3 + j]
            half[1, j] = p[1, 3 + j] - z * p[3, 3 + j] + x * p[5, 3 + j]
            half[2, j] = p[2, 3 + j] + y * p[3, 3 + j] - x * p[4, 3 + j]
        a = p[0, 0] + z * p[4, 0] - y * p[5, 0] + z * half[0, 1] - y * half[0, 2]
        b = p[1, 1] - z * p[3, 1] + x * p[5, 1] - z * half[1, 0] + x * half[1, 2]
        c = p[2, 2] + y * p[3, 2] - x * p[4, 2] + y * half[2, 0] - x * half[2, 1]
        d = p[0, 1] + z * p[4, 1] - y * p[5, 1] - z * half[0, 0] + x * half[0, 2]
        e = p[0, 2] + z * p[4, 2] - y * p[5, 2] + y * half[0, 0] - x * half[0, 1]
        f = p[1, 2] - z * p[3, 2] + x * p[5, 2] + y * half[1, 0] - x * half[1, 1]
        mean = (a + b + c) / 3.0
        a, b, c = a - mean, b - mean, c - mean
        spread = math.sqrt((a * a + b * b + c * c + 2.0 * (d * d + e * e + f * f)) / 6.0)
        if spread <= 1e-16 * mean:
            axes[i, 0] = axes[i, 1] = axes[i, 2] = math.sqrt(max(mean, 0.0))
            continue
        a, b, c, d, e, f = a / spread, b / spread, c / spread, d / spread, e / spread, f / spread
        half_det = 0.5 * (a * (b * c - f * f) - d * (d * c - e * f) + e * (d * f - b * e))
        angle = math.acos(min(max(half_det, -1.0), 1.0)) / 3.0
        first = 2.0 * math.cos(angle)
        last = 2.0 * math.cos(angle + 2.0 * math.pi / 3.0)
        axes[i, 0] = math.sqrt(max(mean + spread * first, 0.0))
        axes[i, 1] = math.sqrt(max(mean - spread * (first + last), 0.0))
        axes[i, 2] = math.sqrt(max(mean + spread * last, 0.0))
    return axes
