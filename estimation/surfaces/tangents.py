"""The planes on which some points are nearest to a mesh, in place of the mesh."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation.surfaces.mesh import TriangleMesh
from estimation.surfaces.shape import Hints, Nearest, Sums
from estimation.transform import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Tangents:
    """A mesh, of which each of some points sees one plane only.

    Between two facets the distance to a mesh has a kink, at which an estimator that needs a smooth cost would
    stand still; so it goes on with the planes, takes new ones where it ends, and goes on again.
    """

    mesh: TriangleMesh
    held: Nearest

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """None."""
        return ()

    @property
    def kinked(self) -> bool:
        """As the mesh."""
        return True

    @property
    def coarse(self) -> TriangleMesh:
        """The mesh."""
        return self.mesh

    def deviated(self, values: FloatArray) -> "Tangents":
        """Itself; there are no parameters."""
        return self

    def by_parameters(self, nearest: Nearest) -> FloatArray:
        """Derivatives (m, 0)."""
        return np.zeros((len(nearest.distance_m), 0))

    def nearest(self, object_p: FloatArray) -> Nearest:
        """Heights over the planes, of the very points (m, 3) for which they are held, in that order."""
        held = self.held
        height = held.distance_m + np.einsum("mi,mi->m", object_p - self._points, held.normal)
        return replace(held, foot_m=object_p - height[:, None] * held.normal, distance_m=height)

    @property
    def _points(self) -> FloatArray:
        return self.held.foot_m + self.held.distance_m[:, None] * self.held.normal

    def new_hints(self, count: int) -> Hints:
        """As the mesh."""
        return self.mesh.new_hints(count)

    def order(self, base_p: FloatArray, base_T_object: FloatArray) -> NDArray[np.intp]:
        """As the mesh."""
        return self.mesh.order(base_p, base_T_object)

    def sums(
        self,
        base_p: FloatArray,
        weight: FloatArray,
        base_T_object: FloatArray,
        hints: Hints,
        huber: float = np.inf,
    ) -> Sums:
        """As the mesh."""
        return self.mesh.sums(base_p, weight, base_T_object, hints, huber)
