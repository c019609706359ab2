"""Measured points on features as a model for the solver, with errors that all points share."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.belief import POSE_FREEDOMS, Value
from estimation.model import Rows, pose_of, pose_rows, vector_of
from estimation.surfaces import Feature, feature_table, signed_distance
from estimation.surfaces.mesh import TriangleMesh
from estimation.surfaces.tangents import Tangents
from estimation.transform import FloatArray, skew

POINT_NOISE: Final = "point noise"


@dataclass(frozen=True, slots=True, eq=False)
class SharedError:
    """An error c that moves every measured point: base_p + by_point c is where it truly was.

    Attributes
    ----------
    covariance : (w, w) prior of c.
    by_point : (m, 3, w).
    freedoms : names of c's elements, which give their units as in a belief.
    """

    name: str
    covariance: FloatArray
    by_point: FloatArray
    freedoms: tuple[str, ...]


def hand_eye_error(
    name: str, covariance: FloatArray, base_R_sensor: FloatArray, sensor_p: FloatArray
) -> SharedError:
    """The error of a sensor's mount: a right perturbation (6,) of it, form A, order (t, phi), m and rad.

    base_R_sensor : (m, 3, 3) orientation of the sensor at each point; sensor_p (m, 3) the point as it saw it.
    """
    by_point = np.concatenate([base_R_sensor, -base_R_sensor @ skew(sensor_p)], axis=2)
    return SharedError(name, covariance, by_point, POSE_FREEDOMS)


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePoints:
    """Signed distances of points in the base to features of an object; a `Model` of the solver.

    Attributes
    ----------
    base_p, covariance : (m, 3), (m, 3, 3), m and m^2.
    index : (m,) which of the features each point lies on.
    object : block of the belief with base_T_object.
    """

    base_p: FloatArray
    covariance: FloatArray
    features: tuple[Feature, ...]
    index: NDArray[np.intp]
    shared: tuple[SharedError, ...]
    object: str

    def __len__(self) -> int:
        return len(self.base_p)

    def weighed_at(self, values: Mapping[str, Value]) -> "SurfacePoints":
        """Meshes give way to the planes on which the points lie there: with them the cost is smooth."""
        if not any(isinstance(feature.shape, TriangleMesh) for feature in self.features):
            return self
        object_p = self._object_p(values)
        held = tuple(
            replace(feature, shape=Tangents(feature.shape, feature.shape.nearest(object_p[self.index == i])))
            if isinstance(feature.shape, TriangleMesh)
            else feature
            for i, feature in enumerate(self.features)
        )
        return replace(self, features=held)

    def rows(self, values: Mapping[str, Value]) -> Rows:
        """Residuals and derivatives. Raises EstimationError when a block is missing."""
        pose, object_p = pose_of(values, self.object), self._object_p(values)
        table = feature_table(self.features)
        deviations = [vector_of(values, name, size) for name, size in table.blocks]
        found = signed_distance(
            self.features, self.index, object_p, np.concatenate([np.zeros(0), *deviations])
        )
        base_g = found.gradient @ pose.rotation.T
        jacobian = {self.object: -pose_rows(found.gradient, object_p)}
        place = 0
        for name, size in table.blocks:
            jacobian[name] = found.deviation[:, place : place + size]
            place += size
        for each in self.shared:
            jacobian[each.name] = np.einsum("mi,miw->mw", base_g, each.by_point)
        variance = np.einsum("mi,mij,mj->m", base_g, self.covariance, base_g)
        return Rows(found.distance_m, jacobian, {POINT_NOISE: variance})

    def _object_p(self, values: Mapping[str, Value]) -> FloatArray:
        base_p = self.base_p
        for each in self.shared:
            base_p = base_p + each.by_point @ vector_of(values, each.name)
        return pose_of(values, self.object).inverse().points(base_p)
