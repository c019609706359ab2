"""Forward kinematics of a serial arm, and its derivatives with respect to joints and geometry."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation.errors import EstimationError
from estimation.transform import FloatArray, skew

PARAMETER_NAMES: Final = ("theta", "d", "a", "alpha", "beta")
_NEARLY_PARALLEL_RAD: Final = np.radians(5.0)  # d and theta of a common normal are ill defined below
_AXIS_OF: Final = {"theta": 0, "d": 0, "a": 1, "alpha": 1, "beta": 2}  # z, x or y


@dataclass(frozen=True, eq=False)  # == on arrays is ambiguous
class ArmModel:
    """A serial arm of n revolute joints; link i is Rz(theta_i + q_i) Tz(d_i) Tx(a_i) Rx(alpha_i) Ry(beta_i).

    `base_T_flange` is the product of the links, first to last. beta is Hayati's extra twist for
    (nearly) parallel axes, where d and theta of the common normal are ill defined.

    Attributes
    ----------
    theta, alpha, beta : (n,), radians.
    d, a : (n,), metres.
    lower_rad, upper_rad : (n,), joint limits.
    free : The k parameters that are uncertain, each as (joint index from 0, one of PARAMETER_NAMES).

    Source: Sallinen (2003), eq. (56-61), which are inverse links (ESTIMATION.md, errata); with Hayati's beta.
    """

    theta: FloatArray
    d: FloatArray
    a: FloatArray
    alpha: FloatArray
    beta: FloatArray
    lower_rad: FloatArray
    upper_rad: FloatArray
    free: tuple[tuple[int, str], ...] = ()
    _tails: FloatArray = field(init=False, repr=False)  # (n, 4, 4): each link after its Rz
    # for the columns of the Jacobians, joints then free parameters: which axis, and a point on it
    _axis_index: NDArray[np.intp] = field(init=False, repr=False)  # into z, x, y axes of all links
    _point_index: NDArray[np.intp] = field(init=False, repr=False)  # into frames, base to flange
    _lengths: NDArray[np.intp] = field(init=False, repr=False)  # columns that move without turning

    def __post_init__(self) -> None:
        for name in (*PARAMETER_NAMES, "lower_rad", "upper_rad"):
            values = np.array(getattr(self, name), dtype=np.float64)  # a copy: the caller's stays its own
            if values.shape != (len(self.theta),):
                raise EstimationError(
                    f"Arm with {len(self.theta)} values of theta, but {name} has shape {values.shape}",
                    "Give one value per joint",
                )
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        if not np.all(self.lower_rad < self.upper_rad):
            joint = int(np.argmin(self.lower_rad < self.upper_rad))
            raise EstimationError(
                f"Joint {joint + 1} runs from {self.lower_rad[joint]:.4f} to {self.upper_rad[joint]:.4f} rad",
                "Give the lower limit first",
            )
        for joint, name in self.free:
            if name not in PARAMETER_NAMES or not 0 <= joint < self.joint_count:
                raise EstimationError(
                    f"Unknown kinematic parameter {name!r} of joint {joint + 1}",
                    f"Name one of {', '.join(PARAMETER_NAMES)} of joints 1 to {self.joint_count}",
                )
        object.__setattr__(self, "_tails", self._link_tails())
        n = self.joint_count
        axes = [*range(n), *(joint + n * _AXIS_OF[name] for joint, name in self.free)]
        # theta turns about an axis through the start of its link, alpha and beta through the end
        points = [*range(n), *(joint + (name != "theta") for joint, name in self.free)]
        lengths = [n + column for column, (_, name) in enumerate(self.free) if name in ("d", "a")]
        for key, index in (("_axis_index", axes), ("_point_index", points), ("_lengths", lengths)):
            object.__setattr__(self, key, np.array(index, dtype=np.intp))

    @staticmethod
    def from_dh(
        theta: ArrayLike,
        d: ArrayLike,
        a: ArrayLike,
        alpha: ArrayLike,
        beta: ArrayLike | None = None,
        lower_rad: ArrayLike | None = None,
        upper_rad: ArrayLike | None = None,
        free: Sequence[tuple[int, str]] = (),
    ) -> "ArmModel":
        """Build from any sequences; beta is 0 and limits are -pi to pi unless given."""
        zero = np.zeros(len(np.asarray(theta)))
        return ArmModel(
            theta=np.asarray(theta, dtype=np.float64),
            d=np.asarray(d, dtype=np.float64),
            a=np.asarray(a, dtype=np.float64),
            alpha=np.asarray(alpha, dtype=np.float64),
            beta=zero if beta is None else np.asarray(beta, dtype=np.float64),
            lower_rad=zero - np.pi if lower_rad is None else np.asarray(lower_rad, dtype=np.float64),
            upper_rad=zero + np.pi if upper_rad is None else np.asarray(upper_rad, dtype=np.float64),
            free=tuple(free),
        )

    @property
    def joint_count(self) -> int:
        """n."""
        return len(self.theta)

    @property
    def parameter_labels(self) -> tuple[str, ...]:
        """Names of the free parameters in order, joints counted from 1: ("a1", "alpha1", "theta2", ...)."""
        return tuple(f"{name}{joint + 1}" for joint, name in self.free)

    @property
    def parallel_to_next(self) -> NDArray[np.bool_]:
        """(n,) whether the axis of a joint is within 5 deg of parallel to the next; False for the last."""
        along = np.abs(np.cos(self.alpha) * np.cos(self.beta)) > np.cos(_NEARLY_PARALLEL_RAD)
        return np.asarray(along & (np.arange(self.joint_count) < self.joint_count - 1))

    @property
    def every_parameter(self) -> tuple[tuple[int, str], ...]:
        """All that may be calibrated: theta, d, a, alpha of each link, and beta where axes are parallel."""
        return tuple(
            (joint, name)
            for joint, parallel in enumerate(self.parallel_to_next.tolist())
            for name in PARAMETER_NAMES
            if name != "beta" or parallel
        )

    def with_deviation(self, delta: ArrayLike) -> "ArmModel":
        """The arm with `delta` (k,) added to its free parameters; metres or radians as each has."""
        deltas = np.asarray(delta, dtype=np.float64)
        if deltas.shape != (len(self.free),):
            raise EstimationError(
                f"Deviation of shape {deltas.shape} for {len(self.free)} free kinematic parameters",
                "Give one value per free parameter",
            )
        changed = {name: getattr(self, name).copy() for name in PARAMETER_NAMES}
        for (joint, name), value in zip(self.free, deltas, strict=True):
            changed[name][joint] += value
        return replace(self, **changed)

    def flange_pose(self, q: ArrayLike) -> FloatArray:
        """base_T_flange (m, 4, 4) at joint angles q (m, n), radians; one pose (n,) gives (4, 4)."""
        joints = np.asarray(q, dtype=np.float64)
        pose = self._links(np.atleast_2d(joints))
        product = pose[:, 0]
        for joint in range(1, self.joint_count):
            product = product @ pose[:, joint]
        return product if joints.ndim == 2 else product[0]

    def link_frames(self, q: FloatArray) -> FloatArray:
        """base_T_link (m, n + 1, 4, 4) at joint angles q (m, n), rad: base, then each link's end.

        Joint i turns about z of frame i; the last frame is the flange.
        """
        links, n = self._links(q), self.joint_count
        frames = np.empty((len(q), n + 1, 4, 4))
        frames[:, 0] = np.eye(4)
        for joint in range(n):
            np.matmul(frames[:, joint], links[:, joint], out=frames[:, joint + 1])
        return frames

    def jacobians(self, q: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Pose and its first derivatives, as body twists [t; phi] in the flange frame (form A).

        T(q + dq, p + dp) = T(q, p) dH(joint @ dq + parameter @ dp), to first order.

        Parameters
        ----------
        q : (m, n), radians.

        Returns
        -------
        base_T_flange (m, 4, 4); joint (m, 6, n), per radian; parameter (m, 6, k), per metre or radian.

        Source: geometric Jacobian, as used by Sallinen (2003), eq. (84-86).
        """
        joints = np.atleast_2d(np.asarray(q, dtype=np.float64))
        frames, n = self.link_frames(joints), self.joint_count
        flange = frames[:, n]
        # x of a link after its joint rotation: the axis of a and alpha
        angle = (joints + self.theta)[..., None]
        x_axes = np.cos(angle) * frames[:, :n, :3, 0] + np.sin(angle) * frames[:, :n, :3, 1]
        every_axis = np.concatenate([frames[:, :n, :3, 2], x_axes, frames[:, 1:, :3, 1]], axis=1)
        axes = every_axis[:, self._axis_index]
        points = frames[:, :, :3, 3][:, self._point_index]

        # rows of `axes @ R` are R^T axis: seen from the flange
        turn = axes @ flange[:, :3, :3]
        arm = (flange[:, None, :3, 3] - points) @ flange[:, :3, :3]
        tx, ty, tz = turn[..., 0], turn[..., 1], turn[..., 2]
        rx, ry, rz = arm[..., 0], arm[..., 1], arm[..., 2]
        twists = np.empty((len(joints), 6, n + len(self.free)))
        twists[:, 0] = ty * rz - tz * ry
        twists[:, 1] = tz * rx - tx * rz
        twists[:, 2] = tx * ry - ty * rx
        twists[:, 3:] = turn.swapaxes(1, 2)
        if len(self._lengths):
            twists[:, :3, self._lengths] = twists[:, 3:, self._lengths]
            twists[:, 3:, self._lengths] = 0.0
        return flange, twists[:, :, :n], twists[:, :, n:]

    def tool_covariance(
        self, q: ArrayLike, joint_sigma_rad: ArrayLike, flange_T_tool: FloatArray | None = None
    ) -> FloatArray:
        """Covariance (m, 6, 6) of the tool pose from independent joint noise; form A, [t; phi], tool frame.

        Parameters
        ----------
        q : (m, n), radians.
        joint_sigma_rad : (n,) or (m, n), standard deviation of each joint.
        flange_T_tool : (4, 4), metres; the flange itself unless given.

        Source: Sallinen (2003), eq. (84-86): P = J diag(sigma^2) J^T, J in the tool frame.
        """
        jacobian = self.jacobians(q)[1]
        if flange_T_tool is not None:
            rotation_t = flange_T_tool[:3, :3].T
            to_tool = np.zeros((6, 6))
            to_tool[:3, :3] = to_tool[3:, 3:] = rotation_t
            to_tool[:3, 3:] = -rotation_t @ skew(flange_T_tool[:3, 3])
            jacobian = to_tool @ jacobian
        scaled = jacobian * np.asarray(joint_sigma_rad, dtype=np.float64)[..., None, :]
        return scaled @ scaled.swapaxes(-1, -2)

    def within_limits(self, q: ArrayLike, margin_rad: float = 0.0) -> NDArray[np.bool_]:
        """Whether joint angles q (..., n) stay inside all limits by `margin_rad`; shape (...)."""
        joints = np.asarray(q, dtype=np.float64)
        inside = (joints >= self.lower_rad + margin_rad) & (joints <= self.upper_rad - margin_rad)
        return np.asarray(inside.all(axis=-1))

    def _links(self, q: FloatArray) -> FloatArray:
        """Link transforms (m, n, 4, 4)."""
        angle = q + self.theta
        cos, sin = np.cos(angle)[..., None], np.sin(angle)[..., None]
        links = np.empty((*angle.shape, 4, 4))
        links[..., 0, :] = cos * self._tails[:, 0] - sin * self._tails[:, 1]
        links[..., 1, :] = sin * self._tails[:, 0] + cos * self._tails[:, 1]
        links[..., 2:, :] = self._tails[:, 2:]
        return links

    def _link_tails(self) -> FloatArray:
        """Tz(d) Tx(a) Rx(alpha) Ry(beta), (n, 4, 4)."""
        cos_a, sin_a = np.cos(self.alpha), np.sin(self.alpha)
        cos_b, sin_b = np.cos(self.beta), np.sin(self.beta)
        zero, one = np.zeros_like(self.d), np.ones_like(self.d)
        rows = [
            [cos_b, zero, sin_b, self.a],
            [sin_a * sin_b, cos_a, -sin_a * cos_b, zero],
            [-cos_a * sin_b, sin_a, cos_a * cos_b, self.d],
            [zero, zero, zero, one],
        ]
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
