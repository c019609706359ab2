"""Circular cones."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from estimation.shapes.directions import Revolutions
from estimation.shapes.shape import Shape, frame_of, plain, positive
from estimation.transform import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Cone(Shape):
    """The cone rho cos(angle) - w sin(angle) = gap, with the half angle between axis and surface.

    The gap is the distance of the origin, a point on the axis among the points, from the surface. Unlike the
    apex it stays well determined when the cone is nearly a cylinder.
    """

    KIND: ClassVar[str] = "cone"
    FREEDOMS: ClassVar[tuple[str, ...]] = ("shift_u", "shift_v", "tilt_u", "tilt_v", "gap", "half_angle")
    WORDS: ClassVar[Mapping[str, str]] = {
        "shift_u": "the axis along u",
        "shift_v": "the axis along v",
        "tilt_u": "the tilt of the axis about u",
        "tilt_v": "the tilt of the axis about v",
        "gap": "the apex along the axis",
        "half_angle": "the half angle",
    }
    GROUPS: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "apex_m": ("shift_u", "shift_v", "shift_w"),
        "axis": ("tilt_u", "tilt_v"),
        "half_angle_rad": ("half_angle",),
    }

    @staticmethod
    def local_rows(u: FloatArray, v: FloatArray, w: FloatArray, sizes: FloatArray) -> list[FloatArray]:
        cos, sin = np.cos(sizes[1]), np.sin(sizes[1])
        rho = np.sqrt(u * u + v * v)
        inverse = 1.0 / positive(rho)
        cu, cv = u * inverse, v * inverse
        nu, nv = cos * cu, cos * cv
        arm = cos * w + sin * rho  # of the normal about the origin, across the axis
        return [
            -nu,
            -nv,
            cv * arm,
            -cu * arm,
            np.full_like(u, -1.0),
            -sin * rho - cos * w,
            cos * rho - sin * w - sizes[0],
        ]

    @classmethod
    def starts(cls, points_m: FloatArray) -> list[Self]:
        """Linear for each of many directions: u^2 + v^2 = 2 a u + 2 b v + (m + k w)^2 - a^2 - b^2."""
        found = []
        for each in Revolutions(points_m).cones():
            angle = np.arctan(each.slope)
            gap = each.radius * np.cos(angle)
            found.append(cls(each.point, frame_of(each.axis), plain([gap, angle])))
        return found

    def settled(self, centroid_m: FloatArray) -> Self:
        axes, (gap, angle) = self.axes, self.sizes
        angle = (angle + np.pi) % (2.0 * np.pi) - np.pi
        if abs(angle) > np.pi / 2:  # rho cos - w sin = gap is the same surface after angle + pi, gap -> -gap
            angle, gap = angle - np.sign(angle) * np.pi, -gap
        if angle < 0.0:
            axes, angle = axes * np.array([1.0, -1.0, -1.0]), -angle
        w = axes[:, 2]
        along = w @ (centroid_m - self.origin_m)
        sizes = plain([gap + along * np.sin(angle), angle])
        return replace(self, origin_m=self.origin_m + along * w, axes=axes, sizes=sizes)

    def normals(self, points_m: FloatArray) -> FloatArray:
        nu, nv = -self.rows(points_m)[:2]
        local = np.stack([nu, nv, np.full_like(nu, -np.sin(self.sizes[1]))])
        return np.asarray((self.axes @ local).T)

    @property
    def apex_m(self) -> FloatArray:
        """(3,) where the axis meets the surface."""
        return np.asarray(self.origin_m - self.axes[:, 2] * (self.sizes[0] / np.sin(self.sizes[1])))

    def parameters(self) -> dict[str, FloatArray | float]:
        return {"apex_m": self.apex_m, "axis": self.axes[:, 2], "half_angle_rad": float(self.sizes[1])}

    @property
    def freedoms(self) -> tuple[str, ...]:
        """Of the apex, which is where the covariance is reported."""
        return ("shift_u", "shift_v", "shift_w", "tilt_u", "tilt_v", "half_angle")

    def reported(self) -> tuple[Self, FloatArray]:
        gap, angle = self.sizes
        sin, cos = np.sin(angle), np.cos(angle)
        along = -gap / sin
        jacobian = np.zeros((6, 6))  # of the freedoms at the apex by those at the origin
        jacobian[0, [0, 3]] = 1.0, along
        jacobian[1, [1, 2]] = 1.0, -along
        jacobian[2, [4, 5]] = -1.0 / sin, gap * cos / sin**2
        jacobian[[3, 4, 5], [2, 3, 5]] = 1.0
        at_apex = replace(self, origin_m=self.apex_m, sizes=plain([0.0, angle]))
        return at_apex, jacobian
