"""The tables of the touch probes: one for each driver, told apart by `driver`."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from controller.cellfile.tables import CanBus, Host, Placement, SerialLine, Table, Text
from controller.quantities import Duration, Length, Speed


class ProbeMount(Placement):
    """flange_T_probe; the origin is the ball centre."""

    FRAME: ClassVar[str] = "probe"
    PARENT: ClassVar[str] = "flange"


class Probe(Table):
    """What every touch probe has."""

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


class AdamProbe(Probe):
    """A touch-trigger probe on a counter input of an ADAM-6052 (Modbus TCP)."""

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


class WagoProbe(CanBus, Probe):
    """A touch-trigger probe on an input of a WAGO 750-337 (CANopen); its event timer is `poll_period`."""

    driver: Literal["wago-750-337"]
    """Which driver speaks to it."""
    node: int = Field(ge=1, le=127)
    """CANopen node of the station."""
    model: str = Field(default="", max_length=40)
    """Compared with what the station answers, if given."""
    channel: int = Field(ge=0, le=63)
    """Input that the probe is wired to."""


class ForceProbe(SerialLine, Probe):
    """A stylus on a Robotiq FT 300 force sensor, which sends a value every 10 ms."""

    driver: Literal["robotiq-ft300"]
    """Which driver speaks to it."""
    serial_number: str = Field(default="", max_length=20)
    """Compared with what the sensor answers, if given."""
    threshold_newton: float = Field(gt=0, le=100)
    """Force that is a touch; its pre-travel belongs to the ball radius."""
    release_newton: float = Field(gt=0, le=100)
    """Force below which the stylus is free again; less than the threshold."""
    free_newton: float = Field(gt=0, le=300)
    """Largest force that a free stylus shows in any orientation, by its weight and the sensor's zero."""


class GaugeProbe(SerialLine, Probe):
    """A Keyence GT2 contact gauge on a DL-RS1A; each poll is one question on its line."""

    driver: Literal["keyence-gt2"]
    """Which driver speaks to it."""
    baud: Literal[2400, 4800, 9600, 19200, 38400] = 9600
    """Baud rate of the line, 8N1."""
    amplifiers: int = Field(default=1, ge=1, le=15)
    """That the unit has: compared with what it answers."""
    amplifier: int = Field(default=0, ge=0, le=14)
    """Number of the one that counts; 0 is the main one."""
    response_s: Duration = Field(gt=0, le=5)
    """For which the amplifier filters."""
    threshold_m: Length = Field(gt=0, le=0.01)
    """Movement of the spindle that is a touch."""
    release_m: Length = Field(gt=0, le=0.01)
    """Movement below which it is free again; less than the threshold."""
    free_m: Length = Field(ge=0, le=0.1)
    """Largest value of a free spindle."""


AnyProbe = Annotated[AdamProbe | WagoProbe | ForceProbe | GaugeProbe, Field(discriminator="driver")]
"""The touch probe: which tables `[probe]` may be."""
