"""Bicubic patches as polynomials, one for each cell between two knots, and foot points on them by Newton."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.spatial import cKDTree

from estimation.surfaces.shape import CHUNK, SUMS, Nearest, Sums, sums_of
from estimation.transform import FloatArray

try:
    from estimation.surfaces import bspline_kernels as kernels
except ImportError:  # numba is optional: numpy gives the same numbers
    kernels = None  # type: ignore[assignment]

DEGREE: Final = 3
COMPILED: Final = kernels is not None
_CLOSED: Final = 1e-9  # of the size: the two edges of a patch that are one line, and go on smoothly
_STEPS: Final = 40
_CONVERGED: Final = 1e-6  # last step, of the size of the patch: Newton's error is its square
_FIRST_DAMPING: Final = 1e-3
_LARGEST_DAMPING: Final = 1e12


def closest(points: FloatArray, grid: FloatArray) -> NDArray[np.intp]:
    """(m,) which of a few points, the columns of `grid` (3, n), is closest to each of the points (m, 3)."""
    if COMPILED:
        return np.asarray(kernels.closest(np.ascontiguousarray(points), grid))
    return np.asarray(cKDTree(grid.T).query(points)[1])


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """A patch as polynomials.

    Attributes
    ----------
    breaks_u, breaks_v : ends of the cells.
    closed_u, closed_v : the surface goes on smoothly from its last cell into its first.
    coefficients : (cells in u, cells in v, 3, 4, 4) of powers of the place within the cell, 0 to 1.
    size_m : largest extent of the patch.
    """

    breaks_u: FloatArray
    breaks_v: FloatArray
    closed_u: bool
    closed_v: bool
    coefficients: FloatArray
    size_m: float

    @staticmethod
    def of(knots_u: FloatArray, knots_v: FloatArray, control_m: FloatArray) -> "Cells":
        """The cells of a patch, its knots (n + 4,) and (k + 4,), its control points (n, k, 3)."""
        breaks_u, powers_u = _polynomials(knots_u, control_m.shape[0])
        breaks_v, powers_v = _polynomials(knots_v, control_m.shape[1])
        coefficients = np.ascontiguousarray(
            np.einsum("ipa,jqb,abk->ijkpq", powers_u, powers_v, control_m, optimize=True)
        )
        size_m = float(np.ptp(control_m, axis=(0, 1)).max())
        closed_u = _closed(coefficients[0], coefficients[-1], np.diff(breaks_u), size_m, 2)
        closed_v = _closed(coefficients[:, 0], coefficients[:, -1], np.diff(breaks_v), size_m, 3)
        return Cells(breaks_u, breaks_v, closed_u, closed_v, coefficients, size_m)

    def arrays(self) -> tuple[float, FloatArray, FloatArray, bool, bool, FloatArray]:
        """What the compiled passes take."""
        return (
            self.size_m,
            self.breaks_u,
            self.breaks_v,
            self.closed_u,
            self.closed_v,
            self.coefficients,
        )

    def jets(self, place: FloatArray) -> FloatArray:
        """Points and derivatives (m, 6, 3): u, v, uu, uv, vv."""
        rows = []
        for edges, value in ((self.breaks_u, place[:, 0]), (self.breaks_v, place[:, 1])):
            cell = np.clip(np.searchsorted(edges, value, side="right") - 1, 0, len(edges) - 2)
            per = 1.0 / (edges[cell + 1] - edges[cell])
            s = (value - edges[cell]) * per
            one, zero = np.ones_like(s), np.zeros_like(s)
            rows.append(
                (
                    cell,
                    np.stack([one, s, s**2, s**3], axis=1),
                    np.stack([zero, one, 2 * s, 3 * s**2], axis=1) * per[:, None],
                    np.stack([zero, zero, 2 * one, 6 * s], axis=1) * per[:, None] ** 2,
                )
            )
        (i, *along_u), (j, *along_v) = rows
        left = np.stack([along_u[order] for order in (0, 1, 0, 2, 1, 0)], axis=1)
        right = np.stack([along_v[order] for order in (0, 0, 1, 0, 1, 2)], axis=1)
        chosen = self.coefficients[i, j]
        return np.asarray(np.einsum("mdp,mkpq,mdq->mdk", left, chosen, right, optimize=True))

    def feet(self, points: FloatArray, place: FloatArray, beyond: NDArray[np.bool_]) -> None:
        """Moves `place` (m, 2) from its starts to the feet of points (m, 3); `beyond` (m,) on the edge.

        Damped Newton steps, held at the edges.
        """
        if COMPILED:
            kernels.feet(points, place, *self.arrays(), beyond)
            return
        edges = np.array([[e[0], e[-1]] for e in (self.breaks_u, self.breaks_v)])
        closed = np.array([self.closed_u, self.closed_v])
        damping, last = np.zeros(len(points)), np.full(len(points), np.inf)
        open_ = np.arange(len(points))
        for _ in range(_STEPS):
            here = place[open_]
            jets = self.jets(here)
            away = jets[:, 0] - points[open_]
            slope = np.einsum("mi,mki->mk", away, jets[:, 1:3])
            pinned = ~closed & (
                ((here <= edges[:, 0]) & (slope > 0.0)) | ((here >= edges[:, 1]) & (slope < 0.0))
            )
            beyond[open_] = pinned.any(axis=1)
            done = (
                (last[open_] < _CONVERGED * self.size_m)
                | (damping[open_] > _LARGEST_DAMPING)
                | pinned.all(axis=1)
            )
            keep = ~done
            open_, here, jets, away, slope, pinned = (
                each[keep] for each in (open_, here, jets, away, slope, pinned)
            )
            if not len(open_):
                break
            step, scale = _newton(jets, away, slope, pinned, damping[open_])
            there = here + step
            there = np.where(
                closed,
                edges[:, 0] + (there - edges[:, 0]) % (edges[:, 1] - edges[:, 0]),
                np.clip(there, edges[:, 0], edges[:, 1]),
            )
            before = np.einsum("mi,mi->m", away, away)
            trial = self.jets(there)[:, 0] - points[open_]
            better = np.einsum("mi,mi->m", trial, trial) <= before * (1.0 + 1e-14)
            held = damping[open_]
            damping[open_] = np.where(
                better,
                np.where(held > _FIRST_DAMPING, 0.1 * held, 0.0),
                np.maximum(10.0 * held, _FIRST_DAMPING),
            )
            length = np.sqrt(np.einsum("mk,mk->m", step**2, scale))
            last[open_[better]] = length[better]
            place[open_[better]] = there[better]

    def seen(self, points: FloatArray, place: FloatArray, beyond: NDArray[np.bool_]) -> Nearest:
        """What there is to know of points (m, 3) whose feet are at `place` (m, 2)."""
        jets = self.jets(place)
        normal = np.cross(jets[:, 1], jets[:, 2])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        foot = jets[:, 0]
        distance = np.einsum("mi,mi->m", points - foot, normal)
        if beyond.any():
            normal[beyond] += self._turning(points[beyond] - foot[beyond], place[beyond], jets[beyond])
        return Nearest(foot, normal, distance, beyond, place)

    def _turning(self, away: FloatArray, place: FloatArray, jets: FloatArray) -> FloatArray:
        """What the gradient (m, 3) is besides the normal, for points `away` (m, 3) from feet on an edge.

        As the foot slides along its edge, the tangent plane turns under a point that is aside of it.
        """
        on_u, on_v = (
            (not closed) & ((at <= breaks[0]) | (at >= breaks[-1]))
            for at, breaks, closed in (
                (place[:, 0], self.breaks_u, self.closed_u),
                (place[:, 1], self.breaks_v, self.closed_v),
            )
        )
        _, su, sv, suu, suv, svv = jets.swapaxes(0, 1)
        across = np.cross(su, sv)
        length = np.linalg.norm(across, axis=1)
        height = np.einsum("mi,mi->m", away, across) / length**2
        turning = np.zeros_like(away)
        for slides, along, bend, change in (
            (on_v & ~on_u, su, suu, np.cross(suu, sv) + np.cross(su, suv)),
            (on_u & ~on_v, sv, svv, np.cross(suv, sv) + np.cross(su, svv)),
        ):
            turn = np.einsum("mi,mi->m", away - height[:, None] * across, change) / length
            stretch = np.einsum("mi,mi->m", along, along) - np.einsum("mi,mi->m", away, bend)
            turning += np.where(slides, turn / stretch, 0.0)[:, None] * along
        return turning

    def sums(
        self,
        base_p: FloatArray,
        weight: FloatArray,
        rotation: FloatArray,
        origin_m: FloatArray,
        place: FloatArray,
        huber: float,
    ) -> Sums:
        """Sums over points as `Shape` describes them; moves `place` (m, 2) from its starts to the feet."""
        if not COMPILED:
            object_p = (base_p - origin_m) @ rotation
            beyond = np.zeros(len(base_p), dtype=np.bool_)
            self.feet(object_p, place, beyond)
            return sums_of(self.seen(object_p, place, beyond), object_p, weight, huber)
        partial = np.empty((-(-len(base_p) // CHUNK), SUMS))
        kernels.normal_equations(base_p, weight, rotation, origin_m, huber, place, *self.arrays(), partial)
        return Sums.of(partial.sum(axis=0))


def _newton(
    jets: FloatArray, away: FloatArray, slope: FloatArray, pinned: NDArray[np.bool_], damping: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Steps (m, 2) of damped Newton, and what a unit of u and of v is worth (m, 2), m^2."""
    first = np.einsum("mki,mli->mkl", jets[:, 1:3], jets[:, 1:3])
    bend = np.einsum("mi,mki->mk", away, jets[:, 3:])
    hessian = first + np.stack([bend[:, [0, 1]], bend[:, [1, 2]]], axis=1)
    free = ~pinned.any(axis=1)
    hessian[:, 0, 1] *= free
    hessian[:, 1, 0] *= free
    first[:, 0, 1] *= free
    first[:, 1, 0] *= free
    worth = np.stack([first[:, 0, 0], first[:, 1, 1]], axis=1)
    determinant = hessian[:, 0, 0] * hessian[:, 1, 1] - hessian[:, 0, 1] ** 2
    valley = (hessian[:, 0, 0] > 0.0) & (hessian[:, 1, 1] > 0.0)
    valley &= determinant > 1e-6 * worth[:, 0] * worth[:, 1]
    hessian = np.where(valley[:, None, None], hessian, first)
    hessian[:, 0, 0] += damping * worth[:, 0]
    hessian[:, 1, 1] += damping * worth[:, 1]
    step = -np.linalg.solve(hessian, slope[:, :, None])[:, :, 0]
    return np.where(pinned, 0.0, step), worth


def _polynomials(knots: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Ends of the cells, and each basis function as polynomials: (cells, 4, count), rising powers."""
    breaks = np.unique(knots[DEGREE : count + 1])
    basis, length = BSpline(knots, np.eye(count), DEGREE), np.diff(breaks)
    taylor = [
        basis(breaks[:-1], nu=order) * (length**order / math.factorial(order))[:, None]
        for order in range(DEGREE + 1)
    ]
    return breaks, np.stack(taylor, axis=1)


def _closed(first: FloatArray, last: FloatArray, lengths: FloatArray, size_m: float, axis: int) -> bool:
    """Whether the surface goes on smoothly from its last cell into its first; powers along `axis`."""
    first, last = np.moveaxis(first, axis, 0), np.moveaxis(last, axis, 0)
    begin = [first[0], first[1] / lengths[0], 2 * first[2] / lengths[0] ** 2]
    end = [
        last.sum(axis=0),
        (last[1] + 2 * last[2] + 3 * last[3]) / lengths[-1],
        (2 * last[2] + 6 * last[3]) / lengths[-1] ** 2,
    ]
    span = float(lengths.sum())
    return all(
        np.abs(a - b).max() * span**order <= _CLOSED * 1e3**order * size_m
        for order, (a, b) in enumerate(zip(begin, end, strict=True))
    )
