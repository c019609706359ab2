"""Circular cylinders."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from estimation.shapes.directions import Revolutions
from estimation.shapes.shape import Shape, frame_of, plain, pointing_up, positive
from estimation.transform import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Cylinder(Shape):
    """The cylinder u^2 + v^2 = radius^2. Source: Sallinen (2003), eq. (64-65)."""

    KIND: ClassVar[str] = "cylinder"
    FREEDOMS: ClassVar[tuple[str, ...]] = ("shift_u", "shift_v", "tilt_u", "tilt_v", "radius")
    WORDS: ClassVar[Mapping[str, str]] = {
        "shift_u": "the axis along u",
        "shift_v": "the axis along v",
        "tilt_u": "the tilt of the axis about u",
        "tilt_v": "the tilt of the axis about v",
        "radius": "the radius",
    }
    GROUPS: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "axis_point_m": ("shift_u", "shift_v"),
        "axis": ("tilt_u", "tilt_v"),
        "radius_m": ("radius",),
    }

    @staticmethod
    def local_rows(u: FloatArray, v: FloatArray, w: FloatArray, sizes: FloatArray) -> list[FloatArray]:
        rho = np.sqrt(u * u + v * v)
        inverse = 1.0 / positive(rho)
        nu, nv = u * inverse, v * inverse
        return [-nu, -nv, w * nv, -w * nu, np.full_like(u, -1.0), rho - sizes[0]]

    @classmethod
    def starts(cls, points_m: FloatArray) -> list[Self]:
        """Linear for each of many directions: u^2 + v^2 = 2 a u + 2 b v + (r^2 - a^2 - b^2)."""
        return [
            cls(found.point, frame_of(found.axis), plain([np.sqrt(found.square)]))
            for found in Revolutions(points_m).cylinders()
        ]

    def settled(self, centroid_m: FloatArray) -> Self:
        w = self.axes[:, 2]
        origin = self.origin_m + w * (w @ (centroid_m - self.origin_m))
        return replace(self, origin_m=origin, axes=pointing_up(self.axes), sizes=np.abs(self.sizes))

    def parameters(self) -> dict[str, FloatArray | float]:
        return {
            "axis_point_m": self.origin_m,
            "axis": self.axes[:, 2],
            "radius_m": float(self.sizes[0]),
        }
