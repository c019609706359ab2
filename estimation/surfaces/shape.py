"""What a free-form surface must tell: where it is nearest to points, and how its own parameters move it."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from estimation.transform import FloatArray

if TYPE_CHECKING:
    from estimation.surfaces.mesh import TriangleMesh

Hints = NDArray[Any]  # what a shape remembers of each point between two passes: (m, ...)
CHUNK: Final = 2048  # points to a partial sum: fixed, so that results do not depend on the number of threads
SUMS: Final = 29  # of J^T J (upper triangle by rows), J^T r, cost, number of points
_UPPER: Final = np.triu_indices(6)


@dataclass(frozen=True, slots=True, eq=False)
class Nearest:
    """Where a surface is nearest to points (m, 3), in the frame of the surface.

    Attributes
    ----------
    foot_m : (m, 3) nearest points of the surface.
    normal : (m, 3) gradient of the distance, out of the material: the unit normal, and `beyond` a curved edge
        what the tangent plane turns as the foot slides along.
    distance_m : (m,) signed, positive outside the material; where `beyond`, height over the tangent plane
        at the edge, because a surface says nothing of what lies beside it.
    beyond : (m,) True where the foot is on the edge of an open surface.
    place : (m, 2) parameters (u, v) of the feet on a spline; (m, 1) triangles on a mesh.
    """

    foot_m: FloatArray
    normal: FloatArray
    distance_m: FloatArray
    beyond: NDArray[np.bool_]
    place: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """What least squares needs of weighted distances of points, by a right perturbation of base_T_object.

    `information` (6, 6) is J^T W J, `vector` (6,) is J^T W r; `cost` is that of the loss.
    """

    information: FloatArray
    vector: FloatArray
    cost: float
    count: int

    @staticmethod
    def of(flat: FloatArray) -> "Sums":
        """From the sums (SUMS,) of a compiled pass."""
        information = np.zeros((6, 6))
        information[_UPPER] = flat[:21]
        information.T[_UPPER] = flat[:21]
        return Sums(information, flat[21:27], float(flat[27]), int(flat[28]))


def sums_of(nearest: Nearest, object_p: FloatArray, weight: FloatArray, huber: float) -> Sums:
    """The same sums in numpy; weight (m,) is 1 / standard deviation."""
    size = np.abs(nearest.distance_m) * weight
    less = np.minimum(1.0, np.sqrt(huber / np.maximum(size, 1e-300)))
    scaled = weight * less
    cost = np.where(less < 1.0, huber * (2.0 * size - huber), size**2) if np.isfinite(huber) else size**2
    rows = np.concatenate([nearest.normal, np.cross(object_p, nearest.normal)], axis=1)
    rows *= -scaled[:, None]
    return Sums(rows.T @ rows, rows.T @ (scaled * nearest.distance_m), float(cost.sum()), len(object_p))


class Shape(Protocol):
    """A free-form surface in the frame of its object. Equal only to itself."""

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """What may deviate in the shape itself, such as coordinates of control points; may be empty."""

    def deviated(self, values: FloatArray) -> "Shape":
        """The shape with deviations of its parameters, in the order of their names, built in."""

    def nearest(self, object_p: FloatArray) -> Nearest:
        """Nearest points of the surface to points (m, 3), metres."""

    def by_parameters(self, nearest: Nearest) -> FloatArray:
        """Derivatives (m, q) of the distances by the parameters."""

    @property
    def kinked(self) -> bool:
        """Whether distances have kinks, as between facets; elsewhere least squares converge faster."""

    @property
    def coarse(self) -> "TriangleMesh":
        """Triangles near the surface, for a search over all poses; the mesh itself for a mesh."""

    def new_hints(self, count: int) -> Hints:
        """What is remembered of points of which nothing is known yet; passes keep it up to date."""

    def order(self, base_p: FloatArray, base_T_object: FloatArray) -> NDArray[np.intp]:
        """An order (m,) of points in which neighbours follow each other, where that makes passes faster."""

    def sums(
        self,
        base_p: FloatArray,
        weight: FloatArray,
        base_T_object: FloatArray,
        hints: Hints,
        huber: float = np.inf,
    ) -> Sums:
        """Sums over points (m, 3) in the base, weight (m,) 1/m; residuals over `huber` weigh less."""
