"""The true part: CAD faces with their deviations, hit by rays and touched by balls."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from estimation.errors import CellFileError
from estimation.transform import FloatArray
from simulators.world.kinematics import Triple
from simulators.world.step_faces import StepFace
from simulators.world.truth import FaceDeviation
from simulators.world.world_file import FeatureSpec

ON_FACE_M: Final = 1e-4  # a feature's point is this near to its face
NEIGHBOURHOOD_M: Final = 0.005
FAR_M: Final = 0.01  # beyond this from the box of the part, the box is exact enough for a ball


@dataclass(frozen=True, slots=True)
class Hit:
    """Where a ray meets a surface first."""

    distance_m: float
    cosine: float  # of the incidence angle
    surface: str


class _Plane:
    def __init__(self, face: StepFace, name: str, deviation: FaceDeviation | None) -> None:
        self.name = name
        self._wave_m = deviation.waviness_m if deviation else 0.0
        self._number = 2 * math.pi / deviation.wavelength_m if deviation else 0.0
        self._phases = deviation.phases_rad.tolist() if deviation else [0.0, 0.0]
        u_dir, v_dir = face.x_dir, np.cross(face.axis, face.x_dir)
        self._origin, self._normal = _triple(face.origin), _triple(face.axis)
        self._u, self._v = _triple(u_dir), _triple(v_dir)
        self._level = float(face.axis @ face.origin) + (deviation.offset_m if deviation else 0.0)
        edges = face.outline - face.origin
        u, v = edges @ u_dir, edges @ v_dir
        self._u0, self._v0, self._v1 = u[:, 0], v[:, 0], v[:, 1]
        rise = self._v1 - self._v0
        self._slope = (u[:, 1] - self._u0) / np.where(rise == 0, 1.0, rise)
        self._box = (float(u.min()), float(u.max()), float(v.min()), float(v.max()))
        along_axes = (np.abs(np.diff(u)) < 1e-9) | (np.abs(np.diff(v)) < 1e-9)
        self._rectangle = len(edges) == 4 and bool(along_axes.all())

    def _wave(self, u: float, v: float) -> float:
        if not self._wave_m:
            return 0.0
        pu, pv = self._phases
        return self._wave_m * math.sin(self._number * u + pu) * math.sin(self._number * v + pv)

    def _inside(self, u: float, v: float) -> bool:
        """Within the outline: an odd number of edges lies to the right."""
        lower_u, upper_u, lower_v, upper_v = self._box
        if not (lower_u <= u <= upper_u and lower_v <= v <= upper_v):
            return False
        if self._rectangle:
            return True
        crosses = (self._v0 > v) != (self._v1 > v)
        right = self._u0 + (v - self._v0) * self._slope > u
        return bool(np.count_nonzero(crosses & right) % 2)

    def _on_face(self, point: Triple) -> tuple[float, float]:
        relative = _minus(point, self._origin)
        return _dot(relative, self._u), _dot(relative, self._v)

    def hit(self, origin: Triple, direction: Triple, nearest_m: float) -> tuple[float, float] | None:
        approach = -_dot(direction, self._normal)
        if approach <= 1e-9:
            return None
        distance = (_dot(self._normal, origin) - self._level) / approach
        if not 0 < distance < nearest_m:
            return None
        u, v = self._on_face(_along(origin, direction, distance))
        return (distance - self._wave(u, v) / approach, approach) if self._inside(u, v) else None

    def signed_distance(self, point: Triple, nearest_m: float) -> float | None:
        """Height over the face, outside positive; None if not over it or farther than `nearest_m`."""
        height = _dot(self._normal, point) - self._level
        if abs(height) >= nearest_m + self._wave_m:
            return None
        u, v = self._on_face(point)
        return height - self._wave(u, v) if self._inside(u, v) else None


class _Cylinder:
    def __init__(self, face: StepFace, name: str, deviation: FaceDeviation | None) -> None:
        self.name = name
        shift = deviation.shift_m if deviation else np.zeros(3)
        self._origin, self._axis = _triple(face.origin + shift), _triple(face.axis)
        self._x, self._y = _triple(face.x_dir), _triple(np.cross(face.axis, face.x_dir))
        self._radius = face.radius + (deviation.offset_m if deviation else 0.0)
        self._outward = face.outward
        self._lower, self._upper = float(face.heights[0]), float(face.heights[1])
        first, last = (float(angle) for angle in face.angles)
        self._middle, self._half = (first + last) / 2, (last - first) / 2

    def _inside(self, x: float, y: float, height: float) -> bool:
        if not self._lower <= height <= self._upper:
            return False
        turn = math.atan2(y, x) - self._middle
        return abs(math.remainder(turn, 2 * math.pi)) <= self._half + 1e-9

    def hit(self, origin: Triple, direction: Triple, nearest_m: float) -> tuple[float, float] | None:
        relative = _minus(origin, self._origin)
        ox, oy = _dot(relative, self._x), _dot(relative, self._y)
        dx, dy = _dot(direction, self._x), _dot(direction, self._y)
        a = dx * dx + dy * dy
        b = ox * dx + oy * dy
        rest = b * b - a * (ox * ox + oy * oy - self._radius**2)
        if a < 1e-12 or rest <= 0:
            return None
        # The ray goes in at the first root and out at the second: of a hole it meets the wall at the second.
        distance = (-b - self._outward * math.sqrt(rest)) / a
        if not 0 < distance < nearest_m:
            return None
        x, y = ox + distance * dx, oy + distance * dy
        height = _dot(relative, self._axis) + distance * _dot(direction, self._axis)
        return (distance, abs(x * dx + y * dy) / self._radius) if self._inside(x, y, height) else None

    def signed_distance(self, point: Triple, nearest_m: float) -> float | None:
        relative = _minus(point, self._origin)
        x, y = _dot(relative, self._x), _dot(relative, self._y)
        height = self._outward * (math.hypot(x, y) - self._radius)
        if abs(height) >= nearest_m or not self._inside(x, y, _dot(relative, self._axis)):
            return None
        return height


class Solid:
    """The part in its own frame; metres. Deviations move the faces, not the edges where they are cut off."""

    def __init__(
        self,
        faces: Iterable[StepFace],
        features: Iterable[FeatureSpec],
        deviations: dict[str, FaceDeviation],
    ) -> None:
        nominal = [(face, _surface(face, "", None)) for face in faces]
        names: dict[int, str] = {}
        for feature in features:
            near = [
                i
                for i, (_, surface) in enumerate(nominal)
                if (d := surface.signed_distance(_triple(feature.at_m), 1.0)) is not None
                and abs(d) < ON_FACE_M
            ]
            if len(near) != 1:
                where = np.round(feature.at_m * 1e3, 2).tolist()
                raise CellFileError(
                    f"{feature.name}: {len(near)} faces at {where} mm", "Give a point inside one face"
                )
            names[near[0]] = feature.name
        self._faces = [
            _surface(face, names.get(i, f"face {i}"), deviations.get(names.get(i, "")))
            for i, (face, _) in enumerate(nominal)
        ]
        edges = np.unique(
            np.concatenate([face.outline for face, _ in nominal]), axis=0
        )  # two faces share each
        self._edges = self._near_edges = edges
        self._near_point: Triple = (math.inf, math.inf, math.inf)  # `_near_edges` serve around it
        self._near_edge_m = 0.0  # to the nearest of them, from there
        self._lower = [float(x) for x in edges.min(axis=(0, 1))]
        self._upper = [float(x) for x in edges.max(axis=(0, 1))]

    def hit(self, origin: FloatArray, direction: FloatArray, nearest_m: float) -> Hit | None:
        """First face that a ray meets from outside, nearer than `nearest_m`."""
        start, way = _triple(origin), _triple(direction)
        best: Hit | None = None
        for face in self._faces:
            found = face.hit(start, way, nearest_m)
            if found is not None:
                nearest_m = found[0]
                best = Hit(nearest_m, found[1], face.name)
        return best

    def signed_distance(self, point: Triple, enough_m: float = math.inf) -> float:
        """Of a point to the surface, outside positive.

        A lower bound where the point is more than 10 mm or `enough_m` away.
        """
        x, y, z = point
        (low_x, low_y, low_z), (high_x, high_y, high_z) = self._lower, self._upper
        beside_x = max(low_x - x, x - high_x, 0.0)
        beside_y = max(low_y - y, y - high_y, 0.0)
        beside_z = max(low_z - z, z - high_z, 0.0)
        box_distance = math.hypot(beside_x, beside_y, beside_z)
        if box_distance > FAR_M or box_distance > enough_m:
            return box_distance
        best = math.inf
        for face in self._faces:
            found = face.signed_distance(point, abs(best))
            if found is not None:
                best = found
        edge = self._edge_distance(point, abs(best))
        return edge if edge < abs(best) else best

    def _edge_distance(self, point: Triple, nearest_m: float) -> float:
        """To the nearest edge; at least `nearest_m` or FAR_M where there is none so near."""
        moved_m = math.dist(point, self._near_point)
        if moved_m > NEIGHBOURHOOD_M:  # a touch stays in one neighbourhood
            distances = _segment_distances(point, self._edges)
            self._near_edges = self._edges[distances < FAR_M + NEIGHBOURHOOD_M]
            self._near_point, self._near_edge_m = point, float(distances.min())
            return self._near_edge_m
        if self._near_edge_m - moved_m >= nearest_m:
            return nearest_m
        if not len(self._near_edges):
            return FAR_M
        return float(_segment_distances(point, self._near_edges).min())


def _triple(vector: FloatArray) -> Triple:
    x, y, z = vector.tolist()
    return x, y, z


def _dot(a: Triple, b: Triple) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _minus(a: Triple, b: Triple) -> Triple:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _along(origin: Triple, direction: Triple, distance: float) -> Triple:
    return (
        origin[0] + distance * direction[0],
        origin[1] + distance * direction[1],
        origin[2] + distance * direction[2],
    )


def _segment_distances(point: Triple, segments: FloatArray) -> FloatArray:
    """Distances (n,) of a point to segments (n, 2, 3)."""
    to_start, along = point - segments[:, 0], segments[:, 1] - segments[:, 0]
    share = np.einsum("ij,ij->i", to_start, along) / np.einsum("ij,ij->i", along, along)
    gap = to_start - np.clip(share, 0.0, 1.0)[:, None] * along
    distances: FloatArray = np.sqrt(np.einsum("ij,ij->i", gap, gap))
    return distances


def _surface(face: StepFace, name: str, deviation: FaceDeviation | None) -> _Plane | _Cylinder:
    return _Cylinder(face, name, deviation) if face.radius else _Plane(face, name, deviation)
