"""Signed distances to planes, spheres, cylinders, cones and tori, with their gradients.

Each function takes points (m, 3) relative to the point of their surface, unit axes (m, 3), radii (m,) and
sizes (m,), and gives the distance (m,) as if the material were inside, its unit gradient (m, 3), and its
derivative (m,) by the size: the half angle of a cone in rad, the major radius of a torus in m.
NaN marks a point without a direction to the surface: in a centre, on an axis, on the circle of a tube.

Source: Sallinen (2003), eq. (62-67) for plane, cylinder and sphere; cone and torus by the same reasoning.
"""

from collections.abc import Callable
from typing import Final

import numpy as np

from estimation.transform import FloatArray

Distance = tuple[FloatArray, FloatArray, FloatArray]
_SMALLEST_RADIUS_M: Final = 1e-9  # nearer to a centre or an axis there is no direction to the surface


def to_plane(arm: FloatArray, axis: FloatArray, radius_m: FloatArray, size: FloatArray) -> Distance:
    """Height over the plane."""
    return _dot(arm, axis), axis, np.zeros(len(arm))


def to_sphere(arm: FloatArray, axis: FloatArray, radius_m: FloatArray, size: FloatArray) -> Distance:
    length, direction = _unit(arm)
    return length - radius_m, direction, np.zeros(len(arm))


def to_cylinder(arm: FloatArray, axis: FloatArray, radius_m: FloatArray, size: FloatArray) -> Distance:
    length, direction = _unit(arm - _dot(arm, axis)[:, None] * axis)
    return length - radius_m, direction, np.zeros(len(arm))


def to_cone(arm: FloatArray, axis: FloatArray, radius_m: FloatArray, size: FloatArray) -> Distance:
    """The axis points from the apex into the cone; behind the apex, the apex itself is nearest."""
    height = _dot(arm, axis)
    across, direction = _unit(arm - height[:, None] * axis)
    cosine, sine = np.cos(size), np.sin(size)
    along = across * sine + height * cosine  # from the apex to the foot, on the generating line
    distance = across * cosine - height * sine
    gradient = cosine[:, None] * direction - sine[:, None] * axis
    behind = along < 0.0
    if behind.any():
        length, away = _unit(arm)
        distance = np.where(behind, length, distance)
        gradient = np.where(behind[:, None], away, gradient)
        along = np.where(behind, 0.0, along)
    return distance, gradient, -along


def to_torus(arm: FloatArray, axis: FloatArray, radius_m: FloatArray, size: FloatArray) -> Distance:
    height = _dot(arm, axis)
    across, direction = _unit(arm - height[:, None] * axis)
    length, gradient = _unit((across - size)[:, None] * direction + height[:, None] * axis)
    return length - radius_m, gradient, -_dot(gradient, direction)


DISTANCE: Final[dict[str, Callable[[FloatArray, FloatArray, FloatArray, FloatArray], Distance]]] = {
    "plane": to_plane,
    "sphere": to_sphere,
    "cylinder": to_cylinder,
    "cone": to_cone,
    "torus": to_torus,
}


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("ij,ij->i", a, b))


def _unit(vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lengths (m,) and directions (m, 3); NaN where there is none."""
    length = np.sqrt(_dot(vectors, vectors))
    length = np.where(length < _SMALLEST_RADIUS_M, np.nan, length)
    return length, vectors / length[:, None]
