"""Tori."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from estimation.shapes import torus_starts
from estimation.shapes.shape import Shape, frame_of, plain, pointing_up, positive
from estimation.transform import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Torus(Shape):
    """The torus (rho - major)^2 + w^2 = minor^2; the distance is positive outside the tube."""

    KIND: ClassVar[str] = "torus"
    FREEDOMS: ClassVar[tuple[str, ...]] = (
        "shift_u",
        "shift_v",
        "shift_w",
        "tilt_u",
        "tilt_v",
        "major_radius",
        "minor_radius",
    )
    WORDS: ClassVar[Mapping[str, str]] = {
        "shift_u": "the centre along u",
        "shift_v": "the centre along v",
        "shift_w": "the centre along the axis",
        "tilt_u": "the tilt of the axis about u",
        "tilt_v": "the tilt of the axis about v",
        "major_radius": "the major radius",
        "minor_radius": "the minor radius",
    }
    GROUPS: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "center_m": ("shift_u", "shift_v", "shift_w"),
        "axis": ("tilt_u", "tilt_v"),
        "major_radius_m": ("major_radius",),
        "minor_radius_m": ("minor_radius",),
    }

    @staticmethod
    def local_rows(u: FloatArray, v: FloatArray, w: FloatArray, sizes: FloatArray) -> list[FloatArray]:
        rho = np.sqrt(u * u + v * v)
        inverse = 1.0 / positive(rho)
        cu, cv = u * inverse, v * inverse
        out = rho - sizes[0]
        tube = np.sqrt(out * out + w * w)
        inverse = 1.0 / positive(tube)
        nr, nw = out * inverse, w * inverse
        arm = w * nr - rho * nw
        return [
            -nr * cu,
            -nr * cv,
            -nw,
            cv * arm,
            -cu * arm,
            -nr,
            np.full_like(u, -1.0),
            tube - sizes[1],
        ]

    @classmethod
    def starts(cls, points_m: FloatArray) -> list[Self]:
        """Linear cyclides, circles with a thin tube, and tori osculating in the middle of the points."""
        return [
            cls(found.centre, frame_of(found.axis), plain([found.major, found.minor]))
            for found in torus_starts.candidates(points_m)
        ]

    def settled(self, centroid_m: FloatArray) -> Self:
        return replace(self, axes=pointing_up(self.axes), sizes=np.abs(self.sizes))

    def parameters(self) -> dict[str, FloatArray | float]:
        return {
            "center_m": self.origin_m,
            "axis": self.axes[:, 2],
            "major_radius_m": float(self.sizes[0]),
            "minor_radius_m": float(self.sizes[1]),
        }
