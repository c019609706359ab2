"""Forward kinematics of the true arm: one pose at a time, for single rays and touches."""

import numpy as np

from estimation.transform import FloatArray


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
