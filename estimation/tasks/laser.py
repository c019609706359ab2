"""Hand-eye of lasers: a point laser (5 parameters) or a profile laser (6) on planes and spheres."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from estimation.belief import Belief, Value
from estimation.model import pose_of, values_of
from estimation.surfaces import Feature, plane, sphere_features
from estimation.tasks import checks, starts
from estimation.tasks.chain import Markers, Readings, Surfaces
from estimation.tasks.findings import Cause, Finding
from estimation.tasks.mistakes import exchanged
from estimation.tasks.rolling import OnSphere
from estimation.tasks.sensing import (
    OTHER_SIZE,
    SensorTask,
    along_z,
    face_features,
    mislabelled,
    plane_starts,
    with_form,
)
from estimation.transform import FloatArray

_PLATE = (plane("plane", np.zeros(3), np.array([0.0, 0.0, 1.0])),)
_RADII_M = (0.005, 0.01, 0.02, 0.04)  # where the search for an unknown radius begins
_OTHER_KIND = Finding(
    Cause.WRONG_SURFACE,
    "The readings fit a surface of another kind than named",
    "Check what was measured: a plane, or a sphere",
)
_BEAM_FREEDOMS = ("tx", "ty", "tz", "rx", "ry")  # spin about the beam changes nothing


@dataclass(frozen=True, eq=False, kw_only=True)
class PointLaser(SensorTask):
    """Readings of a point laser, one at each pose: `reading_m` (m,) along its beam, +z of the laser."""

    reading_m: FloatArray
    std_m: float

    sensor: ClassVar[str] = "laser"
    mount_freedoms: ClassVar[tuple[str, ...]] = _BEAM_FREEDOMS

    def readings(self) -> Readings:
        return along_z(self.reading_m, self.std_m)

    def arrays(self) -> Mapping[str, tuple[Any, tuple[int | None, ...]]]:
        return {"reading_m": (self.reading_m, (len(self.motion),))}

    def check_readings(self) -> list[Finding]:
        if (self.reading_m >= 0.0).any():
            return []
        return [
            Finding(
                Cause.INVERTED,
                f"All {len(self.reading_m)} readings are negative: they would lie behind the laser",
                "Give distances along the beam; change the sign unless zero lies in the middle of the range",
                refuses=False,
            )
        ]


@dataclass(frozen=True, eq=False, kw_only=True)
class ProfileLaser(SensorTask):
    """Profiles: points (m, 2) as y and z in the frame of the sensor, `pose_index` (m,) says at which pose."""

    profile_m: FloatArray
    pose_index: NDArray[np.intp]
    std_m: tuple[float, float]

    sensor: ClassVar[str] = "profile"

    def readings(self) -> Readings:
        count = len(self.profile_m)
        points, covariance = np.zeros((count, 3)), np.zeros((count, 3, 3))
        points[:, 1:] = self.profile_m
        covariance[:, 1, 1], covariance[:, 2, 2] = self.std_m[0] ** 2, self.std_m[1] ** 2
        return Readings(points, covariance, self.pose_index)

    def arrays(self) -> Mapping[str, tuple[Any, tuple[int | None, ...]]]:
        return {
            "profile_m": (self.profile_m, (None, 2)),
            "pose_index": (self.pose_index, (checks.rows_of(self.profile_m),)),
        }

    def indices(self) -> Mapping[str, tuple[Any, int]]:
        return {"pose_index": (self.pose_index, len(self.motion))}


class _OnPlane(SensorTask):
    """The object is the plane z = 0 of its frame."""

    object: ClassVar[str] = "plane"

    @property
    def object_freedoms(self) -> tuple[str, ...]:
        return ("tz", "rx", "ry")

    def target(self) -> Surfaces | Markers:
        return Surfaces(_PLATE, np.zeros(len(self.readings().points_m), dtype=np.intp))

    def candidates(
        self, pose: FloatArray, readings: Readings, rows: NDArray[np.intp]
    ) -> list[Mapping[str, Value]]:
        index = np.zeros(len(rows), dtype=np.intp)
        return plane_starts(self, pose, readings.points_m[rows], _PLATE, index)

    def settled(self, values: Mapping[str, Value]) -> dict[str, Value]:
        """And the laser is in front of the plane, whose origin is amid the readings."""
        settled = super().settled(values)
        everything = {**values_of(self.rough()), **settled}
        spot_p = self.seen_points(everything)
        front_p = self.seen_points(everything, np.zeros_like(spot_p))
        return {**settled, self.object: starts.facing(pose_of(everything, self.object), front_p, spot_p)}

    def diagnose(self, values: Mapping[str, Value], rejected: NDArray[np.bool_] | None) -> list[Finding]:
        return checks.spread(self.seen_points(values), "points on the plane") if rejected is None else []


@dataclass(frozen=True, eq=False, kw_only=True)
class _OnSphere(SensorTask):
    """The object is a sphere; `radius_m` None if it shall be estimated, else with its certificate."""

    radius_m: float | None = None
    radius_std_m: float = 0.0

    object: ClassVar[str] = "sphere"

    @property
    def object_freedoms(self) -> tuple[str, ...]:
        return ("tx", "ty", "tz")

    def target(self) -> Surfaces | Markers:
        return Surfaces(sphere_features(), np.zeros(len(self.readings().points_m), dtype=np.intp))

    def with_object_priors(self, belief: Belief) -> Belief:
        known = self.radius_m is not None
        return belief.with_block(
            "sphere.radius",
            self.radius_m if self.radius_m is not None else _RADII_M[0],
            std=self.radius_std_m if known else np.inf,
        )

    def candidates(
        self, pose: FloatArray, readings: Readings, rows: NDArray[np.intp]
    ) -> list[Mapping[str, Value]]:
        points, nothing = readings.points_m[rows], np.zeros((len(rows), 3))
        grid = self.mount_grid()
        radii = np.array(_RADII_M if self.radius_m is None else [self.radius_m])
        # Seen from the laser, the centre is about a radius behind the surface.
        behind = np.array([0.0, 0.0, 1.0])
        found = [starts.on_points(pose, points + radius * behind, nothing, grid) for radius in radii]
        mount, holder = (np.concatenate([each[i] for each in found]) for i in (0, 1))
        return self.rolled(pose, points, OnSphere(), mount, holder, np.repeat(radii, len(grid)))

    def of_another_size(self) -> list[tuple[Finding, SensorTask]]:
        """The same with the radius left open."""
        return [] if self.radius_m is None else [(OTHER_SIZE, replace(self, radius_m=None))]


@dataclass(frozen=True, eq=False, kw_only=True)
class _OnPlanes(SensorTask):
    """The object is a part with plane faces; `face_index` (m,) says on which face each reading lies."""

    faces: tuple[Feature, ...]
    face_index: NDArray[np.intp]
    form_std_m: float = 0.0

    object: ClassVar[str] = "part"

    def target(self) -> Surfaces | Markers:
        return Surfaces(face_features(self.faces, self.form_std_m), self.face_index)

    def with_object_priors(self, belief: Belief) -> Belief:
        return with_form(belief, self.faces, self.form_std_m)

    def candidates(
        self, pose: FloatArray, readings: Readings, rows: NDArray[np.intp]
    ) -> list[Mapping[str, Value]]:
        return plane_starts(self, pose, readings.points_m[rows], self.faces, self.face_index[rows])

    def indices(self) -> Mapping[str, tuple[Any, int]]:
        return {"face_index": (self.face_index, len(self.faces))}

    def check_object(self) -> list[Finding]:
        return checks.normals(np.array([face.axis for face in self.faces]), self.face_index)

    def relabelled(self) -> list[tuple[Finding, SensorTask]]:
        names = [face.name for face in self.faces]
        return [
            (finding, replace(self, face_index=index)) for finding, index in exchanged(self.face_index, names)
        ]

    def diagnose(self, values: Mapping[str, Value], rejected: NDArray[np.bool_] | None) -> list[Finding]:
        return [] if rejected is None else mislabelled(self, self.faces, values, rejected)


@dataclass(frozen=True, eq=False, kw_only=True)
class PointLaserOnPlane(_OnPlane, PointLaser):
    """Point laser on one plane: 5 + 3 parameters."""

    task: ClassVar[str] = "point-laser-plane"

    def relabelled(self) -> list[tuple[Finding, SensorTask]]:
        return [(_OTHER_KIND, _as(PointLaserOnSphere, self))]


@dataclass(frozen=True, eq=False, kw_only=True)
class PointLaserOnSphere(_OnSphere, PointLaser):
    """Point laser on one sphere: 5 + 3 parameters, and the radius unless it is known."""

    task: ClassVar[str] = "point-laser-sphere"

    def relabelled(self) -> list[tuple[Finding, SensorTask]]:
        return [(_OTHER_KIND, _as(PointLaserOnPlane, self)), *self.of_another_size()]


@dataclass(frozen=True, eq=False, kw_only=True)
class PointLaserOnPlanes(_OnPlanes, PointLaser):
    """Point laser on three or more faces of the part: 5 + 6 parameters."""

    task: ClassVar[str] = "point-laser-planes"

    def arrays(self) -> Mapping[str, tuple[Any, tuple[int | None, ...]]]:
        return {**super().arrays(), "face_index": (self.face_index, (len(self.motion),))}


@dataclass(frozen=True, eq=False, kw_only=True)
class ProfileLaserOnPlane(_OnPlane, ProfileLaser):
    """Profile laser on one plane: 6 + 3 parameters."""

    task: ClassVar[str] = "profile-laser-plane"

    def relabelled(self) -> list[tuple[Finding, SensorTask]]:
        return [(_OTHER_KIND, _as(ProfileLaserOnSphere, self))]


@dataclass(frozen=True, eq=False, kw_only=True)
class ProfileLaserOnSphere(_OnSphere, ProfileLaser):
    """Profile laser on one sphere: 6 + 3 parameters, and the radius unless it is known."""

    task: ClassVar[str] = "profile-laser-sphere"

    def relabelled(self) -> list[tuple[Finding, SensorTask]]:
        return [(_OTHER_KIND, _as(ProfileLaserOnPlane, self)), *self.of_another_size()]


def _as(kind: type[SensorTask], task: SensorTask) -> SensorTask:
    """The same readings, taken for those of another surface."""
    shared = {field.name for field in fields(kind)} & {field.name for field in fields(task)}
    return kind(**{name: getattr(task, name) for name in shared})
