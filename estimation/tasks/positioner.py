"""Two-axis positioner: where its axes are, from points of an object on its table.

The points are in one frame that stands, "base": that of a robot that touched them, or of a tracker. At each
pose of the table they may be points that are told apart (reflectors, centres of spheres, corners), or lie on
a sphere or on plane faces of a part.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation.belief import Belief, Value
from estimation.errors import DegenerateGeometry
from estimation.model import pose_of
from estimation.surfaces import Feature, sphere_features
from estimation.tasks import checks, starts
from estimation.tasks.camera import MarkerTask
from estimation.tasks.chain import Markers, Readings, Surfaces
from estimation.tasks.findings import Cause, Finding
from estimation.tasks.mistakes import exchanged
from estimation.tasks.positioner_starts import axes_from_points, objects, spheres
from estimation.tasks.sensing import SensorTask, face_features, with_form
from estimation.tasks.turning import ANGLE_ERRORS, AXES, Turning
from estimation.transform import FloatArray, Transform

_SMALLEST_TURN_RAD: Final = np.radians(5.0)
_ARM_M: Final = 0.1  # from the origin of an object to the points that stand for it in a start
_FEWEST_POSES: Final = 3


@dataclass(frozen=True, eq=False, kw_only=True)
class PositionerTask(SensorTask):
    """What all have in common.

    Attributes
    ----------
    motion : `Turning`, the angles of the positioner.
    points_m, pose_index : (m, 3) in the base, and (m,) the pose of the table at which each was taken.
    covariance : (3, 3) or (m, 3, 3) of a point, m^2, independent of the others.
    up : (3,) against gravity in the base; the zero of axis 1 is told by it.
    """

    points_m: FloatArray
    pose_index: NDArray[np.intp]
    covariance: FloatArray
    up: ArrayLike = (0.0, 0.0, 1.0)

    sensor: ClassVar[str] = "probe"
    beside: ClassVar[bool] = True
    mount_freedoms: ClassVar[tuple[str, ...]] = ()

    @property
    def frames(self) -> tuple[str, str]:
        return "base", "table"

    @property
    def turning(self) -> Turning:
        """The motion."""
        if not isinstance(self.motion, Turning):
            raise TypeError(f"A positioner turns, it has no {type(self.motion).__name__}")
        return self.motion

    def readings(self) -> Readings:
        covariance = np.broadcast_to(self.covariance, (len(self.points_m), 3, 3))
        return Readings(self.points_m, covariance, self.pose_index)

    def arrays(self) -> Mapping[str, tuple[Any, tuple[int | None, ...]]]:
        return {
            "points_m": (self.points_m, (None, 3)),
            "pose_index": (self.pose_index, (checks.rows_of(self.points_m),)),
        }

    def indices(self) -> Mapping[str, tuple[Any, int]]:
        return {"pose_index": (self.pose_index, len(self.motion))}

    def check_noise(self) -> list[Finding]:
        """What is wrong with the noise, and with the direction that is up."""
        found = checks.numbers({"up": (self.up, (3,))})
        return found + checks.covariances({"covariance": (self.covariance, len(self.points_m))})

    def _check_noise(self) -> list[Finding]:
        return checks.first_of(self.check_noise, super()._check_noise)

    def rough(self) -> Belief:
        return super().rough().without([ANGLE_ERRORS])

    def check_object(self) -> list[Finding]:
        return [
            Finding(
                Cause.ONE_AXIS,
                f"Axis {axis + 1} turns by {np.degrees(self.turning.turns_rad[axis]):.3g} deg, limit "
                f"{np.degrees(_SMALLEST_TURN_RAD):g} deg: where it is cannot be seen",
                "Turn it through 60 deg or more, or leave it at rest",
            )
            for axis in self.turning.axes
            if self.turning.turns_rad[axis] < _SMALLEST_TURN_RAD
        ]

    def seen_markers(self) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
        """Angles (m, a), points (m, 3) in the base and which of them are one on the table, for starts."""
        raise NotImplementedError

    def of_markers(self, axes: list[FloatArray], table_p: FloatArray) -> dict[str, Value]:
        """Start of the object from where those points are on the table, (n, 3)."""
        raise NotImplementedError

    def starts(self) -> Sequence[Mapping[str, Value]]:
        found = axes_from_points(*self.seen_markers())
        flat = {block.name for block in self.rough().blocks if block.flat}
        every = [
            {
                **{
                    AXES[axis]: Transform("base", AXES[axis], frame)
                    for axis, frame in zip(self.turning.axes, axes, strict=True)
                },
                **self.of_markers(axes, table_p),
            }
            for axes, table_p in zip(*found, strict=True)
        ]
        return [{name: value for name, value in one.items() if name in flat} for one in every]

    def settled(self, values: Mapping[str, Value]) -> dict[str, Value]:
        """The frame of an axis has its origin next to the middle of the points, and no spin of its own."""
        settled = dict(values)
        middle = self.points_m.mean(axis=0)
        for name in AXES:
            if name in values:
                frame = pose_of(values, name)
                matrix = frame.matrix.copy()
                matrix[:3, 3] += matrix[:3, 2] * (matrix[:3, 2] @ (middle - matrix[:3, 3]))
                settled[name] = starts.spun(Transform(frame.target, frame.source, matrix))
        return settled

    @property
    def angles(self) -> FloatArray:
        """(k, a) of the axes that turned."""
        return np.asarray(self.turning.angles_rad)[:, list(self.turning.axes)]


@dataclass(frozen=True, eq=False, kw_only=True)
class PositionerPoints(PositionerTask, MarkerTask):
    """Points that are told apart, such as reflectors; where they are on the table is known or not."""

    task: ClassVar[str] = "positioner"
    sensor: ClassVar[str] = "points"

    def covariance_of_points(self) -> FloatArray:
        return np.broadcast_to(self.covariance, (len(self.points_m), 3, 3))

    def check_noise(self) -> list[Finding]:
        return PositionerTask.check_noise(self)

    def arrays(self) -> Mapping[str, tuple[Any, tuple[int | None, ...]]]:
        return MarkerTask.arrays(self)

    def indices(self) -> Mapping[str, tuple[Any, int]]:
        return MarkerTask.indices(self)

    def check_object(self) -> list[Finding]:
        return PositionerTask.check_object(self) + MarkerTask.check_object(self)

    def seen_markers(self) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
        return self.angles[self.pose_index], self.points_m, self.marker_index

    def of_markers(self, axes: list[FloatArray], table_p: FloatArray) -> dict[str, Value]:
        if self.markers_m is None:
            return {self.markers: table_p.reshape(-1)}
        seen = np.unique(self.marker_index)
        return {self.object: Transform("table", self.object, _fitted(self.markers_m[seen], table_p[seen]))}


@dataclass(frozen=True, eq=False, kw_only=True)
class _Touched(PositionerTask):
    """Points on surfaces: of a laser, or centres of the ball of a probe."""

    ball_radius_m: float = 0.0
    ball_std_m: float = 0.0

    def with_object_priors(self, belief: Belief) -> Belief:
        if not self.ball_radius_m:
            return belief
        return belief.with_block("probe.radius", self.ball_radius_m, std=self.ball_std_m)


@dataclass(frozen=True, eq=False, kw_only=True)
class PositionerSphere(_Touched):
    """Touches of a sphere on the table; four or more at three poses or more."""

    radius_m: float
    radius_std_m: float = 0.0

    task: ClassVar[str] = "positioner-sphere"
    object: ClassVar[str] = "sphere"

    @property
    def object_freedoms(self) -> tuple[str, ...]:
        return ("tx", "ty", "tz")

    def target(self) -> Surfaces | Markers:
        return Surfaces(sphere_features(), np.zeros(len(self.points_m), dtype=np.intp))

    def with_object_priors(self, belief: Belief) -> Belief:
        belief = super().with_object_priors(belief)
        return belief.with_block("sphere.radius", self.radius_m, std=self.radius_std_m)

    def seen_markers(self) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
        poses, centre = spheres(self.points_m, self.pose_index, len(self.motion))
        _require(len(poses), "four or more touches")
        return self.angles[poses], centre, np.zeros(len(poses), dtype=np.intp)

    def of_markers(self, axes: list[FloatArray], table_p: FloatArray) -> dict[str, Value]:
        place = np.eye(4)
        place[:3, 3] = table_p[0]
        return {self.object: Transform("table", self.object, place)}


@dataclass(frozen=True, eq=False, kw_only=True)
class PositionerPlanes(_Touched):
    """Points on plane faces of a part on the table; six or more, on three faces, at three poses or more."""

    faces: tuple[Feature, ...]
    face_index: NDArray[np.intp]
    form_std_m: float = 0.0

    task: ClassVar[str] = "positioner-planes"
    object: ClassVar[str] = "part"

    def arrays(self) -> Mapping[str, tuple[Any, tuple[int | None, ...]]]:
        return {**super().arrays(), "face_index": (self.face_index, (checks.rows_of(self.points_m),))}

    def indices(self) -> Mapping[str, tuple[Any, int]]:
        return {**super().indices(), "face_index": (self.face_index, len(self.faces))}

    def target(self) -> Surfaces | Markers:
        return Surfaces(face_features(self.faces, self.form_std_m), self.face_index)

    def with_object_priors(self, belief: Belief) -> Belief:
        return with_form(super().with_object_priors(belief), self.faces, self.form_std_m)

    def check_object(self) -> list[Finding]:
        normals = np.array([face.axis for face in self.faces])
        return super().check_object() + checks.normals(normals, self.face_index)

    def relabelled(self) -> list[tuple[Finding, SensorTask]]:
        names = [face.name for face in self.faces]
        pairs = exchanged(self.face_index, names)
        return [(finding, replace(self, face_index=index)) for finding, index in pairs]

    def seen_markers(self) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
        normal = np.array([face.axis for face in self.faces])[self.face_index]
        point = np.array([face.point_m for face in self.faces])[self.face_index]
        offset = np.einsum("mi,mi->m", normal, point) + self.ball_radius_m
        poses, placed = objects(self.points_m, self.pose_index, len(self.motion), normal, offset)
        _require(len(poses), "six or more points on three faces")
        corners = _corners()
        base_p = np.einsum("kij,nj->kni", placed[:, :3, :3], corners) + placed[:, None, :3, 3]
        index = np.tile(np.arange(len(corners)), len(poses))
        return np.repeat(self.angles[poses], len(corners), axis=0), base_p.reshape(-1, 3), index

    def of_markers(self, axes: list[FloatArray], table_p: FloatArray) -> dict[str, Value]:
        return {self.object: Transform("table", self.object, _fitted(_corners(), table_p))}


def _require(poses: int, what: str) -> None:
    if poses < _FEWEST_POSES:
        raise DegenerateGeometry(
            f"{poses} poses of the table have {what}", f"Measure {_FEWEST_POSES} poses or more so"
        )


def _corners() -> FloatArray:
    return _ARM_M * np.vstack([np.zeros(3), np.eye(3)])


def _fitted(object_p: FloatArray, table_p: FloatArray) -> FloatArray:
    """table_T_object (4, 4) from points in both."""
    pose = np.eye(4)
    middle, there = object_p.mean(axis=0), table_p.mean(axis=0)
    pose[:3, :3] = starts.nearest_rotation((table_p - there).T @ (object_p - middle))
    pose[:3, 3] = there - pose[:3, :3] @ middle
    return pose
