"""The tables of the devices: robot, laser and probe."""

from math import radians
from typing import TYPE_CHECKING, Annotated, ClassVar, Final, Literal

from pydantic import Field, StringConstraints

from controller.cellfile.tables import Count, Placement, Table, Text
from controller.quantities import (
    Angle,
    AngularAcceleration,
    AngularSpeed,
    Duration,
    Frequency,
    Length,
    Ratio,
    Speed,
)

if TYPE_CHECKING:  # numpy only when the arm model is asked for
    from estimation.kinematics import ArmModel
    from estimation.transform import FloatArray

PARAMETER_NAMES: Final = ("theta", "d", "a", "alpha", "beta")  # the order of estimation.kinematics
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


class Robot(Table):
    """The arm, its bus and its geometry."""

    driver: Literal["canopen-402"]
    """Which driver speaks to it."""
    port: Text
    """Device such as `/dev/ttyACM0`, a path relative to this file, or the interface of `socketcan`."""
    interface: Literal["slcan", "socketcan"]
    """Kind of CAN interface."""
    bitrate: Literal[50_000, 125_000, 250_000, 500_000, 1_000_000]
    """Bit/s on the bus."""
    nodes: tuple[Annotated[int, Field(ge=1, le=127)], ...]
    """CANopen node of each joint, from the base outwards."""
    model: Text
    """What the drives say they are."""
    sync_period_s: Duration = Field(ge=0.001, le=1)
    """Time between two SYNC messages; one joint reading each."""
    cruise_sync_period_s: Duration = Field(0.05, ge=0.001, le=0.06)
    """The same far from the end of a free move, where less must be seen; at least `sync_period`."""
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
    """Angle of one count."""
    readings: Count
    """Joint readings averaged in one measurement."""
    start_joints_rad: tuple[LinkAngle, ...]
    """Where a job begins and ends."""
    joints: Annotated[tuple[Joint, ...], Field(min_length=6, max_length=6)]
    """Links from the base outwards."""

    def free_parameters(self) -> tuple[tuple[int, str], ...]:
        """(joint index, parameter name) of the uncertain parameters, from the base outwards."""
        return tuple(
            (index, name)
            for index, joint in enumerate(self.joints)
            for name in PARAMETER_NAMES
            if joint.parameter_u(name) > 0
        )

    def arm_model(self) -> "ArmModel":
        """Nominal kinematics, with the uncertain parameters free."""
        import numpy as np

        from estimation.kinematics import ArmModel

        columns = {
            name: np.array([joint.parameter(name) for joint in self.joints]) for name in PARAMETER_NAMES
        }
        return ArmModel(
            **columns,
            lower_rad=np.array([joint.limits_rad[0] for joint in self.joints]),
            upper_rad=np.array([joint.limits_rad[1] for joint in self.joints]),
            free=self.free_parameters(),
        )

    def parameter_u(self) -> "FloatArray":
        """Standard uncertainty (k,) of each free parameter, in the order of `free_parameters`; m or rad."""
        import numpy as np

        return np.array([self.joints[index].parameter_u(name) for index, name in self.free_parameters()])


class LaserMount(Placement):
    """flange_T_laser; the beam runs along +z."""

    FRAME: ClassVar[str] = "laser"
    PARENT: ClassVar[str] = "flange"


class Laser(Table):
    """The distance laser."""

    driver: Literal["optoncdt-1420"]
    """Which driver speaks to it."""
    port: Text
    """Device such as `/dev/ttyUSB0`, or a path relative to this file."""
    baud: Literal[9600, 19200, 56000, 115200, 128000, 230400, 256000, 460800, 691200, 921600, 1_000_000]
    """Baud rate of the line."""
    model: Text
    """Compared with what the laser answers."""
    serial_number: Annotated[str, StringConstraints(pattern=r"^[0-9]+$", max_length=20)]
    """Compared with what the laser answers."""
    rate_hz: Frequency = Field(gt=0, le=8000)
    """Measuring cycles per second."""
    range_start_m: Length = Field(ge=0, le=5)
    """Distance of reading zero."""
    range_m: Length = Field(gt=0, le=5)
    """Length of the measuring range."""
    working_range_m: tuple[Length, Length]
    """Shortest and longest distance to use; enforced on every sample."""
    max_incidence_rad: Angle = Field(gt=0, lt=radians(90))
    """Largest angle between beam and surface normal."""
    noise_m: Length = Field(gt=0, le=0.01)
    """Standard deviation per measured point (surface, speckle); waiting does not average it."""
    reading_noise_m: Length = Field(ge=0, le=0.01)
    """Standard deviation of one cycle; averaged over a measurement."""
    scale_u: Ratio = Field(ge=0, le=0.1)
    """Standard uncertainty of the scale."""
    offset_u_m: Length = Field(ge=0, le=0.01)
    """Standard uncertainty of the zero."""
    mount: LaserMount
    """Where the laser sits on the flange."""


class ProbeMount(Placement):
    """flange_T_probe; the origin is the ball centre."""

    FRAME: ClassVar[str] = "probe"
    PARENT: ClassVar[str] = "flange"


class Probe(Table):
    """The touch-trigger probe and the remote input that counts its contacts."""

    driver: Literal["adam-6052"]
    """Which driver speaks to it."""
    host: Annotated[
        str, StringConstraints(pattern=r"^[A-Za-z0-9]([A-Za-z0-9.:-]*[A-Za-z0-9])?$", max_length=253)
    ]
    """Name or address of the module."""
    port: int = Field(default=502, ge=1, le=65535)
    """TCP port of the module."""
    model: Text
    """Compared with what the module answers."""
    channel: int = Field(ge=0, le=7)
    """Input that the probe is wired to."""
    poll_period_s: Duration = Field(gt=0, le=1)
    """Time between two polls during a touch."""
    ball_radius_m: Length = Field(gt=0, le=0.05)
    """Radius of the stylus ball."""
    ball_radius_u_m: Length = Field(ge=0, le=0.001)
    """Standard uncertainty of the ball radius, with pre-travel."""
    noise_m: Length = Field(gt=0, le=0.01)
    """Standard deviation of one touch, along the normal."""
    search_speed_m_s: Speed = Field(gt=0, le=0.1)
    """Of the ball until the first contact."""
    touch_speed_m_s: Speed = Field(gt=0, le=0.1)
    """Of the ball in the touch that counts."""
    mount: ProbeMount
    """Where the ball centre lies on the flange."""
