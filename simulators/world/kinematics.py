"""Forward kinematics of the true arm: one pose at a time, for single rays and touches."""

import math

import numpy as np

from estimation.transform import FloatArray

Triple = tuple[float, float, float]  # single points: plain floats are faster than arrays here


class TrueArm:
    """Links Rz(theta + q) Tz(d) Tx(a) Rx(alpha) Ry(beta) with the parameters that the arm really has.

    `parameters` is (n, 5): theta, d, a, alpha, beta of each link; m, rad.
    """

    def __init__(self, parameters: FloatArray) -> None:
        theta, d, a, alpha, beta = np.asarray(parameters, dtype=np.float64).T
        self._theta = theta
        ca, sa, cb, sb = np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta)
        zero = np.zeros_like(a)
        # What follows the joint's own rotation is constant: Tz Tx Rx Ry, rows of a 4 x 4.
        self._row_x = np.stack([cb, zero, sb, a], axis=1)
        self._row_y = np.stack([sa * sb, ca, -sa * cb, zero], axis=1)
        self._links = np.zeros((len(a), 4, 4))
        self._links[:, 2] = np.stack([-ca * sb, sa, ca * cb, d], axis=1)
        self._links[:, 3, 3] = 1.0
        self._outwards: list[tuple[float, ...]] = [
            (float(theta[i]), *self._row_x[i].tolist(), *self._row_y[i].tolist(), *self._links[i, 2].tolist())
            for i in reversed(range(len(a)))
        ]

    def flange_pose(self, joints_rad: FloatArray) -> FloatArray:
        """base_T_flange (4, 4) at joint angles (n,)."""
        angle = self._theta + joints_rad
        c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
        links = self._links
        links[:, 0] = c * self._row_x - s * self._row_y
        links[:, 1] = s * self._row_x + c * self._row_y
        pose: FloatArray = links[0]
        for link in links[1:]:
            pose = pose @ link
        return pose

    def point(self, joints_rad: FloatArray, flange_p: Triple) -> Triple:
        """One point of the flange in base; the same as by `flange_pose`, ten times as fast."""
        x, y, z = flange_p
        for angle, link in zip(reversed(joints_rad.tolist()), self._outwards, strict=True):
            theta, xx, xy, xz, xt, yx, yy, yz, yt, zx, zy, zz, zt = link
            u = xx * x + xy * y + xz * z + xt
            v = yx * x + yy * y + yz * z + yt
            z = zx * x + zy * y + zz * z + zt
            c, s = math.cos(theta + angle), math.sin(theta + angle)
            x, y = c * u - s * v, s * u + c * v
        return x, y, z
