"""How the table of a positioner stands: turned about one axis that turns about another."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from estimation.belief import Belief, Value
from estimation.covariance import adjoint
from estimation.model import pose_of, vector_of
from estimation.tasks import checks
from estimation.tasks.closed_forms import inverse
from estimation.tasks.findings import Cause, Finding
from estimation.tasks.motion import Flange, Motion
from estimation.transform import FloatArray, Transform

AXES: Final = ("axis 1", "axis 2")  # the second is carried by the first
LINE_FREEDOMS: Final = ("tx", "ty", "rx", "ry")  # of an axis, which is z of its frame
ANGLE_ERRORS: Final = "angle errors"
_STILL_SIGMAS: Final = 6.0  # an axis whose angle changes by less stands still


@dataclass(frozen=True, slots=True, eq=False)
class Turning:
    """Angles of a positioner, each with independent noise: a motion whose unknowns are the axes.

    base_T_table = E1 E2, with E = A Rz(q) A^-1 and A the frame of an axis where all angles are zero, so that
    table and base are then one. Blocks "axis 1" and "axis 2" hold A: a point and a direction, without spin
    about it and shift along it.

    Attributes
    ----------
    angles_rad : (k, 2) of axis 1, which stands, and of axis 2, which it carries.
    std_rad : (2,) or one number.
    axes : those that turned, from 0; the others are part of base or table.
    """

    angles_rad: FloatArray
    std_rad: float | FloatArray = 0.0
    axes: tuple[int, ...] = (0, 1)

    @property
    def noise(self) -> str:
        return "angle noise"

    def __len__(self) -> int:
        return len(self.angles_rad)

    @property
    def _std_rad(self) -> FloatArray:
        return np.broadcast_to(np.asarray(self.std_rad, dtype=np.float64), (2,))

    @property
    def turns_rad(self) -> FloatArray:
        """(2,) between the smallest and the largest angle of each axis."""
        return np.asarray(np.ptp(self.angles_rad, axis=0))

    @property
    def still(self) -> tuple[int, ...]:
        """Axes that did not turn, from 0."""
        limit = np.maximum(_STILL_SIGMAS * self._std_rad, 1e-9)
        return tuple(np.flatnonzero(self.turns_rad <= limit).tolist())

    def with_priors(self, belief: Belief) -> Belief:
        """Flat blocks of the axes, and the errors of the angles."""
        for axis in self.axes:
            frame = Transform("base", AXES[axis], np.eye(4))
            belief = belief.with_block(AXES[axis], frame, std=np.inf, freedoms=LINE_FREEDOMS)
        std = self._std_rad[list(self.axes)]
        if not std.any():
            return belief
        names = [f"q{axis + 1}[{i + 1}]" for axis in self.axes for i in range(len(self))]
        return belief.with_block(
            ANGLE_ERRORS,
            np.zeros(len(names)),
            std=np.repeat(std, len(self)),
            freedoms=names,
            units=["rad"] * len(names),
            source=self.noise,
        )

    def at(self, values: Mapping[str, Value]) -> Flange:
        count = len(self)
        angles = self.angles_rad[:, list(self.axes)]
        errors = np.zeros((len(self.axes), count))
        if ANGLE_ERRORS in values:
            errors = vector_of(values, ANGLE_ERRORS, errors.size).reshape(errors.shape)
        pose = np.broadcast_to(np.eye(4), (count, 4, 4))
        jacobian: dict[str, FloatArray] = {}
        by_error = np.zeros((count, 6, len(self.axes), count))
        for place, axis in enumerate(self.axes):
            frame = pose_of(values, AXES[axis]).matrix
            turn = _about_z(angles[:, place] + errors[place])
            step = frame @ turn @ inverse(frame)
            back = adjoint(inverse(step))  # what moved before is seen from behind this axis
            jacobian = {name: back @ matrix for name, matrix in jacobian.items()}
            by_error = np.einsum("kij,kjal->kial", back, by_error)
            own = adjoint(frame)
            jacobian[AXES[axis]] = own @ (adjoint(inverse(turn)) - np.eye(6))
            by_error[np.arange(count), :, place, np.arange(count)] = own[:, 5]
            pose = pose @ step
        if ANGLE_ERRORS in values:
            jacobian[ANGLE_ERRORS] = by_error.reshape(count, 6, -1)
        return Flange(pose, jacobian, np.zeros((count, 6, 6)))

    def check(self) -> Sequence[Finding]:
        return checks.first_of(
            lambda: checks.numbers({"angles_rad": (self.angles_rad, (None, 2))}),
            self._check_std,
            lambda: checks.angles({"angles_rad": self.angles_rad}),
        )

    def _check_std(self) -> list[Finding]:
        if np.shape(self.std_rad) in ((), (2,)):
            return checks.deviations({"std_rad of angles": self.std_rad})
        return checks.numbers({"std_rad of angles": (self.std_rad, (2,))})

    def mistakes(self) -> Sequence[tuple[Finding, Motion]]:
        degrees = Finding(Cause.WRONG_UNITS, "The angles fit when taken as degrees", "Give radians")
        exchanged = Finding(
            Cause.SWAPPED_JOINTS, "The angles fit when those of the axes are exchanged", "Check their order"
        )
        return [
            (degrees, replace(self, angles_rad=np.radians(self.angles_rad))),
            (exchanged, replace(self, angles_rad=self.angles_rad[:, ::-1])),
        ]

    @property
    def keys(self) -> FloatArray:
        return self.angles_rad


def _about_z(angle_rad: FloatArray) -> FloatArray:
    """Turns (k, 4, 4) about z."""
    turn = np.tile(np.eye(4), (len(angle_rad), 1, 1))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(angle_rad)
    turn[:, 1, 0] = np.sin(angle_rad)
    turn[:, 0, 1] = -turn[:, 1, 0]
    return turn
