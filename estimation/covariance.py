"""Algebra of pose covariances: forms, compounding, merging, and the points that they move."""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from estimation.errors import DegenerateGeometry, EstimationError, FrameMismatch
from estimation.transform import FloatArray, Transform, exp_pose, log_pose, skew

try:
    from estimation import ellipsoid_kernels as kernels
except ImportError:  # numba is optional: numpy gives the same numbers
    kernels = None  # type: ignore[assignment]

COMPILED: Final = kernels is not None
LEAST_COS_PITCH: Final = 1e-3  # form C closer than this to 90 deg of pitch is refused
_INCONSISTENT: Final = 1e-6  # negative eigenvalue, as a share of the largest, that is no longer rounding


class Form(StrEnum):
    """Where the small error d stands in an uncertain transform.

    A: H(m) H(d), error in the source frame. B: H(d) H(m), error in the target frame.
    C: H(m + d), error added to x, y, z and fixed-axis roll, pitch, yaw.

    Source: Sallinen (2003), eq. (76-78).
    """

    A = "A"
    B = "B"
    C = "C"


@dataclass(frozen=True, slots=True, eq=False)  # == on arrays is ambiguous
class PoseCovariance:
    """An uncertain transform: `pose` and the covariance (6, 6) of its error, m and rad.

    The order is three translations, then three rotations (for form C: roll, pitch, yaw).

    Raises
    ------
    EstimationError
        The matrix is not symmetric and positive semidefinite.
    """

    pose: Transform
    matrix: FloatArray
    form: Form = Form.A

    def __post_init__(self) -> None:
        matrix = np.array(self.matrix, dtype=np.float64)
        if matrix.shape != (6, 6) or not np.isfinite(matrix).all():
            raise EstimationError(
                f"Pose covariance of shape {matrix.shape}, or not finite", "Give 6 x 6 numbers"
            )
        # metres and radians have different sizes: judge the correlations
        variance = np.diag(matrix)
        scale = np.sqrt(np.where(variance > 0.0, variance, 1.0))
        correlation = matrix / np.outer(scale, scale)
        if np.abs(correlation - correlation.T).max() > _INCONSISTENT:
            raise EstimationError("Pose covariance is not symmetric", "Pass P, not its square root")
        if variance.min() < 0.0 or np.linalg.eigvalsh(correlation).min() < -_INCONSISTENT:
            raise EstimationError("Pose covariance has a negative eigenvalue", "Repeat the estimate")
        matrix = (matrix + matrix.T) / 2
        matrix.flags.writeable = False
        object.__setattr__(self, "matrix", matrix)

    @property
    def frame(self) -> str:
        """The frame whose axes the error is given in."""
        return self.pose.source if self.form is Form.A else self.pose.target

    @property
    def order(self) -> tuple[str, ...]:
        """Names of the six rows."""
        turns = ("roll", "pitch", "yaw") if self.form is Form.C else ("rx", "ry", "rz")
        return ("tx", "ty", "tz", *turns)

    def in_form(self, form: Form) -> "PoseCovariance":
        """The same uncertainty in another form.

        Raises DegenerateGeometry from or to form C near 90 deg of pitch, where roll and yaw are one rotation.
        Source: Sallinen (2003), eq. (79-83).
        """
        if form is self.form:
            return self
        matrix = self.matrix
        if self.form is Form.B:
            matrix = _sandwich(adjoint(self.pose.inverse().matrix), matrix)
        elif self.form is Form.C:
            matrix = _sandwich(_body_from_rpy(self.pose), matrix)
        if form is Form.B:
            matrix = _sandwich(adjoint(self.pose.matrix), matrix)
        elif form is Form.C:
            matrix = _sandwich(_inverse(_body_from_rpy(self.pose)), matrix)
        return PoseCovariance(self.pose, matrix, form)

    def point_covariance(self, source_p: ArrayLike, source_covariance: ArrayLike | None = None) -> FloatArray:
        """Covariance (..., 3, 3) in the target frame, m^2, of points (..., 3) fixed in the source frame.

        `source_covariance` (..., 3, 3) of the points themselves is independent of the pose.
        Source: Sallinen (2003), eq. (87-88).
        """
        points = np.asarray(source_p, dtype=np.float64)
        rotation = self.pose.rotation
        jacobian: FloatArray = np.concatenate(
            [np.broadcast_to(np.eye(3), (*points.shape, 3)), -skew(points)], axis=-1
        )
        covariance = jacobian @ self.in_form(Form.A).matrix @ jacobian.swapaxes(-1, -2)
        if source_covariance is not None:
            covariance = covariance + np.asarray(source_covariance, dtype=np.float64)
        return np.asarray(rotation @ covariance @ rotation.T)

    def second_order_share(self, source_p: ArrayLike) -> FloatArray:
        """Size (...) of the neglected curvature of points (..., 3), relative to their smallest axis.

        |p| phi^2 over the smallest principal standard deviation, phi being the largest one of the rotation.
        Well below 1 the linear covariance holds; otherwise use Monte Carlo. Infinite for a flat ellipsoid.
        """
        points = np.asarray(source_p, dtype=np.float64)
        variance = float(np.linalg.eigvalsh(self.in_form(Form.A).matrix[3:, 3:])[-1])
        smallest = ellipsoid(self.point_covariance(points)).axes[..., -1]
        sagitta = np.linalg.norm(points, axis=-1) * variance
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(sagitta == 0.0, 0.0, sagitta / smallest))

    def inverse(self) -> "PoseCovariance":
        """Of source_T_target, form A."""
        return PoseCovariance(
            self.pose.inverse(), _sandwich(adjoint(self.pose.matrix), self.in_form(Form.A).matrix)
        )


def compound(a_T_b: PoseCovariance, b_T_c: PoseCovariance, cross: ArrayLike | None = None) -> PoseCovariance:
    """a_T_c = a_T_b b_T_c, form A.

    `cross` (6, 6) is cov(error of a_T_b, error of b_T_c), both in form A; zero unless given.
    Raises FrameMismatch unless the inner frames are equal. Source: Sallinen (2003), eq. (12), and (85).
    """
    to_c = adjoint(b_T_c.pose.inverse().matrix)
    matrix = _sandwich(to_c, a_T_b.in_form(Form.A).matrix) + b_T_c.in_form(Form.A).matrix
    return PoseCovariance(a_T_b.pose @ b_T_c.pose, _with_shared(matrix, to_c @ _cross(cross)))


def relative(a_T_b: PoseCovariance, a_T_c: PoseCovariance, cross: ArrayLike | None = None) -> PoseCovariance:
    """b_T_c from two poses in one frame, form A; what they share in frame a cancels through `cross`.

    `cross` (6, 6) is cov(error of a_T_b, error of a_T_c), both in form A; zero unless given.
    Raises FrameMismatch unless both start in the same frame.
    """
    b_T_c = a_T_b.pose.inverse() @ a_T_c.pose
    to_c = adjoint(b_T_c.inverse().matrix)
    matrix = _sandwich(to_c, a_T_b.in_form(Form.A).matrix) + a_T_c.in_form(Form.A).matrix
    return PoseCovariance(b_T_c, _with_shared(matrix, -to_c @ _cross(cross)))


def merge(first: PoseCovariance, second: PoseCovariance, cross: ArrayLike | None = None) -> PoseCovariance:
    """The best estimate from two of the same transform, form A.

    `cross` (6, 6) is cov(error of first, error of second), both in form A; zero unless given.

    Raises
    ------
    FrameMismatch
        The two are not the same transform.
    EstimationError
        Together they are certain of some direction (or fully correlated in it): nothing to weigh.

    Source: Sallinen (2003), eq. (13-15), in the tangent frame of `first`.
    """
    names = [f"{each.pose.target}_T_{each.pose.source}" for each in (first, second)]
    if names[0] != names[1]:
        raise FrameMismatch(
            f"{names[0]} merged with {names[1]}",
            "Both must be the same transform; is one of them inverted?",
        )
    apart = log_pose((first.pose.inverse() @ second.pose).matrix)
    chart = np.zeros((6, 6))  # error of `second` seen in the tangent frame of `first`
    chart[:3, :3] = Rotation.from_rotvec(apart[3:]).as_matrix()
    chart[3:, 3:] = _inverse(right_jacobian(apart[3:]))
    p1 = first.in_form(Form.A).matrix
    p2 = _sandwich(chart, second.in_form(Form.A).matrix)
    shared = _cross(cross) @ chart.T
    innovation = p1 + p2 - shared - shared.T
    scale = np.sqrt(np.maximum(np.diag(innovation), 1e-300))
    if np.linalg.cond(innovation / np.outer(scale, scale)) > 1e14:
        raise EstimationError(
            "Two estimates that leave a direction without any difference in error", "Drop one of the two"
        )
    gain = (p1 - shared) @ _inverse(innovation)
    keep = np.eye(6) - gain
    matrix = _sandwich(keep, p1) + _sandwich(gain, p2)
    mixed = keep @ shared @ gain.T
    step = gain @ apart
    reset = np.zeros((6, 6))  # to the tangent frame of the result
    reset[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix().T
    reset[3:, 3:] = right_jacobian(step[3:])
    merged = Transform(first.pose.target, first.pose.source, first.pose.matrix @ exp_pose(step))
    return PoseCovariance(merged, _sandwich(reset, matrix + mixed + mixed.T))


@dataclass(frozen=True, slots=True, eq=False)
class Ellipsoid:
    """One-sigma ellipsoids, the longest axis first."""

    axes: FloatArray  # (..., m), standard deviations
    directions: FloatArray  # (..., m, m), unit vectors in columns
    volume: FloatArray  # (...), unit of the axes to the power m


def ellipsoid(covariance: ArrayLike) -> Ellipsoid:
    """Principal axes of covariances (..., m, m), as standard deviations.

    Source: Sallinen (2003), eq. (19) for the volume; its tabulated eigenvalues are such standard deviations.
    """
    matrices = np.asarray(covariance, dtype=np.float64)
    variances, directions = np.linalg.eigh(matrices)
    axes = np.sqrt(np.maximum(variances[..., ::-1], 0.0))
    size = matrices.shape[-1]
    unit_ball = math.pi ** (size / 2) / math.gamma(1 + size / 2)
    return Ellipsoid(axes, directions[..., ::-1], np.asarray(unit_ball * axes.prod(axis=-1)))


def point_axes(pose: PoseCovariance, source_p: ArrayLike) -> FloatArray:
    """Principal standard deviations (m, 3), the longest first, of points (m, 3) fixed in the source frame.

    As `ellipsoid(pose.point_covariance(source_p)).axes`, for many points: a colour on a whole part.
    """
    points = np.ascontiguousarray(source_p, dtype=np.float64)
    matrix = pose.in_form(Form.A).matrix
    if COMPILED:
        return np.asarray(kernels.point_axes(points, matrix))
    jacobian = np.concatenate([np.broadcast_to(np.eye(3), (len(points), 3, 3)), -skew(points)], axis=2)
    return ellipsoid(jacobian @ matrix @ jacobian.swapaxes(1, 2)).axes


def adjoint(matrix: FloatArray) -> FloatArray:
    """Ad(H), (..., 6, 6), of transforms (..., 4, 4): H dH(d) = dH(Ad(H) d) H to first order, d = [t; phi]."""
    rotation = matrix[..., :3, :3]
    result = np.zeros((*matrix.shape[:-2], 6, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = rotation
    result[..., :3, 3:] = skew(matrix[..., :3, 3]) @ rotation
    return result


def right_jacobian(rotation_rad: FloatArray) -> FloatArray:
    """Jr (3, 3): Exp(phi + d) = Exp(phi) Exp(Jr d), to first order."""
    angle_rad = float(np.linalg.norm(rotation_rad))
    cross = skew(rotation_rad)
    if angle_rad < 1e-3:  # the closed form cancels; the series is exact to rounding here
        first, second = 0.5 - angle_rad**2 / 24, 1 / 6 - angle_rad**2 / 120
    else:
        first = (1 - math.cos(angle_rad)) / angle_rad**2
        second = (angle_rad - math.sin(angle_rad)) / angle_rad**3
    return np.asarray(np.eye(3) - first * cross + second * cross @ cross)


def _body_from_rpy(pose: Transform) -> FloatArray:
    """Form A error (6, 6) of an error in x, y, z, roll, pitch, yaw."""
    rotation = pose.rotation
    sin_p, cos_p = -float(rotation[2, 0]), math.hypot(rotation[0, 0], rotation[1, 0])
    if cos_p < LEAST_COS_PITCH:
        pitch = math.atan2(sin_p, cos_p)
        raise DegenerateGeometry(
            f"{pose.target}_T_{pose.source} has {math.degrees(pitch):.2f} deg of pitch; in form C of its "
            "covariance, roll and yaw are one rotation there",
            "Use form A or B",
        )
    sin_r, cos_r = rotation[2, 1] / cos_p, rotation[2, 2] / cos_p
    result = np.zeros((6, 6))
    result[:3, :3] = rotation.T
    result[3:, 3:] = [[1.0, 0.0, -sin_p], [0.0, cos_r, sin_r * cos_p], [0.0, -sin_r, cos_r * cos_p]]
    return result


def _sandwich(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """J P J^T."""
    return jacobian @ covariance @ jacobian.T


def _with_shared(independent: FloatArray, shared: FloatArray) -> FloatArray:
    """independent + shared + shared^T; where they cancel, rounding below zero becomes zero."""
    variance = np.diag(independent)
    scale = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    values, vectors = np.linalg.eigh((independent + shared + shared.T) / np.outer(scale, scale))
    if values[0] < -_INCONSISTENT:
        raise EstimationError(
            f"Cross-covariance larger than the two covariances allow, eigenvalue {values[0]:.3g}",
            "Pass cov(first, second) in form A, in that order",
        )
    root = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(root @ root.T)


def _inverse(matrix: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _cross(cross: ArrayLike | None) -> FloatArray:
    return np.zeros((6, 6)) if cross is None else np.asarray(cross, dtype=np.float64)
