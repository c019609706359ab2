"""Torque of gravity on the joints of an arm, from declared masses: what makes joints yield."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from estimation.errors import EstimationError
from estimation.kinematics import ArmModel
from estimation.transform import FloatArray

GRAVITY_M_S2: Final = 9.80665


@dataclass(frozen=True, slots=True, eq=False)
class GravityLoad:
    """Masses that an arm carries.

    Attributes
    ----------
    payload_kg, payload_m : what is on the flange, and (3,) its centre of mass in the flange frame.
    link_kg, link_m : (n,) masses of the links and (n, 3) their centres, each in the frame at the end of
        its link; None for a payload alone, the simple proxy.
    up : (3,) unit vector against gravity in the base frame.
    """

    payload_kg: float
    payload_m: ArrayLike = (0.0, 0.0, 0.0)
    link_kg: ArrayLike | None = None
    link_m: ArrayLike | None = None
    up: ArrayLike = (0.0, 0.0, 1.0)

    def torque_nm(self, arm: ArmModel, joints_rad: FloatArray) -> FloatArray:
        """(m, n) torque of gravity about each joint axis, Nm, positive towards larger angles.

        Raises EstimationError when the masses do not suit the arm.
        """
        count = arm.joint_count
        for name, given in (("payload_m", self.payload_m), ("up", self.up)):
            if np.shape(given) != (3,) or not np.isfinite(given).all():
                raise EstimationError(f"{name} of a load is {given}", "Give three finite numbers")
        mass = np.zeros(count) if self.link_kg is None else np.asarray(self.link_kg, dtype=np.float64)
        centre = np.zeros((count, 3)) if self.link_m is None else np.asarray(self.link_m, dtype=np.float64)
        if mass.shape != (count,) or centre.shape != (count, 3):
            raise EstimationError(
                f"Masses of shape {mass.shape} at centres {centre.shape} for {count} links",
                "Give one mass and one centre of mass for each link",
            )
        every = np.append(mass, self.payload_kg)
        if not (np.isfinite(every).all() and every.min() >= 0.0):
            raise EstimationError(f"A mass is {every.min():g} kg", "Give finite masses, kg, not below zero")
        frames = arm.link_frames(joints_rad)
        ends = np.concatenate([frames[:, 1:], frames[:, -1:]], axis=1)
        local = np.concatenate([centre, np.reshape(self.payload_m, (1, 3))])
        places = np.einsum("mjik,jk->mji", ends[..., :3, :3], local) + ends[..., :3, 3]
        weights = every[:, None] * -GRAVITY_M_S2 * np.asarray(self.up)
        # Of all that hangs beyond a joint: sums from the flange back to it.
        moment = np.cumsum(np.cross(places, weights)[:, ::-1], axis=1)[:, ::-1][:, :count]
        weight = np.cumsum(weights[::-1], axis=0)[::-1][:count]
        moment_at_axis = moment - np.cross(frames[:, :count, :3, 3], weight)
        return np.asarray(np.einsum("mji,mji->mj", frames[:, :count, :3, 2], moment_at_axis))
