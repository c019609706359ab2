"""The tables of the sensors: laser and probe."""

from math import radians
from typing import Annotated, ClassVar, Literal

from pydantic import Field, StringConstraints

from controller.cellfile.tables import Host, Placement, Table, Text
from controller.quantities import Angle, Duration, Frequency, Length, Ratio, Speed


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
    host: Host
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
