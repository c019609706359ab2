"""Planes."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from estimation.shapes.shape import Shape, frame_of, plain, pointing_up
from estimation.transform import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Plane(Shape):
    """The plane w = 0. Source: Sallinen (2003), eq. (62-63), with e = +p_z."""

    KIND: ClassVar[str] = "plane"
    FREEDOMS: ClassVar[tuple[str, ...]] = ("shift_w", "tilt_u", "tilt_v")
    WORDS: ClassVar[Mapping[str, str]] = {
        "shift_w": "the height",
        "tilt_u": "the tilt about u",
        "tilt_v": "the tilt about v",
    }
    GROUPS: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "point_m": ("shift_w",),
        "normal": ("tilt_u", "tilt_v"),
    }

    @staticmethod
    def local_rows(u: FloatArray, v: FloatArray, w: FloatArray, sizes: FloatArray) -> list[FloatArray]:
        return [np.full_like(w, -1.0), -v, u, w]

    @classmethod
    def starts(cls, points_m: FloatArray) -> list[Self]:
        """Closed form: the direction in which the points spread least."""
        centroid = points_m.mean(axis=0)
        _, _, directions = np.linalg.svd(points_m - centroid, full_matrices=False)
        return [cls(centroid, frame_of(directions[2]), plain([]))]

    def settled(self, centroid_m: FloatArray) -> Self:
        w = self.axes[:, 2]
        origin = centroid_m - w * (w @ (centroid_m - self.origin_m))
        return replace(self, origin_m=origin, axes=pointing_up(self.axes))

    def parameters(self) -> dict[str, FloatArray | float]:
        return {"point_m": self.origin_m, "normal": self.axes[:, 2]}
