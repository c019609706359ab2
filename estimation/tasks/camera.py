"""Sensors that see whole points: cameras on the arm or beside it, and trackers."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from estimation.belief import POSE_FREEDOMS, Belief, Value
from estimation.tasks import checks, starts
from estimation.tasks.chain import Markers, Readings, Surfaces
from estimation.tasks.findings import Finding
from estimation.tasks.mistakes import exchanged
from estimation.tasks.rolling import OnPlanes
from estimation.tasks.sensing import SensorTask
from estimation.transform import FloatArray, Transform


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkerTask(SensorTask):
    """Markers that a sensor tells apart, each reading a point of one.

    Attributes
    ----------
    points_m : (m, 3) in the frame of the sensor.
    pose_index, marker_index : (m,) the pose at which, and the marker that, was seen.
    markers_m : (n, 3) in the frame of the object, None if they are not known (they are then estimated, in
        the frame at the far end of the arm).
    marker_std_m : certificate of each coordinate of a marker.
    """

    points_m: FloatArray
    pose_index: NDArray[np.intp]
    marker_index: NDArray[np.intp]
    markers_m: FloatArray | None = None
    marker_std_m: float = 0.0

    object: ClassVar[str] = "object"
    markers: ClassVar[str] = "markers"  # block of their positions, where these are estimated

    def covariance_of_points(self) -> FloatArray:
        """(m, 3, 3) noise of each point in the frame of the sensor, m^2."""
        raise NotImplementedError

    def check_noise(self) -> list[Finding]:
        """What is wrong with the noise as it was given."""
        raise NotImplementedError

    def _check_noise(self) -> list[Finding]:
        return checks.first_of(self.check_noise, super()._check_noise)

    @property
    def object_freedoms(self) -> tuple[str, ...]:
        """None when unknown markers are estimated where they are; no rotation of a single one."""
        if self.markers_m is None:
            return ()
        return POSE_FREEDOMS if len(self.markers_m) > 1 else POSE_FREEDOMS[:3]

    def readings(self) -> Readings:
        return Readings(self.points_m, self.covariance_of_points(), self.pose_index)

    def arrays(self) -> Mapping[str, tuple[Any, tuple[int | None, ...]]]:
        count = checks.rows_of(self.points_m)
        markers = {} if self.markers_m is None else {"markers_m": (self.markers_m, (None, 3))}
        return {
            "points_m": (self.points_m, (None, 3)),
            "pose_index": (self.pose_index, (count,)),
            "marker_index": (self.marker_index, (count,)),
            **markers,
        }

    def indices(self) -> Mapping[str, tuple[Any, int]]:
        known = {} if self.markers_m is None else {"marker_index": (self.marker_index, len(self.markers_m))}
        return {"pose_index": (self.pose_index, len(self.motion)), **known}

    def check_object(self) -> list[Finding]:
        if self.markers_m is None or len(self.markers_m) == 1:
            return []
        return checks.spread(self.markers_m[np.unique(self.marker_index)], "markers that were seen")

    def relabelled(self) -> list[tuple[Finding, SensorTask]]:
        if self.markers_m is None:
            return []
        names = [f"marker {i + 1}" for i in range(len(self.markers_m))]
        pairs = exchanged(self.marker_index, names)
        return [(finding, replace(self, marker_index=index)) for finding, index in pairs]

    def target(self) -> Surfaces | Markers:
        if self.markers_m is None:
            unknown = np.zeros((int(np.max(self.marker_index)) + 1, 3))
            return Markers(unknown, self.marker_index, self.markers)
        return Markers(self.markers_m, self.marker_index, self.markers if self.marker_std_m else None)

    def with_object_priors(self, belief: Belief) -> Belief:
        target = self.target()
        if not isinstance(target, Markers) or target.block is None:
            return belief
        std = np.inf if self.markers_m is None else self.marker_std_m
        names = [f"{axis}{i + 1}" for i in range(len(target.points_m)) for axis in "xyz"]
        return belief.with_block(self.markers, np.zeros(target.points_m.size), std=std, freedoms=names)

    def candidates(
        self, pose: FloatArray, readings: Readings, rows: NDArray[np.intp]
    ) -> list[Mapping[str, Value]]:
        points, index = readings.points_m[rows], self.marker_index[rows]
        if self.markers_m is not None:
            markers = self.markers_m[index]
            mount, holder, _ = starts.on_points(pose, points, markers, self.mount_grid())
            # A point is where three planes meet.
            planes = OnPlanes(np.tile(np.eye(3), (len(points), 1)), markers.reshape(-1))
            thrice = np.repeat(np.arange(len(points)), 3)
            return self.rolled(pose[thrice], points[thrice], planes, mount, holder)
        # Markers that are not known: the one that is seen most often finds the camera, which sees the others.
        often = index == np.argmax(np.bincount(index))
        grid, linear = self.mount_grid(), starts.on_one_point(pose[often], points[often])
        if len(grid) > 1 and linear is not None:
            grid = linear[None]
        mount, _, cost = starts.on_points(pose[often], points[often], np.zeros((int(often.sum()), 3)), grid)
        found: list[Mapping[str, Value]] = []
        for i in starts.best(cost, mount[:, :3, :3]):
            near_p = Transform("near", "sensor", mount[i]).points(points)
            far_p = np.einsum("mij,mj->mi", pose[:, :3, :3], near_p) + pose[:, :3, 3]
            count = np.maximum(np.bincount(index, minlength=int(np.max(self.marker_index)) + 1), 1)
            markers = np.column_stack(
                [np.bincount(index, far_p[:, axis], minlength=len(count)) / count for axis in range(3)]
            )
            found.append({**self.poses(mount[i], np.eye(4)), self.markers: markers.reshape(-1)})
        return found


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraHandEye(MarkerTask):
    """A camera on the arm sees markers that stand still.

    `covariance` (3, 3) or (m, 3, 3) is that of a point, m^2.
    """

    covariance: FloatArray

    task: ClassVar[str] = "camera-hand-eye"
    sensor: ClassVar[str] = "camera"

    def covariance_of_points(self) -> FloatArray:
        return np.broadcast_to(self.covariance, (len(self.points_m), 3, 3))

    def check_noise(self) -> list[Finding]:
        return checks.covariances({"covariance": (self.covariance, len(self.points_m))})


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraEyeToHand(CameraHandEye):
    """A camera beside the arm sees markers that the arm carries."""

    task: ClassVar[str] = "camera-eye-to-hand"
    beside: ClassVar[bool] = True


@dataclass(frozen=True, eq=False, kw_only=True)
class Tracker(MarkerTask):
    """A laser tracker beside the arm follows reflectors on the flange; where they sit is estimated, too.

    A point scatters by `std_m` in every direction, and by `angle_std_rad` times its distance across the
    beam, which comes from the origin of the tracker. `scale_std` is that of its wavelength (air).
    """

    std_m: float
    angle_std_rad: float = 0.0

    task: ClassVar[str] = "tracker"
    sensor: ClassVar[str] = "tracker"
    beside: ClassVar[bool] = True
    markers: ClassVar[str] = "reflectors"

    def covariance_of_points(self) -> FloatArray:
        return beam_covariance(self.points_m, self.std_m, self.angle_std_rad)

    def check_noise(self) -> list[Finding]:
        return checks.deviations({"std_m": self.std_m, "angle_std_rad": self.angle_std_rad})


def beam_covariance(points_m: FloatArray, std_m: float, angle_std_rad: float) -> FloatArray:
    """(m, 3, 3), m^2, of points (m, 3) at the end of a beam from the origin, whose direction scatters."""
    across = np.eye(3) * np.sum(points_m**2, axis=1)[:, None, None]
    across = across - points_m[:, :, None] * points_m[:, None, :]
    return np.asarray(std_m**2 * np.eye(3) + angle_std_rad**2 * across)
