"""Triangle meshes as surfaces: the exact nearest point, its side, and edges where the surface ends."""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.errors import EstimationError
from estimation.surfaces.mesh_grid import Grid, IntArray, grid_of
from estimation.surfaces.shape import CHUNK, SUMS, Nearest, Sums, sums_of
from estimation.transform import FloatArray

try:
    from estimation.surfaces import mesh_kernels as kernels
except ImportError:  # numba is optional: trimesh gives the same numbers, in a hundred times the time
    kernels = None  # type: ignore[assignment]

_ON_SIDE: Final = 1e-9  # of the median side: rounding of a foot that lies on a side
_FLAT: Final = 1e-12  # of the longest side: the height of a triangle that has no normal
_NO_DIRECTION_M: Final = 1e-12  # from foot to point


@dataclass(frozen=True, slots=True, eq=False)
class TriangleMesh:
    """Triangles in the frame of their object, counter-clockwise seen from outside the material.

    Attributes
    ----------
    vertices_m : (n, 3).
    triangles : (f, 3) vertices. Triangles without area are left out.
    normals : (f, 7, 3) unit: of the triangle, of its three sides, of its three corners; the latter are the
        averages, weighted by angle, that tell the side of a point whose foot is there (Baerentzen and
        Aanaes 2005).
    open : (f, 7) True for sides and corners on the edge of the surface.

    Raises EstimationError for a mesh without triangles, or one that names vertices that are not there.
    """

    vertices_m: FloatArray
    triangles: IntArray
    corners_m: FloatArray = field(init=False)  # (f, 3, 3)
    planes: FloatArray = field(init=False)  # (f, 16) normal and height: of the triangle, and of its sides
    normals: FloatArray = field(init=False)
    open: NDArray[np.bool_] = field(init=False)
    grid: Grid | None = field(init=False)  # None without compiled kernels

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices_m, dtype=np.float64)
        triangles = np.asarray(self.triangles, dtype=np.int32)
        if vertices.ndim != 2 or vertices.shape[1:] != (3,) or triangles.shape[1:] != (3,):
            raise EstimationError(
                f"Mesh of vertices {vertices.shape} and triangles {triangles.shape}",
                "Give arrays (n, 3) and (f, 3)",
            )
        if not np.isfinite(vertices).all() or (
            triangles.size and not (0 <= triangles.min() <= triangles.max() < len(vertices))
        ):
            raise EstimationError(
                "The mesh has vertices that are not finite, or triangles of vertices that are not there",
                "Export it again",
            )
        corners = vertices[triangles]
        sides = np.roll(corners, -1, axis=1) - corners
        area = np.cross(sides[:, 0], sides[:, 1])
        longest = np.linalg.norm(sides, axis=2).max(axis=1, initial=0.0)
        sound = np.linalg.norm(area, axis=1) > _FLAT * longest**2
        if not sound.any():
            raise EstimationError("The mesh has no triangle with an area", "Export it again")
        triangles, corners, sides, area = triangles[sound], corners[sound], sides[sound], area[sound]
        normal = area / np.linalg.norm(area, axis=1, keepdims=True)
        inward = np.cross(normal[:, None], sides)
        inward /= np.linalg.norm(inward, axis=2, keepdims=True)
        planes = np.empty((len(triangles), 4, 4))
        planes[:, 0, :3], planes[:, 1:, :3] = normal, inward
        planes[:, 0, 3] = np.einsum("fi,fi->f", normal, corners[:, 0])
        planes[:, 1:, 3] = np.einsum("fki,fki->fk", inward, corners)
        normals, is_open, across = _normals(triangles, normal, sides, len(vertices))
        for name, value in {
            "vertices_m": vertices,
            "triangles": triangles,
            "corners_m": np.ascontiguousarray(corners),
            "planes": planes.reshape(-1, 16),
            "normals": normals,
            "open": is_open,
            "grid": grid_of(corners, planes.reshape(-1, 16), across) if kernels is not None else None,
        }.items():
            object.__setattr__(self, name, value)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """None: a mesh deviates as a whole."""
        return ()

    def deviated(self, values: FloatArray) -> "TriangleMesh":
        """Itself; there are no parameters."""
        return self

    def by_parameters(self, nearest: Nearest) -> FloatArray:
        """Derivatives (m, 0)."""
        return np.zeros((len(nearest.distance_m), 0))

    def nearest(self, object_p: FloatArray) -> Nearest:
        """Exact nearest points of the mesh to points (m, 3), metres; `place` (m, 1) holds the triangles."""
        points = np.ascontiguousarray(object_p, dtype=np.float64)
        facet, region, foot = self._feet(points)
        away = points - foot
        normal = self.normals[facet, region]
        side = np.einsum("mi,mi->m", away, normal)
        length = np.linalg.norm(away, axis=1)
        beyond = self.open[facet, region]
        flat = (region == 0) | beyond | (length < _NO_DIRECTION_M)
        signed = np.where(side >= 0.0, length, -length)
        return Nearest(
            foot_m=foot,
            normal=np.where(flat[:, None], normal, away / np.where(flat, 1.0, signed)[:, None]),
            distance_m=np.where(flat, side, signed),
            beyond=beyond,
            place=facet[:, None].astype(np.float64),
        )

    @property
    def kinked(self) -> bool:
        """Between facets."""
        return True

    @property
    def coarse(self) -> "TriangleMesh":
        """Itself."""
        return self

    def new_hints(self, count: int) -> IntArray:
        """No triangle is known to be near any point."""
        return np.full(count, -1, dtype=np.int32)

    def order(self, base_p: FloatArray, base_T_object: FloatArray) -> NDArray[np.intp]:
        """The order (m,) of points by the cell in which they lie: neighbours are found in the cache."""
        return (
            np.arange(len(base_p)) if self.grid is None else self.grid.sorted_by_cell(base_p, base_T_object)
        )

    def sums(
        self,
        base_p: FloatArray,
        weight: FloatArray,
        base_T_object: FloatArray,
        hints: IntArray,
        huber: float = np.inf,
    ) -> Sums:
        """Sums over points as `Shape` describes them; `hints` (m,) hold triangles, or -1 at first."""
        rotation, origin = np.ascontiguousarray(base_T_object[:3, :3]), base_T_object[:3, 3].copy()
        if self.grid is None:
            object_p = (base_p - origin) @ rotation
            return sums_of(self.nearest(object_p), object_p, weight, huber)
        partial = np.empty((-(-len(base_p) // CHUNK), SUMS))
        kernels.normal_equations(
            base_p,
            weight,
            rotation,
            origin,
            huber,
            hints,
            *self.grid.arrays(),
            self.grid.order,
            self.normals,
            self.open,
            partial,
        )
        return Sums.of(partial.sum(axis=0))

    def _feet(self, points: FloatArray) -> tuple[IntArray, NDArray[np.int8], FloatArray]:
        """Triangle (m,), region (m,) as in `mesh_kernels`, and foot (m, 3) of each point."""
        if self.grid is None:
            return _feet_by_trimesh(self, points)
        facet = np.full(len(points), -1, dtype=np.int32)
        region, foot = np.empty(len(points), dtype=np.int8), np.empty((len(points), 3))
        kernels.nearest(points, facet, *self.grid.arrays(), foot, region)
        return self.grid.order[facet], region, foot


def _normals(
    triangles: IntArray, normal: FloatArray, sides: FloatArray, vertices: int
) -> tuple[FloatArray, NDArray[np.bool_], IntArray]:
    """Normals (f, 7, 3) of triangles, sides and corners, which of them are on an open edge (f, 7), and the
    triangles across the sides (f, 3).
    """
    count = len(triangles)
    pairs = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    _, side, shared = np.unique(
        pairs[:, 0].astype(np.int64) * vertices + pairs[:, 1], return_inverse=True, return_counts=True
    )
    of_side = np.repeat(normal, 3, axis=0)
    at_side = _summed(side, of_side, len(shared))[side]
    direction = sides / np.linalg.norm(sides, axis=2, keepdims=True)
    cosine = -np.einsum("fki,fki->fk", direction, np.roll(direction, 1, axis=1))
    angle = np.arccos(np.clip(cosine, -1.0, 1.0)).reshape(-1, 1)
    corner = triangles.reshape(-1)
    at_corner = _summed(corner, angle * of_side, vertices)[corner]
    ends = pairs[shared[side] == 1].reshape(-1)
    open_vertex = np.zeros(vertices, dtype=np.bool_)
    open_vertex[ends] = True
    normals = np.concatenate(
        [normal[:, None], at_side.reshape(count, 3, 3), at_corner.reshape(count, 3, 3)], axis=1
    )
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), np.finfo(np.float64).tiny)
    is_open = np.concatenate(
        [
            np.zeros((count, 1), dtype=np.bool_),
            (shared[side] == 1).reshape(count, 3),
            open_vertex[triangles],
        ],
        axis=1,
    )
    return normals, is_open, _across(side, len(shared)).reshape(count, 3)


def _across(side: NDArray[np.intp], count: int) -> IntArray:
    """(3 f,) for each side of each triangle one of the others that have it, or -1."""
    triangle = np.arange(len(side), dtype=np.int32) // 3
    first, last = np.empty(count, dtype=np.int32), np.empty(count, dtype=np.int32)
    last[side] = triangle
    first[side[::-1]] = triangle[::-1]
    other = np.where(first[side] == triangle, last[side], first[side])
    return np.where(other == triangle, -1, other).astype(np.int32)


def _summed(index: NDArray[np.intp] | IntArray, vectors: FloatArray, count: int) -> FloatArray:
    """Sums (count, 3) of the vectors of each index."""
    return np.column_stack([np.bincount(index, vectors[:, k], count) for k in range(3)])


def _feet_by_trimesh(mesh: TriangleMesh, points: FloatArray) -> tuple[IntArray, NDArray[np.int8], FloatArray]:
    import trimesh  # slow to import, and needed only without compiled kernels

    # trimesh compares products of lengths with fixed tolerances: triangles of 1 mm in metres come out wrong.
    unit_m = float(np.median(np.linalg.norm(mesh.corners_m[:, 1] - mesh.corners_m[:, 0], axis=1)))
    surface = trimesh.Trimesh(mesh.vertices_m / unit_m, mesh.triangles, process=False)
    _, _, facet = trimesh.proximity.closest_point(surface, points / unit_m)  # type: ignore[no-untyped-call]
    scaled = trimesh.triangles.closest_point(  # type: ignore[no-untyped-call]
        mesh.corners_m[facet] / unit_m, points / unit_m
    )
    foot = scaled * unit_m
    planes = mesh.planes[facet].reshape(-1, 4, 4)[:, 1:]
    inside = np.einsum("mki,mi->mk", planes[..., :3], foot) - planes[..., 3]
    on_side = (
        inside < 1e-12 * np.linalg.norm(mesh.corners_m[facet, 1] - mesh.corners_m[facet, 0], axis=1)[:, None]
    )
    # A foot on two sides is at the corner where they meet: sides k and k - 1 meet at corner k.
    region = np.where(on_side.any(axis=1), on_side.argmax(axis=1) + 1, 0)
    corner = on_side & np.roll(on_side, 1, axis=1)
    region = np.where(corner.any(axis=1), corner.argmax(axis=1) + 4, region)
    return facet.astype(np.int32), region.astype(np.int8), foot
