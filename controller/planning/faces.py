"""Faces of the part for planning: points well inside them, and rays that meet them first."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from controller.cellfile import Cell
from controller.cellfile.lasers import Laser
from controller.knowledge import all_faces, part_faces
from controller.planning.poses import BoolArray
from estimation.cad import CadFace
from estimation.errors import EstimationError
from estimation.transform import FloatArray

_KEY_M: Final = 1e-7  # corners nearer than this are one
_MOST_PAIRS: Final = 500_000  # of rays and triangles at a time: some 20 MB


@dataclass(frozen=True, slots=True, eq=False)
class FaceSampler:
    """A plane face: its triangles and its edges, outer and of its holes."""

    name: str
    normal: FloatArray  # (3,) outwards
    triangles: FloatArray  # (k, 3, 3)
    edges: FloatArray  # (e, 2, 3)

    @staticmethod
    def of(cell: Cell, name: str) -> "FaceSampler":
        """The sampler of a named face; kept while the same part is planned for."""
        return _sampler(name, part_faces(cell)[name])

    def draw(self, random: np.random.Generator, count: int, margin_m: float) -> FloatArray:
        """Up to `count` points (k, 3) evenly over the face, farther than `margin_m` from its edges.

        Raises EstimationError when the face has no such points.
        """
        first, second, third = np.moveaxis(self.triangles, 1, 0)
        areas = np.linalg.norm(np.cross(second - first, third - first), axis=1)
        tried = 3 * count
        chosen = random.choice(len(areas), size=tried, p=areas / areas.sum())
        u, v = random.uniform(0.0, 1.0, (2, tried, 1))
        flip = u + v > 1.0
        u, v = np.where(flip, 1.0 - u, u), np.where(flip, 1.0 - v, v)
        points = first[chosen] + u * (second - first)[chosen] + v * (third - first)[chosen]
        inside: FloatArray = points[self.edge_distance(points) > margin_m][:count]
        if not len(inside):
            raise EstimationError(
                f"Face {self.name} has no point farther than {margin_m * 1e3:.1f} mm from its edges",
                "Leave it out of the faces, or place the part more precisely",
            )
        return inside

    def edge_distance(self, points: FloatArray) -> FloatArray:
        """Distance (m,) of points to the nearest edge."""
        start, along = self.edges[:, 0], self.edges[:, 1] - self.edges[:, 0]
        middle = start.mean(axis=0)  # near the points: squares of small numbers are exact enough
        points, start = points - middle, start - middle
        length = (along**2).sum(axis=1)
        ahead = points @ along.T - np.einsum("ek,ek->e", start, along)
        square = (points**2).sum(axis=1)[:, None] - 2.0 * points @ start.T + (start**2).sum(axis=1)
        share = np.clip(ahead / length, 0.0, 1.0)
        nearest = (square + share * (share * length - 2.0 * ahead)).min(axis=1)
        distance: FloatArray = np.sqrt(np.maximum(nearest, 0.0))
        return distance


@dataclass(frozen=True, slots=True, eq=False)
class Met:
    """What beams meet first."""

    on_face: BoolArray  # (m,) the face that was meant
    distance_m: FloatArray  # (m,) inf where nothing is met
    cosine: FloatArray  # (m,) of the incidence

    def within(self, laser: Laser) -> BoolArray:
        """In the working range, at an incidence that the sensor stands."""
        low, high = laser.working_range_m
        fair = self.cosine > np.cos(laser.max_incidence_rad)
        inside: BoolArray = (self.distance_m > low) & (self.distance_m < high) & fair
        return inside


def beams_meet(cell: Cell, part_o: FloatArray, part_beam: FloatArray, names: list[str]) -> Met:
    """Rays from points (m, 3) along unit vectors (m, 3), in the frame of the part, against all its faces."""
    named = part_faces(cell)
    wanted = np.array([named[name].index for name in names])
    met = np.full(len(part_o), -1, dtype=np.intp)
    distance, cosine = np.full(len(part_o), np.inf), np.zeros(len(part_o))
    for face in _meshes(all_faces(cell)):
        near = np.flatnonzero(face.may_meet(part_o, part_beam))
        for some in np.array_split(near, len(near) * len(face.normal) // _MOST_PAIRS + 1):
            there, slope = face.first_met(part_o[some], part_beam[some])
            first = there < distance[some]
            nearer = some[first]
            met[nearer], distance[nearer], cosine[nearer] = face.index, there[first], slope[first]
    return Met(met == wanted, distance, cosine)


@dataclass(frozen=True, slots=True, eq=False)
class _Mesh:
    """Triangles (t) of a face, after Moeller and Trumbore by Pluecker's moment: products of matrices only."""

    index: int
    centre: FloatArray  # (3,) of a sphere that holds the face
    radius_m: float
    normal: FloatArray  # (t, 3) across, as long as twice the area
    height: FloatArray  # (t,) of its plane along that
    one: FloatArray
    two: FloatArray  # (t, 3) sides from the first corner
    one_first: FloatArray
    two_first: FloatArray  # (t, 3) cross products with the first corner

    def may_meet(self, origin: FloatArray, beam: FloatArray) -> BoolArray:
        """Which rays (m, 3) pass the sphere of the face."""
        aside = np.cross(origin - self.centre, beam)
        passing: BoolArray = np.einsum("mi,mi->m", aside, aside) <= self.radius_m**2
        return passing

    def first_met(self, origin: FloatArray, beam: FloatArray) -> tuple[FloatArray, FloatArray]:
        """For rays (m, 3): the distance (inf: none), and the cosine of the incidence."""
        moment = np.cross(origin, beam)
        determinant = -beam @ self.normal.T
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (origin @ self.normal.T - self.height) / determinant
            u = (moment @ self.two.T - beam @ self.two_first.T) / determinant
            v = (beam @ self.one_first.T - moment @ self.one.T) / determinant
            hit = (distance > 0.0) & (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1.0 + 1e-9)
        distance = np.where(hit, distance, np.inf)
        nearest = np.argmin(distance, axis=1)
        rows = np.arange(len(origin))
        cosine = np.abs(determinant[rows, nearest]) / np.linalg.norm(self.normal[nearest], axis=1)
        return distance[rows, nearest], cosine


@lru_cache(maxsize=64)
def _sampler(name: str, face: CadFace) -> FaceSampler:
    if face.kind != "plane":
        raise EstimationError(f"Feature {name} is a {face.kind}", "Localize the part from plane faces")
    sides = np.stack([face.triangles, np.roll(face.triangles, -1, axis=1)], axis=2).reshape(-1, 2, 3)
    keys = np.round(sides / _KEY_M).astype(np.int64)
    swap = [tuple(a) > tuple(b) for a, b in keys.tolist()]
    keys[swap] = keys[swap][:, ::-1]
    _, first, counts = np.unique(keys.reshape(-1, 6), axis=0, return_index=True, return_counts=True)
    return FaceSampler(
        name, face.axis, face.triangles, sides[first[counts == 1]]
    )  # a side of one triangle: an edge


@lru_cache(maxsize=8)
def _meshes(faces: tuple[CadFace, ...]) -> tuple[_Mesh, ...]:
    """The triangles of each face, as rays need them."""
    return tuple(_mesh(face) for face in faces)


def _mesh(face: CadFace) -> _Mesh:
    corners = face.triangles
    first, one, two = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(one, two)
    points = corners.reshape(-1, 3)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2.0
    return _Mesh(
        index=face.index,
        centre=centre,
        radius_m=float(np.linalg.norm(points - centre, axis=1).max()) * (1.0 + 1e-9),
        normal=normal,
        height=np.einsum("tk,tk->t", first, normal),
        one=one,
        two=two,
        one_first=np.cross(one, first),
        two_first=np.cross(two, first),
    )
