"""The RangeSensor capability of a Leuze AMS 335i on CAN (CiA 406): position and status at every SYNC.

By default the device repeats its last good position for a while when it sees nothing, and hides that it does.
Both are switched off at connect.
"""

import struct
from dataclasses import dataclass
from typing import Final

from drivers.capabilities import Identity, LinkHealth
from drivers.clock import Clock
from drivers.links.canopen_node import CanopenNode
from drivers.links.interfaces import CanFrame, CanLink
from drivers.sensors.polled import Answer, PolledRange, no_value
from estimation.errors import DeviceError, DeviceTimeout

DEVICE_TYPE: Final = "80196h"
LEUZE: Final = "121h"
EVERY_SYNC: Final = 1
POSITION_AND_STATUS: Final = 2  # number of the PDO
ERROR_CHOICE: Final = 0x2070
OPERATING: Final = 0x6000
REVERSED: Final = 1 << 3
# Bits of the status in which there is no value. A preset counts from a place that no cell file knows.
FAULTS: Final = {8: "laser off", 9: "preset active", 16: "implausible value"}
_PDO: Final = struct.Struct("<iI")


@dataclass(frozen=True, slots=True)
class AmsConfig:
    """Settings of one sensor."""

    node: int
    step_m: float = 1e-4  # of its resolution setting
    range_start_m: float = 0.0  # distance of position zero
    serial_number: str = ""  # compared if given
    noise_m: float = 0.0  # of one value; 0 switches the search for a frozen value off
    fresh_s: float = 0.02  # a position is at most so old at the SYNC
    answer_s: float = 0.05  # longest time from SYNC to the frame
    error_choice: int = 1  # bits of 2070h: zero at once, nothing hidden, no delay
    error_subindex: int = 0  # where 2070h has them, which the facts at hand do not say
    sdo_timeout_s: float = 0.3


class Ams335i(PolledRange):
    """Asks with a SYNC for each value."""

    def __init__(self, link: CanLink, config: AmsConfig, clock: Clock) -> None:
        super().__init__(clock, "Laser", fresh_s=config.fresh_s, noise_m=config.noise_m, step_m=config.step_m)
        self._config = config
        self._node = CanopenNode(
            link, clock, config.node, name="Laser", on_pdo=self._heard, sdo_timeout_s=config.sdo_timeout_s
        )
        self._answers = list[CanFrame]()
        self._late = False  # a SYNC was not answered, and may be yet

    def connect(self) -> Identity:
        """Compare the identity, switch off what hides errors, start the node, take one value.

        Raises DeviceError, DeviceTimeout, IdentityMismatch, SdoAbort.
        """
        node, config = self._node, self._config
        self._connected, self._late = False, False
        node.open()
        identity = self._identity()
        if node.sdo.read_int(config.node, OPERATING) & REVERSED:
            raise DeviceError(
                "Laser: its counting direction is reversed (6000h bit 3)", "Set it to positive, then reset"
            )
        node.sdo.write(config.node, ERROR_CHOICE, config.error_subindex, config.error_choice, 1)
        node.set_up_pdo(POSITION_AND_STATUS, EVERY_SYNC)
        node.start()
        self._connected = True
        self.begin_window()
        self.end_window(1)
        return identity

    def close(self) -> None:
        """Release the bus; safe twice."""
        self._connected = False
        self._node.close()

    def health(self) -> LinkHealth:
        """Counters of this node."""
        node = self._node
        return LinkHealth(node.frames, node.bad_frames, node.timeouts, max(0, node.opened - 1))

    def _ask(self) -> Answer:
        node, config = self._node, self._config
        if self._late:  # an answer to the last SYNC must not be taken for the next one
            node.pump(config.answer_s)
            self._late = False
        node.drain()
        node.check()
        self._answers.clear()
        node.sync()
        node.pump(config.answer_s, lambda: bool(self._answers))
        node.check()
        if not self._answers:
            self._late = True
            node.timeouts += 1
            raise DeviceTimeout(
                f"Laser: no answer to SYNC within {config.answer_s:g} s", "Check power and CAN wiring"
            )
        frame = self._answers[0]
        position, status = _PDO.unpack(frame.data)
        reasons = [words for bit, words in FAULTS.items() if status >> bit & 1]
        if reasons:
            return no_value(frame.time_s, reasons[0])
        if position <= 0:  # zero is shown instead of a value; it cannot see behind itself
            return no_value(frame.time_s, "position zero or below")
        return Answer(config.range_start_m + position * config.step_m, frame.time_s)

    def _heard(self, frame: CanFrame) -> None:
        """Only the PDO that has the status beside the position counts."""
        if frame.can_id & 0x780 != 0x280:
            return
        if len(frame.data) == _PDO.size:
            self._answers.append(frame)
        else:
            self._node.bad_frames += 1

    def _identity(self) -> Identity:
        node, config = self._node, self._config
        device_type, vendor, serial = node.read_numbers()
        node.compare(
            (
                ("device type", f"{device_type:X}h", DEVICE_TYPE),
                ("vendor", f"{vendor:X}h", LEUZE),
                ("serial number", str(serial), config.serial_number or str(serial)),
            )
        )
        settings = (("node", str(config.node)), ("step_mm", f"{config.step_m * 1e3:g}"))
        return Identity(node.read_text(0x1008), str(serial), node.read_text(0x100A), settings)
