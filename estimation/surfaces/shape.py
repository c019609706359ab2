"""What a free-form surface must tell: where it is nearest to points, and how its own parameters move it."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from estimation.transform import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Nearest:
    """Where a surface is nearest to points (m, 3), in the frame of the surface.

    Attributes
    ----------
    foot_m : (m, 3) nearest points of the surface.
    normal : (m, 3) unit gradient of the distance, out of the material.
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
