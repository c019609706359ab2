"""The TouchProbe capability: a touch probe on an input of a WAGO 750-337 coupler (CANopen, CiA 401).

The coupler sends its inputs when one changes, and again by its event timer, so that a lost frame is noticed.
Such a frame does not tell when it was sent, and may have lain in a dongle: that the input was open at an
instant is proven by the answer to a question that was asked then, and by nothing else.
"""

from dataclasses import dataclass
from typing import Final

from drivers.capabilities import Identity, LinkHealth
from drivers.clock import Clock
from drivers.links.canopen_node import CanopenNode
from drivers.links.canopen_sdo import short_answer
from drivers.links.interfaces import CanFrame, CanLink
from estimation.errors import DeviceError, DeviceTimeout

PROFILE: Final = "191h"  # 401, in the low word of 1000h
WAGO: Final = "21h"
EVENT_DRIVEN: Final = 255
INPUTS: Final = 0x6000
INTERRUPT_ENABLE: Final = 0x6005
ANY_CHANGE: Final = 0x6006
SILENT_TIMERS: Final = 10  # event timers without a frame: the coupler is gone


@dataclass(frozen=True, slots=True)
class WagoConfig:
    """Settings of one probe input."""

    node: int
    channel: int = 0
    model: str = ""  # compared with 1008h if given
    serial_number: str = ""  # compared with 1018h:4 if given
    event_timer_s: float = 0.01  # between two frames while nothing changes
    latency_s: float = 0.003  # from the contact until the coupler knows: filter and scan of the input
    longest_gap_s: float = 0.1  # a touch so long after the input was last seen open is refused
    closed_when_on: bool = True
    stale_s: float = 0.0  # a frame may be so late, and later than an answer: only behind a gateway
    sdo_timeout_s: float = 0.3


class WagoProbe:
    """A contact is the first frame since `arm` in which the input is closed."""

    def __init__(self, link: CanLink, config: WagoConfig, clock: Clock) -> None:
        if not 0 <= config.channel < 64:
            raise DeviceError(f"Channel {config.channel} of a CiA 401 device", "Choose a channel of 0 to 63")
        self._config, self._clock = config, clock
        self._node = CanopenNode(
            link,
            clock,
            config.node,
            name="Probe",
            on_pdo=self._inputs,
            on_answer=self._answer,
            sdo_timeout_s=config.sdo_timeout_s,
        )
        self._connected = self._armed = False
        self._heard_s = self._gap_s = 0.0
        self._clear_s = 0.0  # when it was asked for the input, which was open then
        self._heed_from_s = 0.0  # a frame before may be one of an earlier contact
        self._asked_s: float | None = None  # of a question that is not answered yet
        self._touched_s: float | None = None

    def connect(self) -> Identity:
        """Compare the identity, set up events and event timer, start the node, read the input once.

        Raises DeviceError, DeviceTimeout, SdoAbort.
        """
        node, config = self._node, self._config
        self._connected = self._armed = False
        self._touched_s = self._asked_s = None
        node.open()
        identity = self._identity()
        block = self._block
        if block > (blocks := node.sdo.read_int(config.node, INPUTS, 0)):
            raise DeviceError(
                f"Probe: channel {config.channel} of a station with {8 * blocks} inputs",
                "Correct the channel in the cell file, or plug the module in",
            )
        node.set_up_pdo(1, EVENT_DRIVEN, round(config.event_timer_s * 1e3))
        mask = node.sdo.read_int(config.node, ANY_CHANGE, block)
        node.sdo.write(config.node, ANY_CHANGE, block, mask | 1 << config.channel % 8, 1)
        node.sdo.write(config.node, INTERRUPT_ENABLE, 0, 1, 1)
        node.start()
        self._connected = True
        self._read()
        return identity

    def close(self) -> None:
        """Release the bus; safe twice."""
        self._connected = False
        self._node.close()

    def health(self) -> LinkHealth:
        """Counters of this node."""
        node = self._node
        return LinkHealth(node.frames, node.bad_frames, node.timeouts, max(0, node.opened - 1))

    def arm(self) -> None:
        """Forget what came before. Raises DeviceError if the probe is tripped already."""
        self._require_connection()
        self._armed, self._gap_s = False, 0.0
        tripped, asked_s = self._read()
        if tripped:  # frames sent before the answer have come before it
            raise DeviceError(
                "The probe is tripped before the approach", "Free the stylus; if it is free, check its cable"
            )
        self._heard_s = self._clear_s = asked_s
        self._heed_from_s = self._clock.now_s() + self._config.stale_s  # until then answers alone count
        self._touched_s, self._armed = None, True

    def touched_at_s(self) -> float | None:
        """One poll: the latest instant at which contact can have begun, or None if not touched."""
        self._require_connection()
        if not self._armed:
            raise DeviceError("The probe is not armed", "Arm it before the approach")
        if self._touched_s is None:
            if self._asked_s is None:
                self._ask()
            heard_s = self._heard_s
            self._node.pump(
                self._config.event_timer_s, lambda: self._heard_s != heard_s or self._touched_s is not None
            )
            self._node.drain()  # a robot that moves in steps asks seldom, and the newest frame counts
            self._node.check()
            if self._heard_s == heard_s:
                self._check_silence()
            if self._touched_s is None:
                self._check_answer()
        if self._touched_s is None:
            return None
        if self._gap_s > self._config.longest_gap_s:
            raise DeviceError(
                f"Touched {self._gap_s * 1e3:.0f} ms after the input was last seen open, "
                f"limit {self._config.longest_gap_s * 1e3:.0f} ms",
                "Touch again; if it recurs, check the bus and the load of the computer",
            )
        return self._touched_s

    @property
    def poll_uncertainty_s(self) -> float:
        """Longest time between contact and its detection: as configured, or as measured if that is longer.

        Of a touch it is measured from the last question that was answered with "open".
        """
        return max(self._config.event_timer_s, self._gap_s) + self._config.latency_s

    def is_open(self) -> bool:
        """The stylus touches nothing now, read afresh."""
        self._require_connection()
        return not self._read()[0]

    def _inputs(self, frame: CanFrame) -> None:
        """A frame of the coupler; of others than its first transmit PDO nothing is known."""
        byte = self._config.channel // 8
        if frame.can_id & 0x780 != 0x180:
            return
        if len(frame.data) <= byte:
            self._node.bad_frames += 1
            return
        self._heard_s = frame.time_s
        if self._closed(frame.data[byte]) and frame.time_s >= self._heed_from_s:
            self._touch(frame.time_s)

    def _ask(self) -> None:
        """For the input; the answer comes to `_answer`."""
        self._asked_s = self._clock.now_s()
        self._node.ask(INPUTS, self._block)

    def _answer(self, frame: CanFrame) -> None:
        """An answer to `ask`; while none is expected, it is one to a read that waits for it."""
        value = short_answer(frame.data, INPUTS, self._block)
        if value is None or self._asked_s is None:
            return
        asked_s, self._asked_s = self._asked_s, None
        if self._closed(value[0]):
            self._touch(frame.time_s)
        elif self._touched_s is None:
            self._clear_s = asked_s

    def _touch(self, time_s: float) -> None:
        if self._armed and self._touched_s is None:
            self._touched_s, self._gap_s = time_s, time_s - self._clear_s

    @property
    def _block(self) -> int:
        """Subindex of the eight inputs with this channel."""
        return 1 + self._config.channel // 8

    def _closed(self, inputs: int) -> bool:
        return bool(inputs >> self._config.channel % 8 & 1) == self._config.closed_when_on

    def _read(self) -> tuple[bool, float]:
        """Whether the probe is tripped, and when this was asked; an answer still on its way comes first."""
        self._node.pump(self._config.sdo_timeout_s, lambda: self._asked_s is None)
        self._asked_s, asked_s = None, self._clock.now_s()
        inputs = self._node.sdo.read_int(self._config.node, INPUTS, self._block)
        self._node.check()
        return self._closed(inputs), asked_s

    def _check_silence(self) -> None:
        limit_s = max(SILENT_TIMERS * self._config.event_timer_s, self._config.longest_gap_s)
        if self._clock.now_s() - self._heard_s > limit_s:
            self._node.timeouts += 1
            raise DeviceTimeout(f"Probe: no frame for {limit_s:g} s", "Check power and CAN wiring")

    def _check_answer(self) -> None:
        limit_s = self._config.sdo_timeout_s
        if self._asked_s is not None and self._clock.now_s() - self._asked_s > limit_s:
            self._node.timeouts += 1
            raise DeviceTimeout(f"Probe: its input was not told within {limit_s:g} s", "Check the CAN wiring")

    def _identity(self) -> Identity:
        node, config = self._node, self._config
        device_type, vendor, number = node.read_numbers()
        model, serial = node.read_text(0x1008), str(number) if number else ""
        node.compare(
            (
                ("profile", f"{device_type & 0xFFFF:X}h", PROFILE),
                ("vendor", f"{vendor:X}h", WAGO),
                ("name", model, config.model or model),
                ("serial number", serial, config.serial_number or serial),
            )
        )
        settings = (("node", str(config.node)), ("channel", str(config.channel)))
        return Identity(model, serial, node.read_text(0x100A), settings)

    def _require_connection(self) -> None:
        if not self._connected:
            raise DeviceError("The probe is not connected", "Connect it first")
