"""The RangeSensor capability of a RIFTEK RF60x in its ASCII format: one line for each result.

The format has no way to read or set parameters, so result hold and averaging stay as they were set before.
"""

from typing import Final

from drivers.capabilities import Identity, LinkHealth
from drivers.clock import Clock
from drivers.links.ascii_exchange import AsciiExchange
from drivers.links.interfaces import ByteLink
from drivers.sensors import riftek_codec as codec
from drivers.sensors.riftek_polled import PolledRiftek
from drivers.sensors.riftek_settings import BITS_PER_BYTE, RiftekConfig, compare

LONGEST_ANSWER: Final = 32
RESULT: Final = b"R0"  # in increments


class RiftekAsciiLaser(PolledRiftek):
    """Asks V at connect and after every failure, R0 for each result."""

    def __init__(self, link: ByteLink, config: RiftekConfig, clock: Clock) -> None:
        super().__init__(link, config, clock)
        self._exchange = AsciiExchange(
            link, clock, name="Laser", worst_answer_s=config.worst_answer_s, on_resync=self._after_failure
        )
        self._line_s = LONGEST_ANSWER * BITS_PER_BYTE / config.baud

    def connect(self) -> Identity:
        """Compare the identity, take one result. Raises DeviceError, DeviceTimeout, IdentityMismatch."""
        self._connected = False
        self._link.reopen()
        self._opened += 1
        self._exchange.step.reset()
        identity = compare(self._config, self._head())
        self._connected = True
        self.begin_window()
        self.end_window(1)
        return identity

    def health(self) -> LinkHealth:
        """Link counters."""
        line = self._exchange
        bad = line.bad_frames + line.step.strays
        return LinkHealth(line.frames, bad, line.timeouts, max(0, self._opened - 1))

    def _result(self) -> tuple[int, float]:
        line = self._exchange.ask(RESULT, _is_result, self._line_s)
        return codec.parse_ascii_result(line), self._exchange.received_s

    def _head(self) -> codec.Head:
        return codec.parse_ascii_head(self._exchange.ask(b"V", _is_head, self._line_s))


def _is_result(line: bytes) -> None:
    codec.parse_ascii_result(line)


def _is_head(line: bytes) -> None:
    codec.parse_ascii_head(line)
