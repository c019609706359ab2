"""Touch probe: where the centre of its ball is, from touches of a sphere or of faces of a part."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from estimation.belief import Belief, Value
from estimation.surfaces import Feature, sphere_features
from estimation.tasks import checks, starts
from estimation.tasks.chain import Markers, Readings, Surfaces
from estimation.tasks.findings import Cause, Finding
from estimation.tasks.mistakes import exchanged
from estimation.tasks.rolling import OnSphere
from estimation.tasks.sensing import (
    OTHER_SIZE,
    SensorTask,
    face_features,
    mislabelled,
    plane_starts,
    with_form,
)
from estimation.transform import FloatArray

_SIDES = 40  # directions in which the centre of a sphere is tried


@dataclass(frozen=True, eq=False, kw_only=True)
class Touches(SensorTask):
    """Touches, one at each pose; the ball has the radius of its certificate.

    `std_m` is the scatter of a touch along the normal; `ball_std_m` holds the ball and its pre-travel.
    """

    std_m: float
    ball_radius_m: float
    ball_std_m: float = 0.0

    sensor: ClassVar[str] = "probe"
    mount_freedoms: ClassVar[tuple[str, ...]] = ("tx", "ty", "tz")

    def readings(self) -> Readings:
        count = len(self.motion)
        covariance = np.broadcast_to(self.std_m**2 * np.eye(3), (count, 3, 3))
        return Readings(np.zeros((count, 3)), covariance, np.arange(count))

    def arrays(self) -> Mapping[str, tuple[Any, tuple[int | None, ...]]]:
        return {}

    def with_object_priors(self, belief: Belief) -> Belief:
        return belief.with_block("probe.radius", self.ball_radius_m, std=self.ball_std_m)

    def mount_grid(self) -> FloatArray:
        """A ball has no orientation."""
        return np.eye(3)[None] if self.mount is None else self.mount.rotation[None]


@dataclass(frozen=True, eq=False, kw_only=True)
class TouchOnSphere(Touches):
    """Touches on a sphere of known radius: 3 + 3 parameters."""

    radius_m: float
    radius_std_m: float = 0.0

    task: ClassVar[str] = "touch-sphere"
    object: ClassVar[str] = "sphere"

    @property
    def object_freedoms(self) -> tuple[str, ...]:
        return ("tx", "ty", "tz")

    def target(self) -> Surfaces | Markers:
        return Surfaces(sphere_features(), np.zeros(len(self.motion), dtype=np.intp))

    def with_object_priors(self, belief: Belief) -> Belief:
        return (
            super()
            .with_object_priors(belief)
            .with_block("sphere.radius", self.radius_m, std=self.radius_std_m)
        )

    def candidates(
        self, pose: FloatArray, readings: Readings, rows: NDArray[np.intp]
    ) -> list[Mapping[str, Value]]:
        reach_m = self.radius_m + self.ball_radius_m
        points, nothing = readings.points_m[rows], np.zeros((len(rows), 3))
        # Taken for one point, touches of one side are half a sphere off: its centre may be anywhere around.
        mount, holder, _ = starts.on_points(pose, points, nothing, self.mount_grid())
        around = np.concatenate([np.zeros((1, 3)), starts.directions(_SIDES)[:, :, 2]])
        holder = np.repeat(holder, len(around), axis=0)
        holder[:, :3, 3] += reach_m * around
        mount, radius = np.repeat(mount, len(around), axis=0), np.full(len(around), reach_m)
        rolled = self.rolled(pose, points, OnSphere(), mount, holder, radius)
        ball = np.array([self.ball_radius_m])
        return [{**each, "sphere.radius": each["sphere.radius"] - ball} for each in rolled]

    def explanations(self) -> Sequence[tuple[Finding, SensorTask]]:
        """Inverted poses are none: they only exchange the ball with the centre of the sphere."""
        return [each for each in super().explanations() if each[0].cause is not Cause.INVERTED]

    def relabelled(self) -> list[tuple[Finding, SensorTask]]:
        return [] if np.isinf(self.radius_std_m) else [(OTHER_SIZE, replace(self, radius_std_m=np.inf))]


@dataclass(frozen=True, eq=False, kw_only=True)
class TouchOnPlanes(Touches):
    """Touches on three or more faces of a part: 3 + 6 parameters; `face_index` (m,) names the faces."""

    faces: tuple[Feature, ...]
    face_index: NDArray[np.intp]
    form_std_m: float = 0.0

    task: ClassVar[str] = "touch-planes"
    object: ClassVar[str] = "part"

    def arrays(self) -> Mapping[str, tuple[Any, tuple[int | None, ...]]]:
        return {"face_index": (self.face_index, (len(self.motion),))}

    def target(self) -> Surfaces | Markers:
        return Surfaces(face_features(self.faces, self.form_std_m), self.face_index)

    def with_object_priors(self, belief: Belief) -> Belief:
        return with_form(super().with_object_priors(belief), self.faces, self.form_std_m)

    def candidates(
        self, pose: FloatArray, readings: Readings, rows: NDArray[np.intp]
    ) -> list[Mapping[str, Value]]:
        points, index = readings.points_m[rows], self.face_index[rows]
        return plane_starts(self, pose, points, self.faces, index, self.ball_radius_m)

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
