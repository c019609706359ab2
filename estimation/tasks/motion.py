"""Where the flange was: as poses that a controller or tracker reports, or as joints of an arm."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation.belief import Belief, Value
from estimation.kinematics import ArmModel
from estimation.loads import GravityLoad
from estimation.model import vector_of
from estimation.tasks import checks
from estimation.tasks.findings import Cause, Finding
from estimation.tasks.mistakes import other_units
from estimation.transform import FloatArray

KINEMATICS: Final = "kinematics"
COMPLIANCE: Final = "compliance"


@dataclass(frozen=True, slots=True, eq=False)
class Flange:
    """Poses base_T_flange (k, 4, 4); all errors are body twists [t; phi] of the flange (form A).

    `jacobian[block]` is (k, 6, w); `covariance` (k, 6, 6) is the noise of each pose, m and rad.
    """

    pose: FloatArray
    jacobian: Mapping[str, FloatArray]
    covariance: FloatArray


class Motion(Protocol):
    """A sequence of flange poses."""

    @property
    def noise(self) -> str:
        """Label of the pose noise in the budget."""

    def __len__(self) -> int:
        """Number of poses k."""

    def with_priors(self, belief: Belief) -> Belief:
        """The belief with the blocks that the poses depend on."""

    def at(self, values: Mapping[str, Value]) -> Flange:
        """Poses at these values of the blocks."""

    def check(self) -> Sequence[Finding]:
        """What is wrong with the numbers at sight."""

    def mistakes(self) -> Sequence[tuple[Finding, "Motion"]]:
        """Mistakes that people make with such numbers, and the same motion with each undone."""

    @property
    def keys(self) -> FloatArray:
        """(k, c) the numbers as given: poses with equal rows are copies."""


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Flange poses as reported, each with independent noise.

    Attributes
    ----------
    base_T_flange : (k, 4, 4), metres.
    std_m, std_rad : of each axis of the flange; or `covariance` (6, 6) or (k, 6, 6), form A, instead.
    """

    base_T_flange: FloatArray
    std_m: float = 0.0
    std_rad: float = 0.0
    covariance: FloatArray | None = None

    @property
    def noise(self) -> str:
        return "pose noise"

    def __len__(self) -> int:
        return len(self.base_T_flange)

    def with_priors(self, belief: Belief) -> Belief:
        """Nothing: reported poses depend on no parameters."""
        return belief

    def at(self, values: Mapping[str, Value]) -> Flange:
        covariance = np.zeros((len(self), 6, 6))
        if self.covariance is not None:
            covariance[:] = self.covariance
        else:
            diagonal = np.einsum("kii->ki", covariance)
            diagonal[:, :3], diagonal[:, 3:] = self.std_m**2, self.std_rad**2
        return Flange(self.base_T_flange, {}, covariance)

    def check(self) -> Sequence[Finding]:
        poses = {"base_T_flange": self.base_T_flange}
        return checks.first_of(
            lambda: checks.numbers({"base_T_flange": (self.base_T_flange, (None, 4, 4))}),
            lambda: checks.deviations({"std_m of poses": self.std_m, "std_rad of poses": self.std_rad}),
            lambda: checks.transforms(poses),
            lambda: checks.lengths({name: matrix[:, :3, 3] for name, matrix in poses.items()}),
        )

    def mistakes(self) -> Sequence[tuple[Finding, Motion]]:
        inverse = replace(self, base_T_flange=np.asarray(np.linalg.inv(self.base_T_flange)))
        found: list[tuple[Finding, Motion]] = [
            (
                Finding(
                    Cause.INVERTED,
                    "The poses fit when each is inverted: they are flange_T_base, not base_T_flange",
                    "Give base_T_flange",
                ),
                inverse,
            )
        ]
        for finding, factor in other_units("The poses fit when"):
            scaled = self.base_T_flange.copy()
            scaled[:, :3, 3] /= factor
            found.append((finding, replace(self, base_T_flange=scaled)))
        return found

    @property
    def keys(self) -> FloatArray:
        return self.base_T_flange.reshape(len(self), 16)


@dataclass(frozen=True, slots=True, eq=False)
class Joints:
    """Joint angles of an arm, each with independent noise, and what is uncertain of the arm.

    Attributes
    ----------
    joints_rad : (k, n).
    std_rad : (n,) or one number.
    kinematics_std : prior of the arm's free parameters, (p,) m or rad; infinite for those that the data
        alone shall determine; None leaves the arm as it is.
    load, compliance_std : what hangs on the joints, and prior (n,) rad/Nm of how each yields to it: the
        angle behind the encoder is joints_rad + compliance * torque, the torque that of the nominal arm.
        A joint with the prior 0 is rigid, and so are all with None.
    """

    arm: ArmModel
    joints_rad: FloatArray
    std_rad: float | FloatArray = 0.0
    kinematics_std: ArrayLike | None = None
    load: GravityLoad | None = None
    compliance_std: ArrayLike | None = None

    @property
    def noise(self) -> str:
        return "joint noise"

    def __len__(self) -> int:
        return len(self.joints_rad)

    def with_priors(self, belief: Belief) -> Belief:
        """Blocks "kinematics" and "compliance", where they are not there yet."""
        if self.kinematics_std is not None and self.arm.free and KINEMATICS not in belief:
            labels = self.arm.parameter_labels
            std = np.broadcast_to(np.asarray(self.kinematics_std, dtype=np.float64), (len(labels),))
            belief = belief.with_block(KINEMATICS, np.zeros(len(labels)), std=std, freedoms=labels)
        soft = self.soft_joints
        if len(soft) and COMPLIANCE not in belief:
            std = np.broadcast_to(np.asarray(self.compliance_std, dtype=np.float64), self.arm.joint_count)
            belief = belief.with_block(
                COMPLIANCE,
                np.zeros(len(soft)),
                std=std[soft],
                freedoms=[f"joint{i + 1}" for i in soft],
                units=["rad/Nm"] * len(soft),
            )
        return belief

    @property
    def soft_joints(self) -> NDArray[np.intp]:
        """Joints that may yield, counted from 0."""
        if self.load is None or self.compliance_std is None:
            return np.zeros(0, dtype=np.intp)
        std = np.asarray(self.compliance_std, dtype=np.float64)
        return np.flatnonzero(np.broadcast_to(std, self.arm.joint_count) > 0.0)

    def at(self, values: Mapping[str, Value]) -> Flange:
        arm, joints = self.arm, self.joints_rad
        if KINEMATICS in values:
            arm = arm.with_deviation(vector_of(values, KINEMATICS))
        torque, soft = None, self.soft_joints
        if COMPLIANCE in values and self.load is not None:
            torque = self.load.torque_nm(self.arm, self.joints_rad)[:, soft]
            joints = joints.copy()
            joints[:, soft] += vector_of(values, COMPLIANCE, len(soft)) * torque
        pose, by_joint, by_parameter = arm.jacobians(joints)
        jacobian = {}
        if KINEMATICS in values:
            jacobian[KINEMATICS] = by_parameter
        if torque is not None:
            jacobian[COMPLIANCE] = by_joint[:, :, soft] * torque[:, None, :]
        scaled = by_joint * np.broadcast_to(self.std_rad, joints.shape)[:, None, :]
        return Flange(pose, jacobian, scaled @ scaled.swapaxes(-1, -2))

    def check(self) -> Sequence[Finding]:
        arrays = {"joints_rad": (self.joints_rad, (None, self.arm.joint_count))}
        return checks.first_of(
            lambda: checks.numbers(arrays),
            lambda: checks.deviations({"std_rad of joints": self.std_rad}),
            lambda: checks.angles_of_arm({"joints_rad": self.joints_rad}),
            self._check_priors,
        )

    def _check_priors(self) -> list[Finding]:
        priors = {
            "kinematics_std": (self.kinematics_std, len(self.arm.free)),
            "compliance_std": (self.compliance_std, self.arm.joint_count),
        }
        return [
            Finding(
                Cause.WRONG_SHAPE,
                f"{name} of joints is {given}",
                f"Give one number or {count}, none below zero, infinite for no prior",
            )
            for name, (given, count) in priors.items()
            if given is not None
            and not (np.shape(given) in ((), (count,)) and np.all(np.asarray(given) >= 0.0))
        ]

    def mistakes(self) -> Sequence[tuple[Finding, Motion]]:
        degrees = Finding(Cause.WRONG_UNITS, "The joints fit when taken as degrees", "Give radians")
        found: list[tuple[Finding, Motion]] = [
            (degrees, replace(self, joints_rad=np.radians(self.joints_rad)))
        ]
        for first, second in sorted(combinations(range(self.arm.joint_count), 2), key=lambda p: p[1] - p[0]):
            swapped = self.joints_rad.copy()
            swapped[:, [first, second]] = self.joints_rad[:, [second, first]]
            finding = Finding(
                Cause.SWAPPED_JOINTS,
                f"The joints fit when columns {first + 1} and {second + 1} are exchanged",
                "Check the order of the joints",
            )
            found.append((finding, replace(self, joints_rad=swapped)))
        return found

    @property
    def keys(self) -> FloatArray:
        return self.joints_rad
