"""One measurement model for all tasks that see points: sensor on an arm, or beside it, and an object."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimation.belief import Belief, Value
from estimation.compiling import plain_copy
from estimation.covariance import adjoint
from estimation.model import Rows, pose_of, vector_of
from estimation.surfaces import Feature, cross, feature_table, signed_distance
from estimation.tasks.motion import Motion
from estimation.tasks.plane_chain import TIER, PlaneChain
from estimation.transform import FloatArray, skew

SENSOR_NOISE: Final = "sensor noise"


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """Points that a sensor reports in its frame.

    Attributes
    ----------
    points_m : (m, 3); (0, 0, d) of a point laser, (0, y, z) of a profile laser, zeros of a touch probe.
    covariance : (m, 3, 3) of each point, m^2, independent of the others.
    pose_index : (m,) the pose of the motion at which each was taken.
    """

    points_m: FloatArray
    covariance: FloatArray
    pose_index: NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """Surfaces of the object, and the one that each reading lies on: one signed distance a reading."""

    features: tuple[Feature, ...]
    index: NDArray[np.intp]  # (m,)

    def see(self, object_p: FloatArray, values: Mapping[str, Value]) -> "Seen":
        """Distances (m, 1) with their gradients (m, 1, 3), and derivatives (m, 1, w) by feature blocks."""
        table = feature_table(self.features)
        parameters = [vector_of(values, name, size) for name, size in table.blocks]
        found = signed_distance(
            self.features, self.index, object_p, np.concatenate([np.zeros(0), *parameters])
        )
        ends = np.cumsum([size for _, size in table.blocks]).tolist()
        own = {
            name: found.deviation[:, None, end - size : end]
            for (name, size), end in zip(table.blocks, ends, strict=True)
        }
        return Seen(found.distance_m[:, None], found.gradient[:, None, :], own)


@dataclass(frozen=True, slots=True, eq=False)
class Markers:
    """Points of the object, and the one that each reading is of: three residuals a reading.

    `points_m` (n, 3) in the object; with `block`, the belief holds how they deviate, (3 n,).
    """

    points_m: FloatArray
    index: NDArray[np.intp]  # (m,)
    block: str | None = None

    def see(self, object_p: FloatArray, values: Mapping[str, Value]) -> "Seen":
        """Gaps (m, 3) from the markers to the readings, with gradients and derivatives."""
        count = len(object_p)
        markers = self.points_m
        own = {}
        if self.block is not None:
            markers = markers + vector_of(values, self.block, markers.size).reshape(-1, 3)
            moved = np.zeros((count, 3, len(markers), 3))
            moved[np.arange(count), :, self.index] = -np.eye(3)
            own[self.block] = moved.reshape(count, 3, -1)
        gradient = np.broadcast_to(np.eye(3), (count, 3, 3))
        return Seen(object_p - markers[self.index], gradient, own)


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What readings say of the object: residuals (m, k), gradients (m, k, 3), derivatives by its blocks."""

    residual_m: FloatArray
    gradient: FloatArray
    own: Mapping[str, FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class SensorChain:
    """p_object = base_T_object^-1 . base_T_flange . flange_T_sensor . p_sensor; the `Model` of most tasks.

    With `beside` the sensor stands still and the arm carries the object: the same chain with
    flange_T_base in the middle, base_T_sensor and flange_T_object at its ends.

    The point is ((1 + scale) p + offset e_z) where the belief has "<sensor>.scale" and "<sensor>.offset";
    "<sensor>.radius" is the radius of the ball of a probe. Readings that share a pose share its error: the
    block "<sensor> poses" holds it, 6 for each pose, instead of a noise that is independent row by row.

    Two sources of noise (pose and sensor) of a point are diagonalised together, so that each row keeps
    its part of either: whitening W with W (Q_pose + Q_sensor) W^T = s^2 I and W Q_pose W^T diagonal.
    """

    motion: Motion
    readings: Readings
    target: Surfaces | Markers
    sensor: str
    object: str
    beside: bool = False
    whitener: tuple[FloatArray, FloatArray] | None = None  # (m, 3, 3), (m, 3) share of the pose

    @property
    def shared(self) -> str:
        """Name of the block of pose errors, present when poses have several readings."""
        return f"{self.sensor} poses"

    @property
    def group(self) -> int:
        """Rows of one reading."""
        return 3 if isinstance(self.target, Markers) else 1

    def __len__(self) -> int:
        return self.group * len(self.readings.points_m)

    def with_priors(self, belief: Belief) -> Belief:
        """The belief with the blocks of the motion, and of the pose errors if readings share them."""
        belief = self.motion.with_priors(belief)
        index = self.readings.pose_index
        if (index[1:] > index[:-1]).all() or len(np.unique(index)) == len(index):
            return belief
        noise = self.motion.at({block.name: block.value for block in belief.blocks}).covariance
        if not noise.any():
            return belief
        count = len(self.motion)
        covariance = np.zeros((count, 6, count, 6))
        covariance[np.arange(count), :, np.arange(count), :] = noise
        return belief.with_block(
            self.shared,
            np.zeros(6 * count),
            covariance=covariance.reshape(6 * count, 6 * count),
            source=self.motion.noise,
        )

    def weighed_at(self, values: Mapping[str, Value]) -> "SensorChain":
        """Scalar rows need no whitening; points keep the one they have here."""
        if self.group == 1:
            return self
        free = replace(self, whitener=None)  # not what it was given before
        return replace(self, whitener=free._rows(values)[1])

    def compiled(self, belief: Belief, root: FloatArray) -> PlaneChain | None:
        """Rows and descent in one piece, where planes are seen and only mount and object are unknown."""
        if (
            TIER is None
            or self.beside
            or not isinstance(self.target, Surfaces)
            or belief.names != (self.sensor, self.object)
            or not (table := feature_table(self.target.features)).plane
            or table.blocks
            or not belief.size
            or not TIER.ready()
        ):
            return None
        place, index = self.readings.pose_index, self.target.index
        if not len(place) == len(index) == len(self.readings.points_m) == len(self.readings.covariance):
            return None  # the general way says what is wrong
        flange = self.motion.at({})
        normals = table.axis[index]
        # Copies, all laid out alike: each other layout, and what may only be read, would be compiled anew.
        return PlaneChain(
            root,
            (plain_copy(belief.transform(self.sensor).matrix), belief.block(self.sensor).active),
            (plain_copy(belief.transform(self.object).matrix), belief.block(self.object).active),
            plain_copy(flange.pose[place]),
            plain_copy(self.readings.points_m),
            plain_copy(normals),
            np.einsum("mi,mi->m", normals, table.point_m[index]),
            plain_copy(flange.covariance[place]),
            plain_copy(self.readings.covariance),
            (self.sensor, self.object),
            (self.motion.noise, SENSOR_NOISE),
        )

    def rows(self, values: Mapping[str, Value]) -> Rows:
        """Residuals and derivatives. Raises EstimationError when a block is missing."""
        return self._rows(values)[0]

    def _rows(self, values: Mapping[str, Value]) -> tuple[Rows, tuple[FloatArray, FloatArray] | None]:
        place = self.readings.pose_index
        flange = self.motion.at(values)
        shift = vector_of(values, self.shared).reshape(-1, 6) if self.shared in values else None
        pose = (flange.pose if shift is None else moved_poses(flange.pose, shift))[place]
        mount, holder = pose_of(values, self.sensor), pose_of(values, self.object)
        scale = (
            float(vector_of(values, f"{self.sensor}.scale", 1)[0])
            if f"{self.sensor}.scale" in values
            else 0.0
        )
        sensor_p = (1.0 + scale) * self.readings.points_m
        if f"{self.sensor}.offset" in values:
            sensor_p = sensor_p + vector_of(values, f"{self.sensor}.offset", 1) * np.array([0.0, 0.0, 1.0])
        near_p = mount.points(sensor_p)  # frame at the near end of the arm: flange, or base if beside
        rotation = pose[:, :3, :3].swapaxes(-1, -2) if self.beside else pose[:, :3, :3]
        if self.beside:
            far_p = np.einsum("mij,mj->mi", rotation, near_p - pose[:, :3, 3])
        else:
            far_p = np.einsum("mij,mj->mi", rotation, near_p) + pose[:, :3, 3]
        object_p = holder.inverse().points(far_p)
        seen = self.target.see(object_p, values)

        far_g = seen.gradient @ holder.rotation.T  # (m, k, 3)
        near_g = far_g @ rotation
        sensor_g = near_g @ mount.rotation
        by_twist = -pose_gradients(far_g, far_p) if self.beside else pose_gradients(near_g, near_p)
        jacobian = {
            self.sensor: pose_gradients(sensor_g, sensor_p),
            self.object: -pose_gradients(seen.gradient, object_p),
            **seen.own,
        }
        for name, matrix in (flange.jacobian if shift is None else behind(flange.jacobian, shift)).items():
            jacobian[name] = by_twist @ matrix[place]
        if shift is not None:
            every = np.zeros((*by_twist.shape[:2], len(self.motion), 6))
            every[np.arange(len(place)), :, place] = by_twist @ as_twists(shift)[place]
            jacobian[self.shared] = every.reshape(*by_twist.shape[:2], -1)
        if f"{self.sensor}.scale" in values:
            jacobian[f"{self.sensor}.scale"] = sensor_g @ self.readings.points_m[:, :, None]
        if f"{self.sensor}.offset" in values:
            jacobian[f"{self.sensor}.offset"] = sensor_g[:, :, 2:]
        residual = seen.residual_m
        if f"{self.sensor}.radius" in values:
            residual = residual - vector_of(values, f"{self.sensor}.radius", 1)
            jacobian[f"{self.sensor}.radius"] = np.full((*residual.shape, 1), -1.0)
        own = (1.0 + scale) ** 2 * sensor_g @ self.readings.covariance @ sensor_g.swapaxes(-1, -2)
        moved = by_twist @ flange.covariance[place] @ by_twist.swapaxes(-1, -2)
        if shift is not None:
            moved = np.zeros_like(own)
        if self.group == 1:
            noise = {self.motion.noise: moved[:, 0, 0], SENSOR_NOISE: own[:, 0, 0]}
            flat = {name: matrix[:, 0] for name, matrix in jacobian.items()}
            return Rows(residual[:, 0], flat, noise), None
        size = self._typical_variance()
        white, share = self.whitener or whitening(moved, own, size)
        noise = {
            self.motion.noise: (size * share).reshape(-1),
            SENSOR_NOISE: (size * (1.0 - share)).reshape(-1),
        }
        stacked = {name: (white @ matrix).reshape(len(self), -1) for name, matrix in jacobian.items()}
        whitened = np.einsum("mij,mj->mi", white, residual).reshape(-1)
        return Rows(whitened, stacked, noise, group=3), (white, share)

    def _typical_variance(self) -> float:
        return float(np.median(np.trace(self.readings.covariance, axis1=1, axis2=2))) / 3.0 or 1e-12


def pose_gradients(gradient: FloatArray, points: FloatArray) -> FloatArray:
    """g^T [I | -[p]x] (m, k, 6) of gradients (m, k, 3) and points (m, 3), in the perturbed frame."""
    return np.concatenate([gradient, cross(points[:, None], gradient)], axis=-1)


def moved_poses(pose: FloatArray, twist: FloatArray) -> FloatArray:
    """Poses (k, 4, 4), each with an error [t; phi] (k, 6) in its own frame."""
    moved = np.zeros((len(twist), 4, 4))
    moved[:, :3, :3] = Rotation.from_rotvec(twist[:, 3:]).as_matrix()
    moved[:, :3, 3], moved[:, 3, 3] = twist[:, :3], 1.0
    return np.asarray(pose @ moved)


def behind(jacobian: Mapping[str, FloatArray], shift: FloatArray) -> dict[str, FloatArray]:
    """Body twists (k, 6, w) of poses, as twists of the same poses after they were moved by `shift` (k, 6)."""
    moved = moved_poses(np.broadcast_to(np.eye(4), (len(shift), 4, 4)), shift)
    back = adjoint(np.asarray(np.linalg.inv(moved)))
    return {name: back @ matrix for name, matrix in jacobian.items()}


def as_twists(shift: FloatArray) -> FloatArray:
    """Body twists (k, 6, 6) at moved poses, by changes of the [t; phi] (k, 6) that moved them."""
    phi, turn = shift[:, 3:], skew(shift[:, 3:])
    angle = np.maximum(np.linalg.norm(phi, axis=1), 1e-4)[:, None, None]
    twists = np.zeros((len(shift), 6, 6))
    twists[:, :3, :3] = Rotation.from_rotvec(phi).as_matrix().swapaxes(-1, -2)
    twists[:, 3:, 3:] = (
        np.eye(3)
        - (1.0 - np.cos(angle)) / angle**2 * turn
        + (angle - np.sin(angle)) / angle**3 * (turn @ turn)
    )
    return twists


def whitening(moved: FloatArray, own: FloatArray, size: float) -> tuple[FloatArray, FloatArray]:
    """W (m, k, k) with W (moved + own) W^T = size I and W moved W^T = size diag(share); share (m, k)."""
    total = moved + own
    least = 1e-12 * np.trace(total, axis1=1, axis2=2)[:, None, None]
    inverse = np.linalg.inv(np.linalg.cholesky(total + np.maximum(least, 1e-30) * np.eye(own.shape[-1])))
    share, vectors = np.linalg.eigh(inverse @ moved @ inverse.swapaxes(-1, -2))
    white = np.sqrt(size) * vectors.swapaxes(-1, -2) @ inverse
    return white, np.clip(share, 0.0, 1.0)
