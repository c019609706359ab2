"""The tables of the robots: one for each driver, told apart by `driver`."""

from math import radians
from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from controller.cellfile.arm import Arm
from controller.cellfile.tables import CanBus, Host, SerialLine
from controller.quantities import Angle, AngularSpeed, Duration, Frequency, Length


class CanopenRobot(CanBus, Arm):
    """An arm whose joints are CiA 402 drives on one CAN bus."""

    driver: Literal["canopen-402"]
    """Which driver speaks to it."""
    nodes: tuple[Annotated[int, Field(ge=1, le=127)], ...]
    """CANopen node of each joint, from the base outwards."""
    sync_period_s: Duration = Field(ge=0.001, le=1)
    """Time between two SYNC messages; one joint reading each."""
    cruise_sync_period_s: Duration = Field(0.05, ge=0.001, le=0.06)
    """The same far from the end of a free move, where less must be seen; at least `sync_period`."""
    touch_probe: bool = False
    """The probe is wired to an input of each drive (60B8h), which holds its position at contact."""


class MelfaRobot(Arm):
    """What all Mitsubishi MELFA controllers have in common."""

    max_speed_rad_s: AngularSpeed = Field(gt=0, le=radians(1000))
    """Of the fastest joint at 100 %: what the percentages that the robot is told refer to."""
    robot_number: int = Field(default=1, ge=1, le=3)
    """Number of the robot at this controller."""
    slot: int = Field(default=1, ge=1, le=33)
    """Slot in which instructions are executed; some controllers need the edit slot, 9."""
    program: str = Field(default="", pattern=r"^[A-Z0-9]*$", max_length=12)
    """Empty program that the slot needs before it executes anything; "" loads none."""
    terminator: Literal["CR", "CR LF", "none"] = "CR"
    """End of a line, as the controller is set."""
    stop_delay_s: Duration = Field(default=0.15, ge=0, le=5)
    """Longest time from the request to stop until the arm slows down; a touch is as uncertain."""

    @property
    def contact_delay_s(self) -> float:
        """Joints of a contact are read when the arm has stopped."""
        return self.stop_delay_s


class MelfaTcpRobot(MelfaRobot):
    """A Mitsubishi MELFA controller on Ethernet, R-protocol."""

    driver: Literal["melfa-tcp"]
    """Which driver speaks to it."""
    host: Host
    """Name or address of the controller."""
    port: int = Field(default=10001, ge=1, le=65535)
    """TCP port of the session for commands."""
    stop_port: int | None = Field(default=None, ge=1, le=65535)
    """TCP port of a second session, over which a stop waits for nothing; without it, it goes next."""


class MelfaSerialRobot(SerialLine, MelfaRobot):
    """A Mitsubishi MELFA controller on RS-232, R-protocol; a stop goes next after the answer in flight."""

    driver: Literal["melfa-serial"]
    """Which driver speaks to it."""
    baud: Literal[9600, 19200, 38400, 57600, 115200] = 9600
    """Baud rate of the line."""
    framing: Literal["8E2", "8E1", "8N1", "8N2", "8O1", "8O2"] = "8E2"
    """Data bits, parity and stop bits of the line."""


class IgusRobot(Arm):
    """An igus / Commonplace Robotics controller (iRC, TinyCtrl), Modbus TCP; a stop goes next."""

    driver: Literal["igus-irc"]
    """Which driver speaks to it."""
    host: Host
    """Name or address of the controller."""
    port: int = Field(default=502, ge=1, le=65535)
    """TCP port of its Modbus server."""
    max_speed_rad_s: AngularSpeed = Field(gt=0, le=radians(1000))
    """Of the fastest joint at 100 %: what the percentages that the robot is told refer to."""
    euler: Literal["xyz", "zyx"] = "xyz"
    """Fixed axes about which A, B and C of its pose turn, in this order."""
    stop_delay_s: Duration = Field(default=0.1, ge=0, le=5)
    """Longest time from the request to stop until the arm slows down; a touch is as uncertain."""

    @property
    def contact_delay_s(self) -> float:
        """Joints of a contact are read when the arm has stopped."""
        return self.stop_delay_s


class UrRobot(Arm):
    """A Universal Robots controller: RTDE for its state, URScript for motion; a stop waits for nothing."""

    driver: Literal["ur"]
    """Which driver speaks to it."""
    host: Host
    """Name or address of the controller."""
    serial_number: Annotated[str, StringConstraints(pattern=r"^[0-9]*$", max_length=20)] = ""
    """Compared with what the dashboard answers; "" does not compare."""
    port: int = Field(default=30004, ge=1, le=65535)
    """TCP port of RTDE."""
    script_port: int = Field(default=30002, ge=1, le=65535)
    """TCP port to which programs are sent."""
    dashboard_port: int = Field(default=29999, ge=1, le=65535)
    """TCP port of the dashboard server."""
    rate_hz: Frequency = Field(default=125.0, ge=1, le=500)
    """Data packages per second; a contact is known to one of them."""
    first_register: int = Field(default=24, ge=0, le=46)
    """Output integer register that counts programs, with the one after it; nothing else may write them."""
    stop_delay_s: Duration = Field(default=0.1, ge=0, le=5)
    """Longest time from the request to stop until the arm slows down."""

    @property
    def contact_delay_s(self) -> float:
        """Joints of a contact lie between two data packages."""
        return 1.0 / self.rate_hz


class AbbRobot(Arm):
    """An ABB controller with the open_abb server; it cannot be stopped, so moves go in steps."""

    driver: Literal["abb-open"]
    """Which driver speaks to it."""
    host: Host
    """Name or address of the controller."""
    port: int = Field(default=5000, ge=1, le=65535)
    """TCP port of the server program, which has one client."""
    serial_number: Annotated[str, StringConstraints(max_length=40)] = ""
    """Compared with what the server answers; "" does not compare."""
    reach_m: Length = Field(gt=0, le=5)
    """Largest distance of the flange from a joint axis: the server is told speeds of the flange."""
    step_rad: Angle = Field(default=radians(10), gt=0, le=radians(360))
    """Longest way of a joint between two chances to stop."""
    touch_step_s: Duration = Field(default=0.05, gt=0, le=1)
    """A guarded move goes in steps of so long at its speed; so far the probe may travel on."""
    decimals: int = Field(default=2, ge=1, le=4)
    """Decimals of degrees and millimetres in the replies of the server."""
    quaternion_decimals: int = Field(default=3, ge=2, le=6)
    """Decimals of its quaternions."""

    @property
    def contact_delay_s(self) -> float:
        """A contact lies somewhere in the last step."""
        return self.touch_step_s


Robot = Annotated[
    AbbRobot | CanopenRobot | IgusRobot | MelfaTcpRobot | MelfaSerialRobot | UrRobot,
    Field(discriminator="driver"),
]
