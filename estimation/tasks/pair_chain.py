"""One loop that closes at each measurement, Y^-1 A X B = I: six rows, whitened by both noises."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimation.belief import POSE_FREEDOMS, Belief, Value
from estimation.covariance import adjoint
from estimation.model import Rows, pose_of, values_of, vector_of
from estimation.tasks import checks, closed_forms
from estimation.tasks.chain import SENSOR_NOISE, as_twists, behind, moved_poses, whitening
from estimation.tasks.closed_forms import inverse
from estimation.tasks.findings import Finding
from estimation.tasks.motion import Flange, Motion
from estimation.transform import FloatArray, skew

POSE_ERRORS: Final = "pose errors"


@dataclass(frozen=True, slots=True, eq=False)
class Moves:
    """Moves first_T_second of a motion, as a motion: `Flange` of each pair (m,) of indices of its poses.

    Moves that share poses share their errors: block "pose errors", 6 for each pose.
    """

    motion: Motion
    first: NDArray[np.intp]
    second: NDArray[np.intp]

    @property
    def noise(self) -> str:
        return self.motion.noise

    def __len__(self) -> int:
        return len(self.first)

    def with_priors(self, belief: Belief) -> Belief:
        """The blocks of the motion, and the errors of its poses where several moves have them."""
        belief = self.motion.with_priors(belief)
        if len(np.unique([self.first, self.second])) == 2 * len(self):
            return belief
        noise = self.motion.at(values_of(belief)).covariance
        if not noise.any():
            return belief
        count = len(self.motion)
        covariance = np.zeros((count, 6, count, 6))
        covariance[np.arange(count), :, np.arange(count)] = noise
        return belief.with_block(
            POSE_ERRORS,
            np.zeros(6 * count),
            covariance=covariance.reshape(6 * count, 6 * count),
            freedoms=[f"{freedom}{i + 1}" for i in range(count) for freedom in POSE_FREEDOMS],
            source=self.noise,
        )

    def at(self, values: Mapping[str, Value]) -> Flange:
        flange = self.motion.at(values)
        pose, jacobian, covariance = flange.pose, dict(flange.jacobian), flange.covariance
        if POSE_ERRORS in values:
            shift = vector_of(values, POSE_ERRORS).reshape(-1, 6)
            jacobian = behind(jacobian, shift)
            every = np.zeros((len(pose), 6, len(pose), 6))
            every[np.arange(len(pose)), :, np.arange(len(pose))] = as_twists(shift)
            jacobian[POSE_ERRORS] = every.reshape(len(pose), 6, -1)
            pose, covariance = moved_poses(pose, shift), np.zeros_like(covariance)
        first, second = self.first, self.second
        move = closed_forms.moves(pose, (first, second))
        back = adjoint(inverse(move))
        return Flange(
            move,
            {name: matrix[second] - back @ matrix[first] for name, matrix in jacobian.items()},
            covariance[second] + back @ covariance[first] @ back.swapaxes(-1, -2),
        )

    def check(self) -> Sequence[Finding]:
        count = len(self.motion)
        numbers: dict[str, tuple[Any, checks.Shape]] = {
            "first": (self.first, (None,)),
            "second": (self.second, (checks.rows_of(self.first),)),
        }
        return checks.first_of(
            lambda: list(self.motion.check()),
            lambda: checks.numbers(numbers),
            lambda: checks.indices({"first": (self.first, count), "second": (self.second, count)}),
        )

    def mistakes(self) -> Sequence[tuple[Finding, Motion]]:
        return [(finding, replace(self, motion=motion)) for finding, motion in self.motion.mistakes()]

    @property
    def keys(self) -> FloatArray:
        return np.column_stack([self.motion.keys[self.first], self.motion.keys[self.second]])


@dataclass(frozen=True, slots=True, eq=False)
class PairChain:
    """Six rows a pair, Log(Y^-1 A X B) = [t; phi], whitened by both noises and scaled to metres.

    Attributes
    ----------
    motion : A, base_T_flange (inverted if `beside`), or moves of the flange.
    closing, covariance : B (k, 4, 4) and its noise (k, 6, 6), form A, m and rad.
    sensor, object : blocks of X and Y; the same name for moves.
    """

    motion: Motion
    closing: FloatArray
    covariance: FloatArray
    sensor: str
    object: str
    beside: bool = False
    whitener: tuple[FloatArray, FloatArray] | None = None  # (k, 6, 6), (k, 6) share of the pose

    def __len__(self) -> int:
        return 6 * len(self.closing)

    def weighed_at(self, values: Mapping[str, Value]) -> "PairChain":
        """Keeps the whitening that it has here."""
        free = replace(self, whitener=None)  # not what it was given before
        return replace(self, whitener=free._rows(values)[1])

    def rows(self, values: Mapping[str, Value]) -> Rows:
        """Residuals and derivatives. Raises EstimationError when a block is missing."""
        return self._rows(values)[0]

    def _rows(self, values: Mapping[str, Value]) -> tuple[Rows, tuple[FloatArray, FloatArray]]:
        flange = self.motion.at(values)
        arm = inverse(flange.pose) if self.beside else flange.pose
        end = pose_of(values, self.sensor).matrix @ self.closing
        gap = inverse(pose_of(values, self.object).matrix) @ arm @ end
        turn = Rotation.from_matrix(gap[:, :3, :3]).as_rotvec()
        by_gap = _log_gradient(gap[:, :3, :3], turn)  # of the residual, by a twist in the frame where it ends
        by_arm = by_gap @ (-adjoint(inverse(arm @ end)) if self.beside else adjoint(inverse(end)))
        jacobian = {name: by_arm @ matrix for name, matrix in flange.jacobian.items()}
        jacobian[self.object] = -by_gap @ adjoint(inverse(gap))
        by_sensor = by_gap @ adjoint(inverse(self.closing))
        same = self.sensor == self.object
        jacobian[self.sensor] = by_sensor + jacobian[self.object] if same else by_sensor
        moved = by_arm @ flange.covariance @ by_arm.swapaxes(-1, -2)
        own = by_gap @ self.covariance @ by_gap.swapaxes(-1, -2)
        size = float(np.median(np.trace(self.covariance[:, :3, :3], axis1=1, axis2=2))) / 3.0
        white, share = self.whitener or whitening(moved, own, size)
        residual = np.einsum("kij,kj->ki", white, np.column_stack([gap[:, :3, 3], turn])).reshape(-1)
        noise = {
            self.motion.noise: (size * share).reshape(-1),
            SENSOR_NOISE: (size * (1.0 - share)).reshape(-1),
        }
        stacked = {name: (white @ matrix).reshape(len(self), -1) for name, matrix in jacobian.items()}
        return Rows(residual, stacked, noise, group=6), (white, share)


def _log_gradient(rotation: FloatArray, turn: FloatArray) -> FloatArray:
    """Derivatives (k, 6, 6) of [t; phi] of poses by right twists of them, turn = Log(rotation) (k, 3)."""
    angle = np.maximum(np.linalg.norm(turn, axis=1), 1e-4)[:, None, None]
    cross = skew(turn)
    gradient = np.zeros((len(turn), 6, 6))
    gradient[:, :3, :3] = rotation
    bend = (1.0 - 0.5 * angle / np.tan(0.5 * angle)) / angle**2
    gradient[:, 3:, 3:] = np.eye(3) + 0.5 * cross + bend * (cross @ cross)
    return gradient
