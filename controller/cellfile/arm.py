"""The arm: its geometry, and the keys that every robot has."""

from collections.abc import Sequence
from math import hypot, radians
from typing import TYPE_CHECKING, Annotated, Final

from pydantic import Field

from controller.cellfile.tables import Count, Table, Text
from controller.quantities import Angle, AngularAcceleration, AngularSpeed, Duration, Length

if TYPE_CHECKING:  # numpy only when the arm model is asked for
    from estimation.kinematics import ArmModel
    from estimation.transform import FloatArray

PARAMETER_NAMES: Final = ("theta", "d", "a", "alpha", "beta")  # the order of estimation.kinematics
SLENDERNESS: Final = 0.147  # radius over length of a forearm; PRBT 45 mm / 307 mm, others are hardly thicker
_SI_NAMES: Final = {"theta": "theta_rad", "d": "d_m", "a": "a_m", "alpha": "alpha_rad", "beta": "beta_rad"}

LinkLength = Annotated[Length, Field(ge=-5, le=5)]
LinkAngle = Annotated[Angle, Field(ge=-radians(360), le=radians(360))]
LinkLengthU = Annotated[Length, Field(ge=0, le=0.01)]
LinkAngleU = Annotated[Angle, Field(ge=0, le=radians(3))]


class Joint(Table):
    """One link: Rz(theta + q) Tz(d) Tx(a) Rx(alpha) Ry(beta). A parameter without its `_u` is fixed."""

    theta_rad: LinkAngle
    """Offset of the joint angle."""
    d_m: LinkLength
    """Distance along the joint axis."""
    a_m: LinkLength
    """Distance along x."""
    alpha_rad: LinkAngle
    """Twist about x."""
    beta_rad: LinkAngle = 0.0
    """Twist about y, for an axis parallel to the next (Hayati)."""
    theta_u_rad: LinkAngleU = 0.0
    """Standard uncertainty of theta."""
    d_u_m: LinkLengthU = 0.0
    """Standard uncertainty of d."""
    a_u_m: LinkLengthU = 0.0
    """Standard uncertainty of a."""
    alpha_u_rad: LinkAngleU = 0.0
    """Standard uncertainty of alpha."""
    beta_u_rad: LinkAngleU = 0.0
    """Standard uncertainty of beta."""
    limits_rad: tuple[LinkAngle, LinkAngle]
    """Lowest and highest joint angle."""

    def parameter(self, name: str) -> float:
        """Nominal value of one of PARAMETER_NAMES; m or rad."""
        value: float = getattr(self, _SI_NAMES[name])
        return value

    def parameter_u(self, name: str) -> float:
        """Standard uncertainty of one of PARAMETER_NAMES; m or rad, 0 if fixed."""
        stem, unit = _SI_NAMES[name].rsplit("_", 1)
        value: float = getattr(self, f"{stem}_u_{unit}")
        return value


def free_parameters(joints: Sequence[Joint]) -> tuple[tuple[int, str], ...]:
    """(joint index, parameter name) of the uncertain parameters, from the base outwards."""
    return tuple(
        (index, name)
        for index, joint in enumerate(joints)
        for name in PARAMETER_NAMES
        if joint.parameter_u(name) > 0
    )


def arm_model(joints: Sequence[Joint]) -> "ArmModel":
    """Nominal kinematics, with the uncertain parameters free."""
    import numpy as np

    from estimation.kinematics import ArmModel

    columns = {name: np.array([joint.parameter(name) for joint in joints]) for name in PARAMETER_NAMES}
    return ArmModel(
        **columns,
        lower_rad=np.array([joint.limits_rad[0] for joint in joints]),
        upper_rad=np.array([joint.limits_rad[1] for joint in joints]),
        free=free_parameters(joints),
    )


def parameter_u(joints: Sequence[Joint]) -> "FloatArray":
    """Standard uncertainty (k,) of each free parameter, in the order of `free_parameters`; m or rad."""
    import numpy as np

    return np.array([joints[index].parameter_u(name) for index, name in free_parameters(joints)])


class Arm(Table):
    """The arm, its link and its geometry."""

    driver: str
    """Which driver speaks to it."""
    model: Text
    """For the record; compared with what the robot answers, where it says its name."""
    speed_rad_s: AngularSpeed = Field(gt=0, le=radians(600))
    """Of the fastest joint in a free move."""
    acceleration_rad_s2: AngularAcceleration = Field(gt=0, le=radians(10_000))
    """Of the fastest joint in a free move."""
    in_position_rad: Angle = Field(gt=0, le=radians(1))
    """Largest distance from the target, each joint, at which a move has arrived."""
    settle_time_s: Duration = Field(ge=0, le=60)
    """Wait at standstill before the first reading."""
    joint_noise_rad: Angle = Field(ge=0, le=radians(0.5))
    """Standard deviation of one reading, each joint."""
    encoder_step_rad: Angle = Field(gt=0, le=radians(0.5))
    """Smallest step of a joint reading: one count, or the resolution of the protocol."""
    readings: Count
    """Joint readings averaged in one measurement."""
    start_joints_rad: tuple[LinkAngle, ...]
    """Where a job begins and ends."""
    forearm_radius_m: Length | None = Field(default=None, gt=0, le=0.5)
    """Of the arm between axis 3 and the wrist; by default 0.147 of that distance."""
    joints: Annotated[tuple[Joint, ...], Field(min_length=6, max_length=6)]
    """Links from the base outwards."""

    @property
    def forearm_m(self) -> float:
        """Radius of the cylinder that holds everything between axis 3 and the wrist."""
        if self.forearm_radius_m is not None:
            return self.forearm_radius_m
        return SLENDERNESS * hypot(self.joints[2].a_m, self.joints[3].d_m)

    @property
    def contact_delay_s(self) -> float:
        """How late the joints of a contact may be, by as much in every touch."""
        return 0.0

    @property
    def coarse(self) -> bool:
        """The noise of a reading is too small to spread it over several steps: averaging cannot refine it."""
        return self.joint_noise_rad < 0.5 * self.encoder_step_rad

    def free_parameters(self) -> tuple[tuple[int, str], ...]:
        """(joint index, parameter name) of the uncertain parameters, from the base outwards."""
        return free_parameters(self.joints)

    def arm_model(self) -> "ArmModel":
        """Nominal kinematics, with the uncertain parameters free."""
        return arm_model(self.joints)

    def parameter_u(self) -> "FloatArray":
        """Standard uncertainty (k,) of each free parameter, in the order of `free_parameters`; m or rad."""
        return parameter_u(self.joints)
