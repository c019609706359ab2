"""A regular grid over the triangles of a mesh, for the compiled search."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_cdt

from estimation.transform import FloatArray

try:
    from estimation.surfaces import grid_kernels as kernels
    from estimation.surfaces import mesh_kernels
except ImportError:  # numba is optional, and without it there is no grid
    kernels = None  # type: ignore[assignment]

IntArray = NDArray[np.int32]
_LARGEST_CELLS: Final = 1 << 22
_CELLS_PER_TRIANGLE: Final = 16
_CELL_TO_SIDE: Final = 0.5  # fewer triangles to try, more cells to look into: measured, and flat around here


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Which triangles reach into which cell; cells ordered with the last axis fastest.

    Triangles are ordered by cell too: those that one point asks for are neighbours in memory.
    """

    origin_m: FloatArray  # (3,)
    size_m: float
    counts: NDArray[np.int64]  # (3,)
    start: IntArray  # (cells + 1,) where the members of each cell begin
    members: IntArray  # triangles, cell by cell
    seed: IntArray  # (cells,) the central triangle of the nearest occupied cell
    gap: NDArray[np.int8]  # (cells,) cells to that, in the largest of the three directions; 127 for more
    order: IntArray  # (f,) the mesh's number of each triangle
    corners_m: FloatArray  # (f, 3, 3)
    planes: FloatArray  # (f, 16)
    across: IntArray  # (f, 3) a triangle on the other side of each side, or -1
    clear: FloatArray  # (f, 4) as of `grid_kernels.clearance`

    def sorted_by_cell(self, base_p: FloatArray, base_T_mesh: FloatArray) -> NDArray[np.intp]:
        """The order (m,) of points by the cell in which they lie."""
        rotation, origin = np.ascontiguousarray(base_T_mesh[:3, :3]), base_T_mesh[:3, 3].copy()
        return np.asarray(
            kernels.cell_order(base_p, rotation, origin, self.origin_m, self.size_m, self.counts)
        )

    def arrays(
        self,
    ) -> tuple[
        FloatArray,
        float,
        NDArray[np.int64],
        IntArray,
        IntArray,
        IntArray,
        NDArray[np.int8],
        IntArray,
        FloatArray,
        FloatArray,
        FloatArray,
    ]:
        """What the compiled search takes."""
        return (
            self.origin_m,
            self.size_m,
            self.counts,
            self.start,
            self.members,
            self.seed,
            self.gap,
            self.across,
            self.clear,
            self.corners_m,
            self.planes,
        )


def grid_of(corners: FloatArray, planes: FloatArray, across: IntArray) -> Grid:
    """The grid over triangles: corners (f, 3, 3), planes (f, 16), and what is across their sides (f, 3)."""
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    extent = high - low
    side_m = float(np.median(np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)))
    limit = min(_LARGEST_CELLS, _CELLS_PER_TRIANGLE * len(corners) + 64)
    size_m = max(_CELL_TO_SIDE * side_m, float(extent.max()) / 1024)
    while np.prod(np.floor(extent / size_m) + 1.0) > limit:
        size_m *= 1.1
    counts = (np.floor(extent / size_m) + 1.0).astype(np.int64)
    place = np.minimum(((corners.mean(axis=1) - low) / size_m).astype(np.int64), counts - 1)
    order = np.argsort(np.ravel_multi_index(tuple(place.T), tuple(counts)), kind="stable").astype(np.int32)
    renamed = np.empty(len(order) + 1, dtype=np.int32)
    renamed[order], renamed[-1] = np.arange(len(order)), -1
    corners, planes, across = corners[order], planes[order], renamed[across[order]]
    start = np.zeros(int(counts.prod()) + 1, dtype=np.int32)
    kernels.fill_cells(corners, planes, low, size_m, counts, start, np.empty(0, np.int32))
    gap, place = distance_transform_cdt(
        (start[:-1] == 0).reshape(counts), metric="chessboard", return_indices=True
    )
    start = np.cumsum(start, dtype=np.int32)
    members = np.empty(int(start[-1]), dtype=np.int32)
    kernels.fill_cells(corners, planes, low, size_m, counts, start, members)
    occupied = np.ravel_multi_index(tuple(place), tuple(counts)).reshape(-1)
    central = mesh_kernels.central(low, size_m, counts, start, members, corners, planes)
    return Grid(
        origin_m=low,
        size_m=size_m,
        counts=counts,
        start=start,
        members=members,
        seed=central[occupied],
        gap=np.minimum(gap, 127).astype(np.int8).reshape(-1),
        order=order,
        corners_m=corners,
        planes=planes,
        across=across,
        clear=kernels.clearance(low, size_m, counts, start, members, corners, planes, across),
    )
