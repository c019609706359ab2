"""The tables of the distance lasers: one for each driver, told apart by `driver`."""

from math import radians
from typing import Annotated, ClassVar, Literal

from pydantic import Field, StringConstraints

from controller.cellfile.tables import CanBus, Host, Placement, SerialLine, Table, Text
from controller.quantities import Angle, Duration, Frequency, Length, Ratio

Digits = Annotated[str, StringConstraints(pattern=r"^[0-9]+$", max_length=20)]


class LaserMount(Placement):
    """flange_T_laser; the beam runs along +z."""

    FRAME: ClassVar[str] = "laser"
    PARENT: ClassVar[str] = "flange"


class Laser(Table):
    """What every distance laser has."""

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


class OptoncdtLaser(SerialLine, Laser):
    """A Micro-Epsilon optoNCDT 1420 on RS-422."""

    driver: Literal["optoncdt-1420"]
    """Which driver speaks to it."""
    baud: Literal[9600, 19200, 56000, 115200, 128000, 230400, 256000, 460800, 691200, 921600, 1_000_000]
    """Baud rate of the line."""
    model: Text
    """Compared with what the laser answers."""
    serial_number: Digits
    """Compared with what the laser answers."""


class RiftekLaser(SerialLine, Laser):
    """A RIFTEK RF60x: its base distance is `range_start`. One driver for each of its protocols."""

    driver: Literal["riftek-ascii", "riftek-binary", "riftek-modbus"]
    """Which driver speaks to it."""
    baud: int = Field(default=9600, ge=2400, le=460_800, multiple_of=2400)
    """Baud rate of the line, 8E1."""
    serial_number: Digits
    """Compared with what the laser answers."""
    address: int = Field(default=1, ge=1, le=127)
    """Its address on the line."""
    averages: int = Field(default=1, ge=1, le=128)
    """Samples in one result."""
    first_register: Literal[0, 1] = 1
    """Address on the wire of what its manual calls register 1 (Modbus)."""
    echo: bool = False
    """Two-wire RS-485: the adapter returns what is sent (Modbus)."""


class KeyenceLaser(SerialLine, Laser):
    """A Keyence IL laser on a DL-RS1A."""

    driver: Literal["keyence-il"]
    """Which driver speaks to it."""
    baud: Literal[2400, 4800, 9600, 19200, 38400] = 9600
    """Baud rate of the line, 8N1."""
    amplifiers: int = Field(default=1, ge=1, le=15)
    """That the unit has: compared with what it answers."""
    amplifier: int = Field(default=0, ge=0, le=14)
    """Number of the one that counts; 0 is the main one."""
    response_s: Duration = Field(gt=0, le=5)
    """For which the amplifier filters."""
    zero_m: Length = Field(ge=0, le=5)
    """Distance at which its value is zero."""
    towards: bool = True
    """Its values grow towards the head."""


class GocatorLaser(Laser):
    """One measurement of a LMI Gocator line profiler, by Modbus TCP."""

    driver: Literal["gocator"]
    """Which driver speaks to it."""
    host: Host
    """Name or address of the head."""
    port: int = Field(default=502, ge=1, le=65535)
    """TCP port of its Modbus server."""
    measurement: int = Field(default=0, ge=0, le=33)
    """Id of the measurement that is the distance."""
    job: str = Field(default="", max_length=60)
    """Loaded at connect if it is another; "" takes what is loaded."""
    zero_m: Length = Field(ge=0, le=5)
    """Distance at which the measurement is zero."""
    towards: bool = True
    """The measurement grows towards the head."""


class AmsLaser(CanBus, Laser):
    """A Leuze AMS 335i on a CAN bus of its own."""

    driver: Literal["ams-335i"]
    """Which driver speaks to it."""
    node: int = Field(ge=1, le=127)
    """Its CANopen node."""
    serial_number: Digits
    """Compared with what the laser answers."""
    step_m: Length = Field(gt=0, le=0.01)
    """Of its resolution setting."""


AnyLaser = Annotated[
    OptoncdtLaser | RiftekLaser | KeyenceLaser | GocatorLaser | AmsLaser, Field(discriminator="driver")
]
"""The distance laser: which tables `[laser]` may be."""
