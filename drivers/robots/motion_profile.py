"""Trapezoidal joint moves in which all joints start and arrive together."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from estimation.transform import FloatArray

NEGLIGIBLE_RAD: Final = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class SynchronizedMove:
    """Velocity and acceleration of each joint such that the path is straight in joint space."""

    velocity: FloatArray  # (joints,), rad/s
    acceleration: FloatArray  # (joints,), rad/s^2
    duration_s: float


def synchronize(
    distance_rad: FloatArray, speed_limit_rad_s: FloatArray, acceleration_limit_rad_s2: FloatArray
) -> SynchronizedMove:
    """Scale one profile s(t) in [0, 1] to every joint: each moves distance * s(t).

    Parameters
    ----------
    distance_rad : (joints,), signed or not; zero for a joint that stays.
    speed_limit_rad_s, acceleration_limit_rad_s2 : (joints,), positive.

    Velocities and accelerations are in proportion to the distance, so the executed path is the straight
    joint-space line that was checked for collisions, also on the ramps.
    """
    distance = np.abs(np.asarray(distance_rad, dtype=np.float64))
    moving = distance > NEGLIGIBLE_RAD
    if not moving.any():
        return SynchronizedMove(np.zeros_like(distance), np.zeros_like(distance), 0.0)
    rate = float(np.min(speed_limit_rad_s[moving] / distance[moving]))  # 1/s, of s(t)
    ramp = float(np.min(acceleration_limit_rad_s2[moving] / distance[moving]))  # 1/s^2
    reaches_full_speed = rate * rate <= ramp  # the two ramps take rate^2/ramp of the way
    duration_s = 1.0 / rate + rate / ramp if reaches_full_speed else 2.0 / math.sqrt(ramp)
    return SynchronizedMove(distance * rate, distance * ramp, duration_s)
