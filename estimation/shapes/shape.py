"""A surface in a frame of its own, and the small changes that an estimator may make to it."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar, Final, Self

import numpy as np

from estimation.surfaces import cross
from estimation.transform import FloatArray

MOTIONS: Final = ("shift_u", "shift_v", "shift_w", "tilt_u", "tilt_v")  # the first freedoms of every shape
_TINY: Final = np.finfo(np.float64).tiny


@dataclass(frozen=True, slots=True, eq=False)  # == on arrays is ambiguous
class Shape(ABC):
    """A surface of one kind.

    Attributes
    ----------
    origin_m : (3,) origin of the shape's frame.
    axes : (3, 3) rotation; its columns are the axes u, v and w. w is the normal or the axis of revolution.
    sizes : (k,) radii (m) and angles (rad), in the order of the last freedoms.
    """

    origin_m: FloatArray
    axes: FloatArray
    sizes: FloatArray

    KIND: ClassVar[str]
    FREEDOMS: ClassVar[tuple[str, ...]]  # some of MOTIONS in their order, then one name for each size
    WORDS: ClassVar[Mapping[str, str]]  # each freedom, as a person calls it
    GROUPS: ClassVar[
        Mapping[str, tuple[str, ...]]
    ]  # the reported freedoms that make each parameter uncertain

    @staticmethod
    @abstractmethod
    def local_rows(u: FloatArray, v: FloatArray, w: FloatArray, sizes: FloatArray) -> list[FloatArray]:
        """Derivatives of the distance by each freedom, then the distance (m), at points of the own frame."""

    @classmethod
    @abstractmethod
    def starts(cls, points_m: FloatArray) -> list[Self]:
        """Shapes near the optimum, or at least one of them, for points (n, 3) about the origin, size 1."""

    @abstractmethod
    def settled(self, centroid_m: FloatArray) -> Self:
        """The same surface with positive sizes, and the origin where the points are."""

    @abstractmethod
    def parameters(self) -> dict[str, FloatArray | float]:
        """What describes the surface to others, m and rad, names with their unit."""

    def reported(self) -> tuple[Self, FloatArray]:
        """The shape with the frame in which its covariance is reported, and the Jacobian to its freedoms."""
        return self, np.eye(len(self.FREEDOMS))

    @property
    def freedoms(self) -> tuple[str, ...]:
        """The freedoms in which the covariance is reported."""
        return self.FREEDOMS

    @classmethod
    def is_angle(cls, freedom: str) -> bool:
        """The freedom is in radians, not in metres."""
        return freedom.startswith("tilt") or freedom.endswith("angle")

    def rows(self, points_m: FloatArray) -> FloatArray:
        """(p + 1, n): derivatives of the distance by each freedom, then the distance in metres."""
        u, v, w = self.axes.T @ (points_m - self.origin_m).T
        return np.array(self.local_rows(u, v, w, self.sizes))

    def distance(self, points_m: FloatArray) -> FloatArray:
        """(n,) orthogonal distances of points (n, 3); positive on the side of w, or off the axis."""
        return np.asarray(self.rows(points_m)[-1])

    def normals(self, points_m: FloatArray) -> FloatArray:
        """(n, 3) unit normals, the gradient of the distance, at points (n, 3)."""
        local, rows = np.zeros((3, len(points_m))), self.rows(points_m)
        for place, name in enumerate(MOTIONS[:3]):
            if name in self.FREEDOMS:
                local[place] = -rows[self.FREEDOMS.index(name)]
        return np.asarray((self.axes @ local).T)

    def moved(self, step: FloatArray) -> Self:
        """The shape after a small change (p,) of its freedoms, taken in its own frame."""
        motion = np.zeros(6)
        count = len(self.FREEDOMS) - len(self.sizes)
        motion[_places(self.FREEDOMS[:count])] = step[:count]
        return type(self)(
            self.origin_m + self.axes @ motion[:3],
            _turned(self.axes, motion[3:]),
            self.sizes + step[count:],
        )

    def scaled(self, factor: float, centre_m: FloatArray) -> Self:
        """The shape after p -> factor p + centre."""
        lengths = [1.0 if self.is_angle(name) else factor for name in self.FREEDOMS]
        sizes = self.sizes * lengths[len(lengths) - len(self.sizes) :]
        return replace(self, origin_m=factor * self.origin_m + centre_m, sizes=sizes)


def frame_of(axis: FloatArray) -> FloatArray:
    """Rotations (..., 3, 3) with w along `axis` (..., 3), u and v chosen by rule."""
    w = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
    helper = np.eye(3)[np.argmin(np.abs(w), axis=-1)]
    u = cross(helper, w)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    return np.stack([u, cross(w, u), w], axis=-1)


def pointing_up(axes: FloatArray) -> FloatArray:
    """The frame turned about u, where needed, so that the largest component of w is positive."""
    w = axes[:, 2]
    return axes if w[np.argmax(np.abs(w))] > 0 else axes * np.array([1.0, -1.0, -1.0])


def positive(values: FloatArray) -> FloatArray:
    """Values that can be divided by."""
    return np.maximum(values, _TINY)


def plain(values: Sequence[float]) -> FloatArray:
    """Floats as an array."""
    return np.array(values, dtype=np.float64)


@lru_cache
def _places(freedoms: tuple[str, ...]) -> list[int]:
    return [MOTIONS.index(name) for name in freedoms]


def _turned(axes: FloatArray, turn: FloatArray) -> FloatArray:
    """axes Exp(turn), without the rounding that many such products would collect."""
    x, y, z = turn.tolist()
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle < 1e-3:  # the series is exact to rounding here
        first, second = 1.0 - square / 6.0 + square**2 / 120.0, 0.5 - square / 24.0
    else:
        first, second = math.sin(angle) / angle, 2.0 * (math.sin(angle / 2.0) / angle) ** 2
    generator = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    product = axes + axes @ (first * generator + second * (generator @ generator))
    return np.asarray(1.5 * product - product @ (0.5 * product.T @ product))
