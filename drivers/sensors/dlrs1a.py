"""The RangeSensor capability of a Keyence DL-RS1A: one GT2 gauge or IL laser among its amplifiers.

Reads the raw value: what an amplifier calls its measured value may be held or offset, and looks as alive.
"""

from dataclasses import dataclass
from typing import Final

from drivers.capabilities import Identity, LinkHealth
from drivers.clock import Clock
from drivers.links.ascii_exchange import AsciiExchange
from drivers.links.interfaces import ByteLink
from drivers.sensors import dlrs1a_codec as codec
from drivers.sensors.polled import Answer, PolledRange, no_value
from estimation.errors import DeviceError, FrameError, IdentityMismatch

WORST_ANSWER_S: Final = 1.0  # the unit answers within, or not at all
EXTRA_BITS: Final = 4  # around the data bits of a byte, as the manual computes its answer times


@dataclass(frozen=True, slots=True)
class DlRs1aConfig:
    """Settings of one unit and of one amplifier in it."""

    head: str  # "GT2" or "IL"
    amplifiers: int = 1  # that the unit must have: nothing else tells one unit from another
    amplifier: int = 0  # 0 is the main one
    zero_m: float = 0.0  # distance at which the value is zero
    towards: bool = False  # the value grows towards the head
    noise_m: float = 0.0  # of one value; 0 switches the search for a frozen value off
    response_s: float = 0.1  # for which the amplifier filters: a value lags by so much
    baud: int = 9600
    data_bits: int = 8


class DlRs1a(PolledRange):
    """One line asked, one answered."""

    def __init__(self, link: ByteLink, config: DlRs1aConfig, clock: Clock) -> None:
        self._config, self._head = config, codec.HEADS[config.head]
        self._raw = codec.read_request(config.amplifier, self._head.raw)
        line_s = codec.line_bytes(self._raw) * (config.data_bits + EXTRA_BITS) / config.baud
        self.period_s = line_s  # between two values at best
        super().__init__(
            clock,
            "Gauge",
            fresh_s=config.response_s,
            noise_m=config.noise_m,
            step_m=self._head.step_m,
        )
        self._link = link
        self._line = AsciiExchange(
            link, clock, name="Gauge unit", worst_answer_s=WORST_ANSWER_S, on_resync=self._after_failure
        )
        self._opened = 0
        self._width = 0  # of a value, in characters: an amplifier keeps it, so that a lost digit shows

    def connect(self) -> Identity:
        """Compare the number of amplifiers, look at the error bits, take one value.

        Raises DeviceError, DeviceTimeout, FrameError, IdentityMismatch.
        """
        self._connected, self._width = False, 0
        self._link.reopen()
        self._opened += 1
        self._line.step.reset()
        self._count_amplifiers()
        errors = self._item(codec.read_request(self._config.amplifier, self._head.errors))
        if errors.strip("0"):
            raise DeviceError(
                f"Gauge: amplifier {self._config.amplifier} reports the error bits {errors}",
                "Look at its display",
            )
        self._connected = True
        self.begin_window()
        self.end_window(1)
        settings = (("head", self._config.head), ("amplifier", str(self._config.amplifier)))
        return Identity("DL-RS1A", "", "", settings)

    def close(self) -> None:
        """Release the port; safe twice."""
        self._connected = False
        self._link.close()

    def health(self) -> LinkHealth:
        """Link counters."""
        line = self._line
        bad = line.bad_frames + line.step.strays
        return LinkHealth(line.frames, bad, line.timeouts, max(0, self._opened - 1))

    def read_raw(self) -> tuple[float | None, float]:
        """The raw value in metres, and when it came. Raises DeviceError, DeviceTimeout, FrameError."""
        line = self._line.ask(self._raw, self._accept_value, self.period_s)
        data = codec.parse_item(line, self._raw)
        self._width = len(data)
        return codec.parse_value(data), self._line.received_s

    def _ask(self) -> Answer:
        value_m, received_s = self.read_raw()
        if value_m is None:
            return no_value(received_s, "no target, or out of range")
        config = self._config
        return Answer(config.zero_m + (-value_m if config.towards else value_m), received_s)

    def _item(self, request: bytes) -> str:
        line = self._line.ask(request, lambda line: _accept(line, request), self.period_s)
        return codec.parse_item(line, request)

    def _accept_value(self, line: bytes) -> None:
        _accept(line, self._raw)
        data = line.rpartition(b",")[2]
        if line.startswith(self._raw) and self._width not in (0, len(data)):
            raise FrameError(
                f"Gauge unit sent {data!r}, a value of {len(data)} characters after one of {self._width}",
                "Check baud rate, parity and cable",
            )

    def _count_amplifiers(self) -> None:
        expected = self._config.amplifiers
        within_s = expected * self.period_s
        found = len(codec.parse_all(self._line.ask(codec.ALL_VALUES, _is_all, within_s)))
        if found != expected:
            raise IdentityMismatch(
                f"Gauge unit with {found} amplifiers, the cell file says {expected}",
                "Check the plugs between them, switch the unit off and on, or correct the cell file",
            )

    def _after_failure(self) -> None:
        """Part of the resynchronisation: the unit that answers now has as many amplifiers."""
        if self._connected:
            self._count_amplifiers()


def _accept(line: bytes, request: bytes) -> None:
    """A refusal is an answer, too; one to another request is not."""
    try:
        codec.parse_item(line, request)
    except FrameError:
        raise
    except DeviceError:
        pass


def _is_all(line: bytes) -> None:
    codec.parse_all(line)
