"""Where a free form can be when nothing is known but points on it: a search over all poses."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from estimation.localization.alignment import LARGEST_ITERATIONS, descent
from estimation.localization.descent import descend, distinct
from estimation.surfaces.mesh import TriangleMesh
from estimation.surfaces.shape import Shape
from estimation.tasks.starts import rotations
from estimation.transform import FloatArray

_SAMPLES: Final = 4_000  # points of the surface that stand for it
_CELLS: Final = 48  # of the lookup, along the longest side
_MARGIN: Final = 0.15  # of the size, around the object
_ANCHORS: Final = 40  # points of the surface on which the middle of the measured points is tried
_ROTATIONS: Final = 576
# For each round: points that are looked at, steps, and how many poses are left for it.
_ROUNDS: Final = ((20, 3, 4_000), (40, 4, 700), (60, 12, 120))
_ALIGNED: Final = 400  # points with which what is left of the search is refined
_APART: Final = 0.05  # of the size: two poses closer than this roll into the same minimum
_SAME: Final = 2e-3  # of the size: two minima closer than this are one


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """Approximate distances to a surface anywhere: the nearest of its samples, looked up in a grid."""

    points_m: FloatArray  # (n, 3)
    normals: FloatArray  # (n, 3)
    spacing_m: float
    size_m: float
    origin_m: FloatArray
    cell_m: float
    counts: NDArray[np.intp]
    nearest: NDArray[np.intp]  # (cells,)

    def __call__(self, object_p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distances (...) and gradients (..., 3): over the tangent plane of the nearest sample, or to
        the sample itself where that is too far aside to be on the surface.
        """
        cell = ((object_p - self.origin_m) / self.cell_m).astype(np.intp)
        np.clip(cell, 0, self.counts - 1, out=cell)
        sample = self.nearest[(cell[..., 0] * self.counts[1] + cell[..., 1]) * self.counts[2] + cell[..., 2]]
        away, normal = object_p - self.points_m[sample], self.normals[sample]
        height = np.einsum("...i,...i->...", away, normal)
        square = np.einsum("...i,...i->...", away, away)
        aside = square - height**2 > (3.0 * self.spacing_m + 0.5 * np.abs(height)) ** 2
        length = np.sqrt(np.maximum(square, 1e-30))
        distance = np.where(aside, length, height)
        gradient = np.where(aside[..., None], away / length[..., None], normal)
        return distance, gradient


@lru_cache(maxsize=8)
def field_of(mesh: TriangleMesh) -> Field:
    """The field of a surface; cached, because one part is localized again and again."""
    rng = np.random.default_rng(0)
    sides = mesh.corners_m[:, 1:] - mesh.corners_m[:, :1]
    area = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    chosen = rng.choice(len(area), _SAMPLES, p=area / area.sum())
    points = np.einsum("mk,mki->mi", rng.dirichlet(np.ones(3), _SAMPLES), mesh.corners_m[chosen])
    low, high = points.min(axis=0), points.max(axis=0)
    size_m = float((high - low).max())
    low, high = low - _MARGIN * size_m, high + _MARGIN * size_m
    cell_m = float((high - low).max()) / _CELLS
    counts = np.ceil((high - low) / cell_m).astype(np.intp)
    middles = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1) + 0.5
    nearest = cKDTree(points).query(low + cell_m * middles.reshape(-1, 3))[1]
    return Field(
        points,
        mesh.normals[chosen, 0],
        float(np.sqrt(area.sum() / _SAMPLES)),
        size_m,
        low,
        cell_m,
        counts,
        np.asarray(nearest, dtype=np.intp),
    )


def search_surface(
    shape: Shape, base_p: FloatArray, count: int = 6, most: int = LARGEST_ITERATIONS
) -> tuple[FloatArray, FloatArray]:
    """Distinct poses of a surface that points may lie on; no start is needed.

    Parameters
    ----------
    base_p : (m, 3), metres; a part of the surface is enough if it is like no other part.
    most : passes of each refinement: points that do not lie on the surface at all take very many.

    Returns base_T_object (k, 4, 4), the most likely first, and the mean square distance (k,) of some of the
    points from the surface itself, m^2: beside an edge of it there is nothing, not its tangent plane.

    Notes
    -----
    Every rotation of a grid, with the middle of the points on every one of some points of the surface, goes
    down a few Gauss-Newton steps on a few points; the best go on with more, on the exact surface in the end.
    """
    field = field_of(shape.coarse)
    spread = _spread(base_p, max(points for points, _, _ in _ROUNDS))
    poses = _grid(spread[0], field)
    for points, steps, keep in _ROUNDS:
        poses, cost = descend(poses, spread[:points], field, steps)
        poses = poses[np.argsort(cost, kind="stable")[:keep]]
    cost = descend(poses, spread, field, 0)[1]
    left = distinct(poses, cost, _APART * field.size_m, field.size_m, 10 * count)
    few = np.ascontiguousarray(base_p[np.random.default_rng(0).permutation(len(base_p))[:_ALIGNED]])
    weight = np.full(len(few), 1.0 / (_SAME * field.size_m))
    reached = np.stack(
        [descent(shape, few, weight, poses[place], tolerance=1e-5, most=most).pose for place in left]
    )
    square = np.array([mean_square(shape, few, pose) for pose in reached])
    best = distinct(reached, square, _SAME * field.size_m, field.size_m, count)
    return reached[best], square[best]


def mean_square(shape: Shape, base_p: FloatArray, pose: FloatArray) -> float:
    """Mean square distance, m^2, of points (m, 3) from a surface, its edges included."""
    object_p = (base_p - pose[:3, 3]) @ pose[:3, :3]
    away = object_p - shape.nearest(object_p).foot_m
    return float(np.mean(np.einsum("mi,mi->m", away, away)))


def _spread(points: FloatArray, count: int) -> FloatArray:
    """Up to `count` points, the first in the middle, each next as far as possible from those before."""
    pool = points[np.random.default_rng(0).permutation(len(points))[:2_000]]
    place = int(np.argmin(np.linalg.norm(pool - pool.mean(axis=0), axis=1)))
    gap, order = np.full(len(pool), np.inf), []
    for _ in range(min(count, len(pool))):
        order.append(place)
        gap = np.minimum(gap, np.linalg.norm(pool - pool[place], axis=1))
        place = int(np.argmax(gap))
    return np.asarray(pool[order])


def _grid(middle_p: FloatArray, field: Field) -> FloatArray:
    """Poses (g, 4, 4) that put `middle_p` on each of the anchors, with each rotation."""
    turns, anchors = rotations(_ROTATIONS), _spread(field.points_m, _ANCHORS)
    poses = np.zeros((len(turns), len(anchors), 4, 4))
    poses[:, :, :3, :3], poses[:, :, 3, 3] = turns[:, None], 1.0
    poses[:, :, :3, 3] = middle_p - np.einsum("gij,aj->gai", turns, anchors)
    return poses.reshape(-1, 4, 4)
