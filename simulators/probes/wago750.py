"""WAGO 750-337 coupler with digital inputs and outputs, a CiA 401 device; the probe's switch on one input.

Source: WAGO-I/O-SYSTEM 750 CANopen manual, pages 113 to 129; mappings as in CiA 401.
"""

from dataclasses import dataclass
from typing import Final

from simulators.canopen_objects import Key, Row, Value, communication, entries_of, mapping
from simulators.canopen_slave import CanopenSlave
from simulators.probes.switch import Switch

DEVICE_TYPE: Final = 0x00030191  # CiA 401 with digital inputs and outputs
WAGO: Final = 0x21
SCAN_S: Final = 0.001  # of the inputs, over the internal bus; not in the manual
INPUTS: Final[Key] = (0x6000, 1)
ENABLED: Final[Key] = (0x6005, 0)
ANY_CHANGE: Final[Key] = (0x6006, 1)
RISING: Final[Key] = (0x6007, 1)
FALLING: Final[Key] = (0x6008, 1)
OUTPUTS: Final[Key] = (0x6200, 1)


def _table() -> list[Row]:
    return [
        (0x1000, 0, "u32", DEVICE_TYPE, "r"),
        (0x1001, 0, "u8", 0, "r"),
        (0x1003, 0, "u8", 0, "w"),
        (0x1005, 0, "u32", 0x80, "r"),
        (0x1008, 0, "text", "", "r"),
        (0x1009, 0, "text", "05", "r"),
        (0x100A, 0, "text", "05.01 simulated", "r"),
        (0x100C, 0, "u16", 0, "w"),
        (0x100D, 0, "u8", 0, "w"),
        (0x1014, 0, "u32", 0x80, "r"),
        (0x1017, 0, "u16", 0, "w"),
        (0x1018, 0, "u8", 4, "r"),
        *[(0x1018, sub, "u32", 0, "r") for sub in range(1, 5)],
        *communication(0x1400, 0x200, 255),
        *mapping(0x1600, (0x62000108,)),
        *communication(0x1800, 0x180, 255),
        *mapping(0x1A00, (0x60000108,)),
        *[row for n in (1, 2, 3) for row in communication(0x1800 + n, 0x180 + 0x100 * n, 255, 100)],
        *[row for n in (1, 2, 3) for row in mapping(0x1A00 + n, ())],
        (0x6000, 0, "u8", 1, "r"),
        (0x6000, 1, "u8", 0, "rm"),
        (0x6005, 0, "u8", 0, "w"),
        (0x6006, 0, "u8", 1, "r"),
        (0x6006, 1, "u8", 0xFF, "w"),
        (0x6007, 0, "u8", 1, "r"),
        (0x6007, 1, "u8", 0, "w"),
        (0x6008, 0, "u8", 1, "r"),
        (0x6008, 1, "u8", 0, "w"),
        (0x6200, 0, "u8", 1, "r"),
        (0x6200, 1, "u8", 0, "wm"),
        (0x6206, 0, "u8", 1, "r"),
        (0x6206, 1, "u8", 0xFF, "w"),
        (0x6207, 0, "u8", 1, "r"),
        (0x6207, 1, "u8", 0, "w"),
    ]


ENTRIES: Final = entries_of(_table())


@dataclass(frozen=True, slots=True)
class WagoSpec:
    """One station."""

    node: int = 20
    name: str = "750-337"
    product: int = 337
    serial_number: int = 0  # it may have none
    channel: int = 0


class Wago750(CanopenSlave):
    """Sends its inputs when one changes that 6006h, 6007h or 6008h watches, and by the event timer."""

    def __init__(self, spec: WagoSpec, switch: Switch) -> None:
        self._switch, self._channel = switch, spec.channel
        identity: dict[Key, Value] = {
            (0x1008, 0): spec.name,
            (0x1018, 1): WAGO,
            (0x1018, 2): spec.product,
            (0x1018, 4): spec.serial_number,
        }
        super().__init__(spec.node, ENTRIES, identity)

    def live(self, key: Key, time_s: float) -> Value | None:
        """The inputs are the switch."""
        if key != INPUTS:
            return None
        self._switch.update(time_s)
        return int(self._switch.closed) << self._channel

    def next_change_s(self, time_s: float) -> float:
        """The switch is looked at in every scan, but nothing is to be seen before it can change."""
        return max(self._switch.unchanged_until_s(time_s), time_s) + SCAN_S

    def is_event(self, before: bytes, after: bytes) -> bool:
        """As the masks say."""
        old, new = before[0], after[0]
        masks = [int(self.values[key]) for key in (ANY_CHANGE, RISING, FALLING)]
        watched = (old ^ new) & masks[0] | new & ~old & masks[1] | old & ~new & masks[2]
        return bool(self.values[ENABLED]) and bool(watched)
