"""Spheres."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from estimation.shapes.shape import Shape, plain, positive
from estimation.transform import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Sphere(Shape):
    """The sphere u^2 + v^2 + w^2 = radius^2. Source: Sallinen (2003), eq. (66-67)."""

    KIND: ClassVar[str] = "sphere"
    FREEDOMS: ClassVar[tuple[str, ...]] = ("shift_u", "shift_v", "shift_w", "radius")
    WORDS: ClassVar[Mapping[str, str]] = {
        "shift_u": "the centre along u",
        "shift_v": "the centre along v",
        "shift_w": "the centre along w",
        "radius": "the radius",
    }
    GROUPS: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "center_m": ("shift_u", "shift_v", "shift_w"),
        "radius_m": ("radius",),
    }

    @staticmethod
    def local_rows(u: FloatArray, v: FloatArray, w: FloatArray, sizes: FloatArray) -> list[FloatArray]:
        range_m = np.sqrt(u * u + v * v + w * w)
        inverse = 1.0 / positive(range_m)
        return [-u * inverse, -v * inverse, -w * inverse, np.full_like(u, -1.0), range_m - sizes[0]]

    @classmethod
    def starts(cls, points_m: FloatArray) -> list[Self]:
        """Linear: |p|^2 = 2 c . p + (r^2 - |c|^2)."""
        design = np.column_stack([2.0 * points_m, np.ones(len(points_m))])
        solution, *_ = np.linalg.lstsq(design, np.einsum("ij,ij->i", points_m, points_m))
        centre = solution[:3]
        radius = np.sqrt(max(solution[3] + centre @ centre, 0.0))
        return [cls(centre, np.eye(3), plain([radius]))]

    def settled(self, centroid_m: FloatArray) -> Self:
        return replace(self, sizes=np.abs(self.sizes))

    def parameters(self) -> dict[str, FloatArray | float]:
        return {"center_m": self.origin_m, "radius_m": float(self.sizes[0])}
