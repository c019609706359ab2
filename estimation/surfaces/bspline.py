"""Bicubic B-spline patches as surfaces, with control points that may deviate."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.spatial import cKDTree

from estimation.errors import EstimationError
from estimation.surfaces.bspline_cells import DEGREE, Cells, closest
from estimation.surfaces.mesh import TriangleMesh
from estimation.surfaces.shape import Nearest, Sums
from estimation.transform import FloatArray

_FEW_STARTS: Final = 500  # that are looked at one by one
_STARTS: Final = 3  # in each direction of a cell: between them a foot is never further than Newton can go


@dataclass(frozen=True, eq=False)
class BSplinePatch:
    """A bicubic surface, of any number of polynomial cells, in the frame of its object.

    Attributes
    ----------
    knots_u, knots_v : (n + 4,) and (k + 4,), never falling, uniform or not. The surface is the image of
        [knots[3], knots[-4]].
    control_m : (n, k, 3) control points; n, k >= 4. The normal d/du x d/dv points out of the material.

    A patch whose opposite edges are one line, with equal derivatives up to the second, is closed: it has no
    edge there. The nearest point is sought from the nearest of a grid of points, three by three in each
    cell. It is the nearest of all where the point is closer to the surface than its radius of curvature.

    Raises EstimationError for knots or control points that make no surface.

    Source: Sallinen (2003), eq. (68-75), with (70) as corrected in (75).
    """

    knots_u: FloatArray
    knots_v: FloatArray
    control_m: FloatArray
    cells: Cells = field(init=False)

    def __post_init__(self) -> None:
        control = np.ascontiguousarray(self.control_m, dtype=np.float64)
        if control.ndim != 3 or control.shape[2] != 3 or not np.isfinite(control).all():
            raise EstimationError(
                f"Control points {control.shape}, or one that is not finite", "Give an array (n, k, 3)"
            )
        for name, count in (("u", control.shape[0]), ("v", control.shape[1])):
            knots = np.asarray(getattr(self, f"knots_{name}"), dtype=np.float64)
            if count < DEGREE + 1 or knots.shape != (count + DEGREE + 1,):
                raise EstimationError(
                    f"{count} control points along {name} with knots {knots.shape}",
                    f"Give at least {DEGREE + 1} control points, and {DEGREE + 1} knots more than these",
                )
            if not (np.diff(knots) >= 0.0).all() or not knots[DEGREE] < knots[-DEGREE - 1]:
                raise EstimationError(f"Knots along {name} fall, or span nothing", "Give them in order")
            object.__setattr__(self, f"knots_{name}", knots)
        object.__setattr__(self, "control_m", control)
        object.__setattr__(self, "cells", Cells.of(self.knots_u, self.knots_v, control))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The coordinates of all control points: "point<i>_<j><axis>"."""
        n, k, _ = self.control_m.shape
        return tuple(f"point{i}_{j}{axis}" for i in range(n) for j in range(k) for axis in "xyz")

    def deviated(self, values: FloatArray) -> "BSplinePatch":
        """The patch with its control points moved by values (3 n k,), metres."""
        return replace(self, control_m=self.control_m + values.reshape(self.control_m.shape))

    def points(self, place: FloatArray) -> FloatArray:
        """Points (m, 3) of the surface at (u, v) (m, 2)."""
        return np.asarray(self.cells.jets(place)[:, 0])

    def weights(self, place: FloatArray) -> FloatArray:
        """How much of each control point is in the points at (u, v): (m, n k), rows add up to one."""
        n, k, _ = self.control_m.shape
        along_u = BSpline.design_matrix(place[:, 0], self.knots_u, DEGREE).toarray()
        along_v = BSpline.design_matrix(place[:, 1], self.knots_v, DEGREE).toarray()
        return np.asarray(np.einsum("ma,mb->mab", along_u, along_v).reshape(len(place), n * k))

    def by_parameters(self, nearest: Nearest) -> FloatArray:
        """Derivatives (m, 3 n k) of the distances by the coordinates of the control points."""
        weights = self.weights(nearest.place)
        return np.asarray(-np.einsum("ma,mk->mak", weights, nearest.normal).reshape(len(weights), -1))

    def nearest(self, object_p: FloatArray) -> Nearest:
        """Nearest points of the patch to points (m, 3), metres; `place` (m, 2) holds their (u, v)."""
        points = np.ascontiguousarray(object_p, dtype=np.float64)
        place, beyond = self.new_hints(len(points)), np.zeros(len(points), dtype=np.bool_)
        self._begin(points, place)
        self.cells.feet(points, place, beyond)
        return self.cells.seen(points, place, beyond)

    def sums(
        self,
        base_p: FloatArray,
        weight: FloatArray,
        base_T_object: FloatArray,
        hints: FloatArray,
        huber: float = np.inf,
    ) -> Sums:
        """Sums over points as `Shape` describes them; `hints` (m, 2) hold (u, v), NaN at first."""
        rotation, origin = np.ascontiguousarray(base_T_object[:3, :3]), base_T_object[:3, 3].copy()
        fresh = np.isnan(hints[:, 0])
        if fresh.any():
            started = hints[fresh]
            self._begin((base_p[fresh] - origin) @ rotation, started)
            hints[fresh] = started
        return self.cells.sums(base_p, weight, rotation, origin, hints, huber)

    def new_hints(self, count: int) -> FloatArray:
        """Nothing known yet of where the feet are."""
        return np.full((count, 2), np.nan)

    def order(self, base_p: FloatArray, base_T_object: FloatArray) -> NDArray[np.intp]:
        """The order (m,) in which points are best visited: as they come."""
        return np.arange(len(base_p))

    @property
    def kinked(self) -> bool:
        """Smooth."""
        return False

    @cached_property
    def coarse(self) -> TriangleMesh:
        """Triangles between the points from which feet are sought."""
        place, (rows, columns) = self._grid
        i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
        a = (i * columns + j).reshape(-1)
        b, c, d = a + columns, a + columns + 1, a + 1
        triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
        return TriangleMesh(self.points(place), triangles)

    @cached_property
    def _grid(self) -> tuple[FloatArray, tuple[int, int]]:
        """Places (m, 2) from which feet are sought, rows of u; and how many of each."""
        each = [
            np.append((edges[:-1, None] + np.diff(edges)[:, None] * np.arange(_STARTS) / _STARTS), edges[-1])
            for edges in (self.cells.breaks_u, self.cells.breaks_v)
        ]
        u, v = np.meshgrid(*each, indexing="ij")
        return np.column_stack([u.reshape(-1), v.reshape(-1)]), (len(each[0]), len(each[1]))

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points(self._grid[0]))

    def _begin(self, points: FloatArray, place: FloatArray) -> None:
        starts = self._grid[0]
        few = len(starts) <= _FEW_STARTS
        nearest = closest(points, self._columns) if few else np.asarray(self._tree.query(points)[1])
        place[:] = starts[nearest]

    @cached_property
    def _columns(self) -> FloatArray:
        """(3, n) the points of the grid."""
        return np.ascontiguousarray(self.points(self._grid[0]).T)
