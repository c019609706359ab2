"""The data set of each calibration task: what it adds to the common parts, and the problem it becomes."""

from collections.abc import Iterator
from typing import Annotated, Any, Final

import numpy as np
from pydantic import Field

from controller.cellfile.mistakes import nearest
from controller.cellfile.tables import Name
from controller.offline.dataset_parts import (
    Index,
    MotionDataset,
    Noise,
    Part,
    Point,
    Prior,
    SharedErrors,
    Std,
    Units,
    Wrong,
    beyond,
    unequal,
)
from controller.quantities import Angle, Length
from estimation.surfaces import plane
from estimation.tasks.registry import KINEMATIC_TASKS, SENSOR_TASKS
from estimation.tasks.sensing import SensorTask
from estimation.tasks.solve import Problem

Radius = Annotated[Length, Field(gt=0, le=5)]


class SensorDataset(MotionDataset):
    """Readings of a sensor at many poses of an arm."""

    prior: Prior | None = None
    shared_errors: SharedErrors = SharedErrors()

    @property
    def kind(self) -> type[SensorTask]:
        """The type of the problem."""
        return (SENSOR_TASKS if self.task in SENSOR_TASKS else KINEMATIC_TASKS)[self.task]

    def problem(self) -> Problem:
        return self.measured()

    def measured(self) -> SensorTask:
        """The problem of the sensor alone."""
        return self.kind(**self.arguments())

    def arguments(self) -> dict[str, Any]:
        """Of the problem."""
        shared, prior = self.shared_errors, self.prior
        known: dict[str, Any] = {}
        if prior is not None:
            known = prior.known(self.units, self.kind.mount_freedoms)
        return {
            "motion": self.motion.motion(self.units),
            "scale_std": shared.scale,
            "offset_std_m": shared.offset_m,
            "consider": shared.consider,
            **known,
        }

    def wrong(self) -> Iterator[Wrong]:
        yield from super().wrong()
        near, sensor = "base" if self.kind.beside else "flange", self.kind.sensor
        if self.prior is not None:
            for key, wanted in (("target", near), ("source", sensor)):
                if getattr(self.prior, key) != wanted:
                    yield ("prior", key), "another frame", f'write "{wanted}": the prior is {near}_T_{sensor}'
            yield from self.prior.wrong(self.kind.mount_freedoms)
        shared = self.shared_errors
        known = [f"{sensor}.scale"] * (shared.scale > 0) + [f"{sensor}.offset"] * (shared.offset_m > 0)
        for place, name in enumerate(shared.consider):
            if name not in known:
                yield ("shared_errors", "consider", place), "not a shared error here", nearest(name, known)


class _PointLaser(SensorDataset):
    readings: tuple[float, ...]
    """Distances along the beam, one for each pose."""
    noise_m: Noise
    """Standard deviation of a reading."""

    def arguments(self) -> dict[str, Any]:
        return {
            **super().arguments(),
            "reading_m": self.units.lengths(self.readings),
            "std_m": self.noise_m,
        }

    def wrong(self) -> Iterator[Wrong]:
        yield from super().wrong()
        yield from unequal(("readings",), len(self.readings), len(self.motion), "pose")


class _ProfileLaser(SensorDataset):
    points: Annotated[tuple[tuple[float, float], ...], Field(min_length=1)]
    """y and z of points in the frame of the sensor."""
    pose: tuple[Index, ...]
    """The pose of each point, counted from 0."""
    noise_m: tuple[Noise, Noise]
    """Standard deviation of a point along y and z."""

    def arguments(self) -> dict[str, Any]:
        return {
            **super().arguments(),
            "profile_m": self.units.lengths(self.points),
            "pose_index": np.array(self.pose, dtype=np.intp),
            "std_m": self.noise_m,
        }

    def wrong(self) -> Iterator[Wrong]:
        yield from super().wrong()
        yield from unequal(("pose",), len(self.pose), len(self.points), "point")
        yield from beyond(("pose",), self.pose, len(self.motion), "poses")


class _Touches(SensorDataset):
    noise_m: Noise
    """Standard deviation of a touch along the normal."""
    ball_radius_m: Radius
    """Radius of the ball of the stylus."""
    ball_radius_u_m: Std = 0.0
    """Standard uncertainty of it, pre-travel included."""

    def arguments(self) -> dict[str, Any]:
        return {
            **super().arguments(),
            "std_m": self.noise_m,
            "ball_radius_m": self.ball_radius_m,
            "ball_std_m": self.ball_radius_u_m,
        }


class _OnSphere(SensorDataset):
    radius_m: Radius | None = None
    """Radius of the sphere; estimated where it is left out."""
    radius_u_m: Std = 0.0
    """Standard uncertainty of its certificate."""

    def arguments(self) -> dict[str, Any]:
        return {**super().arguments(), "radius_m": self.radius_m, "radius_std_m": self.radius_u_m}


class Face(Part):
    """A plane face of the part, in the frame of the part."""

    name: Name
    point: Point
    """Any point on it."""
    normal: Point
    """Out of the material, of length 1."""


class FacesOfPart(Part):
    """Readings on plane faces, each with its name."""

    units: Units
    faces: Annotated[tuple[Face, ...], Field(min_length=3)]
    """Faces of the part."""
    face: tuple[str, ...]
    """Name of the face of each reading."""
    form_u_m: Std = 0.0
    """Standard deviation by which a face lies off as a whole."""

    def of_faces(self) -> dict[str, Any]:
        """Arguments of the problem."""
        names = [face.name for face in self.faces]
        return {
            "faces": tuple(
                plane(face.name, self.units.lengths(face.point), np.array(face.normal)) for face in self.faces
            ),
            "face_index": np.array([names.index(name) for name in self.face], dtype=np.intp),
            "form_std_m": self.form_u_m,
        }

    def wrong_faces(self, count: int, what: str) -> Iterator[Wrong]:
        """What is wrong with them, `count` readings, one for each `what`."""
        yield from unequal(("face",), len(self.face), count, what)
        yield from unknown_names(("face",), self.face, [face.name for face in self.faces])
        for place, face in enumerate(self.faces):
            yield from not_unit(("faces", place, "normal"), face.normal)


class MarkersOfObject(Part):
    """Points that are told apart."""

    units: Units
    marker: tuple[Index, ...]
    """The marker of each point, counted from 0."""
    markers: Annotated[tuple[Point, ...], Field(min_length=1)] | None = None
    """Markers in the frame of the object; estimated where they are left out."""
    marker_u_m: Std = 0.0
    """Standard uncertainty of each of their coordinates."""

    def of_markers(self) -> dict[str, Any]:
        """Arguments of the problem."""
        return {
            "marker_index": np.array(self.marker, dtype=np.intp),
            "markers_m": None if self.markers is None else self.units.lengths(self.markers),
            "marker_std_m": self.marker_u_m,
        }

    def wrong_markers(self, count: int) -> Iterator[Wrong]:
        """What is wrong with them, for `count` points."""
        yield from unequal(("marker",), len(self.marker), count, "point")
        if self.markers is not None:
            yield from beyond(("marker",), self.marker, len(self.markers), "markers")


class _OnPlanes(FacesOfPart, SensorDataset):
    def arguments(self) -> dict[str, Any]:
        return {**super().arguments(), **self.of_faces()}

    def wrong(self) -> Iterator[Wrong]:
        yield from super().wrong()
        yield from self.wrong_faces(len(self.motion), "pose")


def unknown_names(path: tuple[str, ...], used: tuple[str, ...], known: list[str]) -> Iterator[Wrong]:
    """The first name that no feature has, and names that two have."""
    for row, name in enumerate(used):
        if name not in known:
            yield (*path, row), "unknown name", nearest(name, known)
            return
    if twice := next((name for name in known if known.count(name) > 1), None):
        yield path[:0], f'two features are called "{twice}"', "give each a name of its own"


def not_unit(path: tuple[str | int, ...], direction: Point) -> Iterator[Wrong]:
    """A direction that is none."""
    length = float(np.linalg.norm(direction))
    if not 0.999 < length < 1.001:
        yield path, f"a direction of length {length:.4g}", "write one of length 1"


class _Markers(MarkersOfObject, SensorDataset):
    points: Annotated[tuple[Point, ...], Field(min_length=1)]
    """Markers as the sensor sees them, x, y, z in its frame."""
    pose: tuple[Index, ...]
    """The pose of each point, counted from 0."""

    def arguments(self) -> dict[str, Any]:
        return {
            **super().arguments(),
            **self.of_markers(),
            "points_m": self.units.lengths(self.points),
            "pose_index": np.array(self.pose, dtype=np.intp),
        }

    def wrong(self) -> Iterator[Wrong]:
        yield from super().wrong()
        yield from self.wrong_markers(len(self.points))
        yield from unequal(("pose",), len(self.pose), len(self.points), "point")
        yield from beyond(("pose",), self.pose, len(self.motion), "poses")


class Camera(_Markers):
    """Markers by a camera."""

    noise_m: tuple[Noise, Noise, Noise]
    """Standard deviation of a point along x, y and z of the camera."""

    def arguments(self) -> dict[str, Any]:
        return {**super().arguments(), "covariance": np.diag(np.square(self.noise_m))}


class _Tracker(_Markers):
    noise_m: Noise
    """Standard deviation of a point in every direction."""
    angle_noise_rad: Angle = Field(default=0.0, ge=0, le=0.01)
    """Standard deviation of the direction of the beam: across it, a point scatters more with its distance."""

    def arguments(self) -> dict[str, Any]:
        return {**super().arguments(), "std_m": self.noise_m, "angle_std_rad": self.angle_noise_rad}

    def wrong(self) -> Iterator[Wrong]:
        yield from super().wrong()
        if self.shared_errors.offset_m > 0.0:
            yield ("shared_errors", "offset"), "a tracker has no offset along its z", "take it out"


class _PointLaserOnSphere(_OnSphere, _PointLaser):
    pass


class PointLaserOnPlanes(_OnPlanes, _PointLaser):
    """Faces of a part by a point laser."""


class _ProfileLaserOnSphere(_OnSphere, _ProfileLaser):
    pass


class _TouchOnSphere(_OnSphere, _Touches):
    radius_m: Radius
    """Radius of the sphere: touches alone cannot tell it from that of the ball."""


class TouchOnPlanes(_OnPlanes, _Touches):
    """Faces of a part by a stylus."""


SENSOR_DATASETS: Final[dict[str, type[SensorDataset]]] = {
    "point-laser-plane": _PointLaser,
    "point-laser-planes": PointLaserOnPlanes,
    "point-laser-sphere": _PointLaserOnSphere,
    "profile-laser-plane": _ProfileLaser,
    "profile-laser-sphere": _ProfileLaserOnSphere,
    "touch-sphere": _TouchOnSphere,
    "touch-planes": TouchOnPlanes,
    "camera-hand-eye": Camera,
    "camera-eye-to-hand": Camera,
    "tracker": _Tracker,
}
