"""The touch-probe inputs of CiA 402 drives (60B8h to 60BAh): each joint holds its position at the contact.

Objects and bits are those of CiA 402-2; the device file of the PRBT has none of them. For an arm whose probe
is wired to the inputs of all drives as well.
"""

from collections.abc import Sequence
from typing import Final

from drivers.links.canopen_sdo import SdoPort
from drivers.robots.canopen_arm_setup import ArmConfig
from drivers.robots.canopen_master import CanopenMaster
from estimation.errors import DeviceError

FUNCTION: Final = 0x60B8
STATUS: Final = 0x60B9
RISING_EDGE: Final = 0x60BA
ON_AT_RISING_EDGE: Final = 0x0011  # input 1, the first event
STORED: Final = 1 << 1


class ContactLatch:
    """Switched on before a guarded move, read after it."""

    def __init__(self, master: CanopenMaster, config: ArmConfig) -> None:
        self._master, self._config = master, config
        self._sdo: SdoPort = master.sdo

    def arm(self) -> None:
        """Forget earlier contacts, wait for the next. Raises DeviceError."""
        with self._master.foreground():
            for node in self._config.node_ids:
                self._sdo.write(node, FUNCTION, 0, 0, 2)
                self._sdo.write(node, FUNCTION, 0, ON_AT_RISING_EDGE, 2)

    def counts(self, seen: Sequence[float], within: Sequence[float]) -> list[int]:
        """Positions (joints,) at the contact. Raises DeviceError if a joint has none, or that of another.

        `seen` are the joints when the probe told of the contact, in counts; at most `within` counts later.
        """
        with self._master.foreground():
            held = [self._joint(joint, node) for joint, node in enumerate(self._config.node_ids)]
        for joint, (position, now, most) in enumerate(zip(held, seen, within, strict=True)):
            if abs(position - now) > most:
                raise DeviceError(
                    f"{self._master.name([joint])} held a contact {abs(position - now):.0f} counts from "
                    f"where the probe told of it, at most {most:.0f} are possible",
                    "Check the wiring of the touch-probe inputs for bounce, and touch again",
                )
        return held

    def _joint(self, joint: int, node: int) -> int:
        if not self._sdo.read_int(node, STATUS) & STORED:
            raise DeviceError(
                f"{self._master.name([joint])} did not see the contact at its touch-probe input",
                "Check its wiring, or write touch_probe = false",
            )
        return self._sdo.read_int(node, RISING_EDGE, signed=True)
