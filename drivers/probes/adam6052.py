"""The TouchProbe capability: a kinematic touch probe on a counter input of an ADAM-6052.

The counter latches what polling would miss: a touch shorter than the poll period still counts.
"""

import math
import struct
from dataclasses import dataclass
from typing import Final

from drivers.capabilities import Identity, LinkHealth
from drivers.clock import Clock
from drivers.links.interfaces import ByteLink
from drivers.links.modbus_tcp import ModbusTcp
from estimation.errors import DeviceError, IdentityMismatch

MODULE_NAME: Final = 210  # two registers
COUNTER_RANGE: Final = 1 << 32
BACKWARDS: Final = 1 << 31  # a larger step is a counter that was reset


@dataclass(frozen=True, slots=True)
class ProbeConfig:
    """Settings of one probe input."""

    channel: int = 0
    poll_period_s: float = 0.004
    model: str = "ADAM-6052"
    unit: int = 1
    reply_timeout_s: float = 0.2
    tries: int = 2
    round_trip_s: float = 0.002  # of a poll, allowed in `poll_uncertainty_s`
    filter_s: float = 0.0  # the digital filter of the input delays every edge by this
    fastest_hz: float = 3000.0  # of edges that the input counts (a setting: not in the facts at hand)
    longest_gap_s: float = 0.05  # a touch between polls further apart is refused
    closed_when_on: bool = True  # input level while the stylus is deflected
    address_offset: int = 0  # clients and manuals differ by one: 0 is what is on the wire


class AdamProbe:
    """A contact is a step of the counter since `arm`; a step of more than one is bounce, and noted."""

    def __init__(self, link: ByteLink, config: ProbeConfig, clock: Clock) -> None:
        if not 0 <= config.channel <= 7:
            raise DeviceError(f"Channel {config.channel} of an ADAM-6052", "Choose a channel of 0 to 7")
        self._link, self._config, self._clock = link, config, clock
        self._modbus = ModbusTcp(
            link,
            clock,
            name=config.model,
            unit=config.unit,
            reply_timeout_s=config.reply_timeout_s,
            tries=config.tries,
            on_resync=self._after_timeout,
        )
        self._opened = 0
        self._connected = False
        self._count: int | None = None  # at `arm`
        self._clear_s = 0.0  # when the last poll without contact was asked
        self._touched_s: float | None = None
        self._gap_s = 0.0
        self.bounces = 0  # edges beyond the first, since connect

    def connect(self) -> Identity:
        """Open the connection, compare the module name, read the input once.

        Raises DeviceError, DeviceTimeout, IdentityMismatch.
        """
        self._connected = False
        self._link.reopen()
        self._opened += 1
        self._modbus.reset()
        self._count = self._touched_s = None
        self.bounces = 0
        name = self._check_name()
        self._connected = True
        self._tripped()
        self._counter()
        return Identity(name, "", "", (("channel", str(self._config.channel)),))

    def close(self) -> None:
        """Release the connection; safe twice."""
        self._connected = False
        self._link.close()

    def health(self) -> LinkHealth:
        """Link counters."""
        modbus = self._modbus
        return LinkHealth(modbus.frames, modbus.bad_frames, modbus.timeouts, max(0, self._opened - 1))

    def arm(self) -> None:
        """Remember the present count. Raises DeviceError if the probe is tripped already."""
        self._require_connection()
        self._touched_s, self._gap_s = None, 0.0
        if self._tripped():
            raise DeviceError(
                "The probe is tripped before the approach", "Free the stylus; if it is free, check its cable"
            )
        self._count = self._counter()
        self._clear_s = self._modbus.sent_s

    def touched_at_s(self) -> float | None:
        """One poll: the latest instant at which contact can have begun, or None if not touched.

        Waits until the next poll is due. After a contact, its time until `arm` is called again.
        """
        self._require_connection()
        if self._touched_s is not None:
            return self._touched_s
        if self._count is None:
            raise DeviceError("The probe is not armed", "Arm it before the approach")
        wait_s = self._clear_s + self._config.poll_period_s - self._clock.now_s()
        if wait_s > 0.0:
            self._clock.sleep(wait_s)
        edges = (self._counter() - self._count) % COUNTER_RANGE
        if edges == 0:
            self._clear_s = self._modbus.sent_s
            return None
        if edges >= BACKWARDS:
            raise DeviceError(
                f"{self._config.model}: counter {self._config.channel} went back, the module restarted",
                "Check its supply, then reset and touch again",
            )
        self._gap_s = self._modbus.received_s - self._clear_s
        possible = 1 + math.ceil(self._gap_s * self._config.fastest_hz)
        if edges > possible:
            raise DeviceError(
                f"{self._config.model}: counter {self._config.channel} counted {edges} edges in "
                f"{self._gap_s * 1e3:.0f} ms, at most {possible} are possible",
                "Touch again; if it recurs, check the probe cable for interference, and the network",
            )
        self.bounces += edges - 1
        if self._gap_s > self._config.longest_gap_s:
            raise DeviceError(
                f"Touched between polls {self._gap_s * 1e3:.0f} ms apart, "
                f"limit {self._config.longest_gap_s * 1e3:.0f} ms",
                "Touch again; if it recurs, check the network and the load of the computer",
            )
        self._touched_s = self._modbus.received_s
        return self._touched_s

    @property
    def poll_uncertainty_s(self) -> float:
        """Longest time between contact and its detection: as configured, or of the last touch if longer."""
        config = self._config
        return max(config.poll_period_s + config.round_trip_s, self._gap_s) + config.filter_s

    def is_open(self) -> bool:
        """The stylus touches nothing now, read afresh."""
        self._require_connection()
        return not self._tripped()

    def _tripped(self) -> bool:
        address = self._config.channel + self._config.address_offset
        return self._modbus.read_inputs(address, 1)[0] == self._config.closed_when_on

    def _counter(self) -> int:
        """32 bits in two registers, the low word first; read in one request, so that it cannot tear."""
        address = 2 * self._config.channel + self._config.address_offset
        low, high = self._modbus.read_input_registers(address, 2)
        return high << 16 | low

    def _check_name(self) -> str:
        """The module name is two registers, and holds the model number as hexadecimal digits or as text."""
        address = MODULE_NAME + self._config.address_offset
        registers = self._modbus.read_holding_registers(address, 2)
        wanted = "".join(c for c in self._config.model if c.isdigit())
        text = struct.pack(">2H", *registers).decode("ascii", errors="replace").strip("\0 ")
        if wanted and wanted not in (f"{registers[0]:04X}", f"{registers[1]:04X}", text):
            raise IdentityMismatch(
                f"The module says {registers[0]:04X} {registers[1]:04X}, the cell file {self._config.model}",
                "Check host and port, or correct the cell file",
            )
        return self._config.model

    def _after_timeout(self) -> None:
        """Part of the resynchronisation: the module that answers now is still the one that was asked."""
        if self._connected:
            self._check_name()

    def _require_connection(self) -> None:
        if not self._connected:
            raise DeviceError("The probe is not connected", "Connect it first")
