"""Starts for tori. No linear problem serves all of them, so there are three kinds, for three kinds of data.

A cyclide (linear) is exact on points without noise; a circle serves thin tubes; tori that osculate a
quadratic patch in the middle of the points serve small pieces.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from estimation.shapes.directions import half_sphere, principal
from estimation.shapes.shape import frame_of
from estimation.transform import FloatArray

_LATITUDES: Final = np.radians(np.arange(0.0, 360.0, 30.0))  # where on the tube the points may lie
_MAJORS: Final = (0.7, 2.0)  # where nothing tells
_LARGEST_MAJOR: Final = 100.0
_CYCLIDE_POINTS: Final = 15
_FEW_AXES: Final = 50


@dataclass(frozen=True, slots=True, eq=False)
class Ring:
    """Centre, unit axis and the two radii of a torus."""

    centre: FloatArray
    axis: FloatArray
    major: float
    minor: float


def candidates(points: FloatArray) -> list[Ring]:
    """Tori that may be near points (n, 3), centred and of size 1."""
    found = [*_circles(points, principal(points)), *_osculating(points)]
    # Too few for a cyclide leave many minima, and their fits take little time.
    found += _cyclide(points) if len(points) >= _CYCLIDE_POINTS else _circles(points, half_sphere(_FEW_AXES))
    return [ring for ring in found if np.isfinite(ring.major + ring.minor) and ring.major > 0 < ring.minor]


def _cyclide(points: FloatArray) -> list[Ring]:
    """Linear: |p|^4 + |p|^2 (a . p) + p^T B p + b . p + d = 0 holds all tori.

    For a torus, a = -4 c and B - 4 c c^T = 2 (|c|^2 + k) I - 4 R^2 (I - w w^T), with k = R^2 - r^2.
    """
    x, y, z = points.T
    square = x * x + y * y + z * z
    design = np.column_stack(
        [
            square * x,
            square * y,
            square * z,
            x * x,
            y * y,
            z * z,
            x * y,
            x * z,
            y * z,
            x,
            y,
            z,
            np.ones_like(x),
        ]
    )
    a = np.linalg.lstsq(design, -square * square)[0]
    centre = -a[:3] / 4.0
    matrix = np.array([[2 * a[3], a[6], a[7]], [a[6], 2 * a[4], a[8]], [a[7], a[8], 2 * a[5]]]) / 2.0
    values, vectors = np.linalg.eigh(matrix - 4.0 * np.outer(centre, centre))
    rings = []
    for place in (2, 0):  # the value along the axis is the largest; with much noise it may be another
        across = (values.sum() - values[place]) / 2.0
        major_square = (values[place] - across) / 4.0
        minor_square = major_square - (values[place] / 2.0 - centre @ centre)
        if major_square > 0.0 < minor_square:
            rings.append(Ring(centre, vectors[:, place], np.sqrt(major_square), np.sqrt(minor_square)))
    return rings


def _circles(points: FloatArray, axes: FloatArray) -> list[Ring]:
    """A circle in the plane across each axis (m, 3), with the mean distance from it as the tube."""
    centroid = points.mean(axis=0)
    rings = []
    for axis in axes:
        frame = frame_of(axis)
        u, v, w = frame.T @ (points - centroid).T
        design = np.column_stack([2.0 * u, 2.0 * v, np.ones_like(u)])
        a, b, c = np.linalg.lstsq(design, u * u + v * v)[0]
        major = np.sqrt(max(c + a * a + b * b, 0.0))
        out = np.hypot(u - a, v - b) - major
        minor = float(np.hypot(out, w).mean())
        rings.append(Ring(centroid + frame @ np.array([a, b, 0.0]), axis, float(major), minor))
    return rings


def _osculating(points: FloatArray) -> list[Ring]:
    """Tori with the curvatures of the points in their middle.

    One principal curvature is that of the tube, 1 / r; the other is cos(latitude) / (R + r cos(latitude)).
    """
    centroid = points.mean(axis=0)
    _, _, directions = np.linalg.svd(points - centroid, full_matrices=False)
    frame = frame_of(directions[2])
    u, v, w = frame.T @ (points - centroid).T
    design = np.column_stack([u * u / 2.0, u * v, v * v / 2.0, u, v, np.ones_like(u)])
    uu, uv, vv, du, dv, height = np.linalg.lstsq(design, w)[0]
    curvatures, turned = np.linalg.eigh(np.array([[uu, uv], [uv, vv]]))
    normal = frame @ np.array([-du, -dv, 1.0])
    normal /= np.linalg.norm(normal)
    foot = centroid + frame @ np.array([0.0, 0.0, height])
    rings = []
    for tube, other in ((0, 1), (1, 0)):
        if abs(curvatures[tube]) < 1e-3:
            continue
        inward = normal if curvatures[tube] > 0 else -normal  # to the middle of the tube
        minor = 1.0 / abs(curvatures[tube])
        bend = curvatures[other] * np.sign(curvatures[tube])  # positive when bent to the same side
        around = frame @ np.array([*turned[:, tube], 0.0])  # in the plane of the tube's circle
        core = foot + minor * inward
        for latitude in _LATITUDES:
            cos, sin = np.cos(latitude), np.sin(latitude)
            # On top of a torus, or where the tube runs straight, nothing gives the major radius.
            vague = abs(cos) < 0.1 or abs(bend) < 1e-3
            outward = -cos * inward + sin * around
            axis = sin * inward + cos * around
            for major in _MAJORS if vague else (cos / bend - minor * cos,):
                if 0.0 < major < _LARGEST_MAJOR:
                    rings.append(Ring(core - major * outward, axis, float(major), minor))
    return rings
