"""Measurement models: residuals of laser and probe observations, and derivatives by everything uncertain."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from estimation.belief import Belief, Value
from estimation.errors import EstimationError
from estimation.kinematics import ArmModel
from estimation.model import Rows, pose_of, pose_rows, values_of, vector_of
from estimation.surfaces import Feature, feature_table, signed_distance
from estimation.transform import FloatArray, Transform, skew

JOINT_NOISE: Final = "joint noise"
RANGE_NOISE: Final = "range noise"
TOUCH_NOISE: Final = "touch noise"
SURFACE: Final = "surface"


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """A batch of scalar observations of one object with one sensor.

    Attributes
    ----------
    object : the belief's pose block of the object, base_T_object.
    joints_rad, joint_variance : (m, 6), rad and rad^2; noise independent from row to row.
    reading_m : (m,) laser reading; zeros for a probe, whose reading is "the ball touches".
    reading_variance : (m,) m^2, of the reading or of the touch, along the beam or the normal.
    surface_variance : (m,) m^2, form of the surface, independent from point to point.
    features, feature_index : (m,) the feature that each row lies on.
    """

    sensor: Literal["laser", "probe"]
    object: str
    joints_rad: FloatArray
    joint_variance: FloatArray
    reading_m: FloatArray
    reading_variance: FloatArray
    surface_variance: FloatArray
    features: tuple[Feature, ...]
    feature_index: NDArray[np.intp]

    def __post_init__(self) -> None:
        rows = len(self.joints_rad)
        shapes = {
            "joint_variance": (self.joint_variance, self.joints_rad.shape),
            "reading_m": (self.reading_m, (rows,)),
            "reading_variance": (self.reading_variance, (rows,)),
            "surface_variance": (self.surface_variance, (rows,)),
            "feature_index": (self.feature_index, (rows,)),
            "joints_rad": (self.joints_rad, (rows, self.joints_rad.shape[-1])),
        }
        for name, (values, shape) in shapes.items():
            if values.shape != shape or not np.isfinite(values).all():
                raise EstimationError(
                    f"{self.sensor} observations of {self.object}: {name} has shape {values.shape}, "
                    f"expected {shape}, or holds numbers that are not finite",
                    "Leave out samples without a valid reading before estimating",
                )
        variances = (self.joint_variance, self.reading_variance, self.surface_variance)
        if any((values < 0.0).any() for values in variances):
            raise EstimationError(
                f"{self.sensor} observations of {self.object} have a negative variance", "Check the noise"
            )
        if rows and not 0 <= self.feature_index.min() <= self.feature_index.max() < len(self.features):
            raise EstimationError(
                f"feature_index up to {self.feature_index.max()} of {len(self.features)} features",
                "Pass the features that the rows were measured on",
            )

    def __len__(self) -> int:
        return len(self.joints_rad)

    def select(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> "Observations":
        """Some of the rows."""
        return Observations(
            self.sensor,
            self.object,
            self.joints_rad[rows],
            self.joint_variance[rows],
            self.reading_m[rows],
            self.reading_variance[rows],
            self.surface_variance[rows],
            self.features,
            self.feature_index[rows],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Batches measured with one arm, stacked in their order: the `Model` of a cell.

    The chain is p_object = base_T_object^-1 . base_T_flange(q; kinematics) . flange_T_sensor . p_sensor,
    the residual its signed distance to the feature (less the ball radius for a probe). Uses the blocks
    "kinematics", "laser" with "laser.scale" and "laser.offset", "probe" with "probe.radius", "bump", the
    object and the deviations of its features. Absent "kinematics", "laser.scale", "laser.offset",
    "probe.radius" and "bump" mean nominal or zero, without uncertainty.
    """

    arm: ArmModel
    observations: Sequence[Observations]

    def __len__(self) -> int:
        return sum(len(batch) for batch in self.observations)

    def weighed_at(self, values: Mapping[str, Value]) -> "Chain":
        """Itself: rows are scalar."""
        return self

    def rows(self, values: Mapping[str, Value]) -> Rows:
        """Rows at values; raises EstimationError when a pose or the block of a feature is missing."""
        observations = self.observations
        if not observations:
            return Rows(np.zeros(0), {}, {})
        actual = _actual(self.arm, values)
        # One pass through the kinematics for all batches: its cost is per call as much as per row.
        chain = actual.jacobians(np.concatenate([batch.joints_rad for batch in observations]))
        ends = np.cumsum([len(batch) for batch in observations]).tolist()
        places = [slice(end - len(batch), end) for batch, end in zip(observations, ends, strict=True)]
        parts = [
            _batch(values, (chain[0][place], chain[1][place], chain[2][place]), batch)
            for batch, place in zip(observations, places, strict=True)
        ]
        if len(parts) == 1:
            return parts[0]
        jacobian: dict[str, FloatArray] = {}
        noise: dict[str, FloatArray] = {}
        for part, place in zip(parts, places, strict=True):
            for name, matrix in part.jacobian.items():
                jacobian.setdefault(name, np.zeros((ends[-1], matrix.shape[1])))[place] = matrix
            for name, variance in part.noise.items():
                noise.setdefault(name, np.zeros(ends[-1]))[place] = variance
        return Rows(np.concatenate([part.residual_m for part in parts]), jacobian, noise)


def _batch(
    values: Mapping[str, Value], chain: tuple[FloatArray, FloatArray, FloatArray], batch: Observations
) -> Rows:
    flange, joint_twist, parameter_twist = chain
    sensor = _Sensor.of(values, batch.sensor, batch.reading_m)
    rotation = flange[:, :3, :3]
    base_p = (rotation @ sensor.flange_p[:, :, None])[:, :, 0] + flange[:, :3, 3]
    pose = pose_of(values, batch.object)
    object_p = (base_p - pose.origin_m) @ pose.rotation
    table = feature_table(batch.features)
    parameters = [vector_of(values, name, size) for name, size in table.blocks]
    distance = signed_distance(
        batch.features, batch.feature_index, object_p, np.concatenate([np.zeros(0), *parameters])
    )
    base_g = distance.gradient @ pose.rotation.T
    flange_g = (base_g[:, None, :] @ rotation)[:, 0, :]
    flange_row = pose_rows(flange_g, sensor.flange_p)
    jacobian = sensor.rows(flange_g, values)
    jacobian[batch.object] = -pose_rows(distance.gradient, object_p)
    if "kinematics" in values:
        jacobian["kinematics"] = (flange_row[:, None, :] @ parameter_twist)[:, 0, :]
    start = 0
    for name, size in table.blocks:
        jacobian[name] = distance.deviation[:, start : start + size]
        start += size
    joint_k = (flange_row[:, None, :] @ joint_twist)[:, 0, :]
    noise = {
        JOINT_NOISE: np.einsum("mj,mj->m", joint_k**2, batch.joint_variance),
        SURFACE: batch.surface_variance,
    }
    residual = distance.distance_m
    if batch.sensor == "laser":
        along = (1.0 + sensor.scale) * (flange_g @ sensor.beam)
        noise[RANGE_NOISE] = along**2 * batch.reading_variance
    else:
        noise[TOUCH_NOISE] = batch.reading_variance
        if "probe.radius" in values:
            residual = residual - vector_of(values, "probe.radius", 1)[0]
            jacobian["probe.radius"] = np.full((len(batch), 1), -1.0)
    return Rows(residual, jacobian, noise)


@dataclass(frozen=True, slots=True, eq=False)
class _Sensor:
    """Points of a sensor in frame flange: mount . bump . (0, 0, (1 + scale) reading + offset)."""

    name: str
    mount: Transform
    bumped: FloatArray  # (3, 3) rotation of the mount after the bump
    scale: float
    reading_m: FloatArray  # (m,)
    beam_p: FloatArray  # (m, 3) along the beam, before bump and mount
    sensor_p: FloatArray  # (m, 3) after the bump, frame of the mount
    flange_p: FloatArray  # (m, 3)

    @staticmethod
    def of(values: Mapping[str, Value], name: str, reading_m: FloatArray) -> "_Sensor":
        mount = pose_of(values, name)
        beam_p = np.zeros((len(reading_m), 3))
        scale, bumped, sensor_p = 0.0, mount.rotation, beam_p
        if name == "laser":
            scale = float(vector_of(values, "laser.scale", 1)[0]) if "laser.scale" in values else 0.0
            offset_m = float(vector_of(values, "laser.offset", 1)[0]) if "laser.offset" in values else 0.0
            beam_p[:, 2] = (1.0 + scale) * reading_m + offset_m
            if "bump" in values:
                bump = pose_of(values, "bump")
                bumped, sensor_p = mount.rotation @ bump.rotation, bump.points(beam_p)
        return _Sensor(name, mount, bumped, scale, reading_m, beam_p, sensor_p, mount.points(sensor_p))

    @property
    def beam(self) -> FloatArray:
        """Direction of the beam (3,) in frame flange."""
        return self.bumped[:, 2]

    def rows(self, flange_g: FloatArray, values: Mapping[str, Value]) -> dict[str, FloatArray]:
        """Derivatives (m, w) of g . p by the blocks of the sensor."""
        jacobian = {self.name: pose_rows(flange_g @ self.mount.rotation, self.sensor_p)}
        if self.name == "laser":
            along = flange_g @ self.beam
            if "bump" in values:
                jacobian["bump"] = pose_rows(flange_g @ self.bumped, self.beam_p)
            if "laser.scale" in values:
                jacobian["laser.scale"] = (along * self.reading_m)[:, None]
            if "laser.offset" in values:
                jacobian["laser.offset"] = along[:, None]
        return jacobian


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Points (k, 3) with derivatives (k, 3, n) by the state of the belief that they came from."""

    points_m: FloatArray
    jacobian: FloatArray

    def covariance(self, belief: Belief) -> FloatArray:
        """(k, 3, 3), m^2: G P G^T."""
        return self.jacobian @ belief.covariance @ np.swapaxes(self.jacobian, -1, -2)

    def budget(self, belief: Belief) -> dict[str, FloatArray]:
        """(k, 3, 3) of each source; they add up to the covariance."""
        return belief.budget(self.jacobian)


def point_jacobian(
    belief: Belief, readings_m: FloatArray, arm: ArmModel | None = None, joints_rad: FloatArray | None = None
) -> Points:
    """Points of laser readings (k,) in frame flange, or in frame base with an arm and joints (k, 6).

    Noise of the reading and of the joints is not in here: only what the belief is uncertain of.
    """
    values = values_of(belief)
    sensor = _Sensor.of(values, "laser", np.asarray(readings_m, dtype=np.float64))
    points = sensor.flange_p
    # The rows of three unit gradients are the derivative of the point.
    axes = [sensor.rows(np.broadcast_to(axis, points.shape), values) for axis in np.eye(3)]
    parts = {name: np.stack([rows[name] for rows in axes], axis=1) for name in axes[0]}
    if arm is not None and joints_rad is not None:
        actual = _actual(arm, values)
        flange, _, parameter_twist = actual.jacobians(joints_rad)
        rotation = flange[:, :3, :3]
        parts = {name: rotation @ matrix for name, matrix in parts.items()}
        if "kinematics" in values:
            parts["kinematics"] = _moved(rotation, points) @ parameter_twist
        points = np.einsum("mij,mj->mi", rotation, points) + flange[:, :3, 3]
    return Points(points, _stacked(belief, parts, len(points)))


def object_point_jacobian(belief: Belief, object: str, object_p: FloatArray) -> Points:
    """Points (k, 3) of an object, given in its frame, in frame base: V [I | -[p]x] of its freedoms."""
    pose = belief.transform(object)
    points = np.asarray(object_p, dtype=np.float64).reshape(-1, 3)
    return Points(pose.points(points), _stacked(belief, {object: _moved(pose.rotation, points)}, len(points)))


def _stacked(belief: Belief, parts: Mapping[str, FloatArray], count: int) -> FloatArray:
    dense = np.zeros((count, 3, belief.size))
    for name, matrix in parts.items():
        dense[:, :, belief.index(name)] = matrix[:, :, belief.block(name).active]
    return dense


def _moved(rotation: FloatArray, points: FloatArray) -> FloatArray:
    """d(H p)/d xi = V [I | -[p]x] (..., 3, 6) for a right perturbation of H (88)."""
    eye = np.broadcast_to(np.eye(3), (*points.shape, 3))
    moved: FloatArray = rotation @ np.concatenate([eye, -skew(points)], axis=-1)
    return moved


def _actual(arm: ArmModel, values: Mapping[str, Value]) -> ArmModel:
    return arm.with_deviation(vector_of(values, "kinematics")) if "kinematics" in values else arm
