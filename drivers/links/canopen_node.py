"""One CANopen node that is no drive: set-up by SDO, network state, and process data as it comes."""

from collections.abc import Callable, Iterable, Sequence
from typing import Final

from drivers.clock import Clock
from drivers.links.canopen_sdo import SdoPort, read_request
from drivers.links.interfaces import CanFrame, CanLink
from estimation.errors import DeviceError, DeviceTimeout, FrameError, IdentityMismatch

NMT_START: Final = 0x01
NMT_PRE_OPERATIONAL: Final = 0x80
OPERATIONAL: Final = 0x05
SYNC: Final = 0x080
EMERGENCY: Final = 0x080
SDO_REQUEST: Final = 0x600
HEARTBEAT: Final = 0x700
HEARTBEAT_MS: Final = 100
PDO_OFF: Final = 1 << 31
LONGEST_DRAIN_S: Final = 0.5
BOOT_UP: Final = 0
LENGTHS: Final = {HEARTBEAT: 1, EMERGENCY: 8, 0x580: 8}  # of frames that have only one


class CanopenNode:
    """Everything that is received goes through `pump`; `on_pdo` gets the process data of the node,
    `on_answer` its answers to `ask` and to `sdo`.

    A node that boots, or leaves the operational state by itself, has lost its settings: that is latched until
    the next `open`.
    """

    def __init__(
        self,
        link: CanLink,
        clock: Clock,
        node_id: int,
        *,
        name: str,
        on_pdo: Callable[[CanFrame], None],
        on_answer: Callable[[CanFrame], None] | None = None,
        sdo_timeout_s: float = 0.3,
    ) -> None:
        self._link, self._clock, self.node_id, self.name = link, clock, node_id, name
        self._on_pdo, self._on_answer = on_pdo, on_answer
        self.sdo = SdoPort(link, (node_id,), self.pump, sdo_timeout_s)
        self.frames = self.bad_frames = self.timeouts = self.opened = 0
        self._state, self._running = -1, False
        self._fault: DeviceError | None = None

    def open(self) -> None:
        """Open the bus, and bring the node into the state in which it is set up. Raises DeviceError."""
        self._link.reopen()
        self.opened += 1
        self._state, self._running, self._fault = -1, False, None
        self.drain()
        self.sdo.send_nmt(NMT_PRE_OPERATIONAL, self.node_id)

    def read_numbers(self) -> tuple[int, int, int]:
        """Device type, vendor and serial number. Raises SdoAbort, DeviceTimeout."""
        read = self.sdo.read_int
        return read(self.node_id, 0x1000), read(self.node_id, 0x1018, 1), read(self.node_id, 0x1018, 4)

    def read_text(self, index: int) -> str:
        """A text object without its padding. Raises SdoAbort, DeviceTimeout."""
        return self.sdo.read(self.node_id, index).decode("ascii", errors="replace").strip("\0 ")

    def compare(self, told_and_expected: Iterable[tuple[str, str, str]]) -> None:
        """Raises IdentityMismatch for the first pair that differs; each with what it is."""
        for what, told, expected in told_and_expected:
            if told != expected:
                raise IdentityMismatch(
                    f"{self.name}: node {self.node_id} says {what} {told}, expected is {expected}",
                    "Check the node number, or correct the cell file",
                )

    def set_up_pdo(self, number: int, kind: int, event_ms: int = 0) -> None:
        """Transmission type and event timer of a transmit PDO (1 to 4), which must be off meanwhile."""
        index, write = 0x1800 + number - 1, self.sdo.write
        can_id = self.sdo.read_int(self.node_id, index, 1) & ~PDO_OFF
        write(self.node_id, index, 1, can_id | PDO_OFF, 4)
        write(self.node_id, index, 2, kind, 1)
        write(self.node_id, index, 3, 0, 2)
        write(self.node_id, index, 5, event_ms, 2)
        write(self.node_id, index, 1, can_id, 4)

    def start(self, timeout_s: float = 1.0) -> None:
        """Switch the heartbeat on, and the node to operational. Raises DeviceTimeout."""
        self.sdo.write(self.node_id, 0x1017, 0, HEARTBEAT_MS, 2)
        self._state = -1
        self.sdo.send_nmt(NMT_START, self.node_id)
        self.pump(timeout_s, lambda: self._state == OPERATIONAL)
        if self._state != OPERATIONAL:
            self.timeouts += 1
            raise DeviceTimeout(
                f"{self.name}: node {self.node_id} is not operational {timeout_s:g} s after its start",
                "Check power, node number and CAN wiring",
            )
        self._running = True

    def ask(self, index: int, subindex: int) -> None:
        """Ask for an object and do not wait. Until it is answered, `sdo` must not be used."""
        self._link.send(SDO_REQUEST + self.node_id, read_request(index, subindex))

    def sync(self) -> None:
        """Send one SYNC."""
        self._link.send(SYNC, b"")

    def close(self) -> None:
        """Release the bus; safe twice."""
        self._running = False
        self._link.close()

    def check(self) -> None:
        """Raise what went wrong since the node was started."""
        if self._fault is not None:
            raise DeviceError(self._fault.problem, self._fault.remedy)

    def drain(self) -> None:
        """Take what has come by now. Raises FrameError if that has no end."""
        until_s = self._clock.now_s() + LONGEST_DRAIN_S
        while frames := self._link.receive(0.0):
            self._dispatch(frames)
            if self._clock.now_s() > until_s:
                raise FrameError(
                    f"{self.name}: frames without a pause for {LONGEST_DRAIN_S:g} s on its bus",
                    "Look for a babbling node",
                )

    def pump(self, timeout_s: float, done: Callable[[], bool] = lambda: False) -> None:
        """Receive until `done()` or the timeout."""
        until_s = self._clock.now_s() + timeout_s
        while not done():
            remaining_s = until_s - self._clock.now_s()
            if remaining_s < 0.0:
                return
            frames = self._link.receive(remaining_s)
            if frames:
                self._dispatch(frames)
            elif remaining_s <= 0.0:
                return

    def _dispatch(self, frames: Sequence[CanFrame]) -> None:
        for frame in frames:
            if frame.can_id & 0x7F == self.node_id:
                self.frames += 1
                self._take(frame)

    def _take(self, frame: CanFrame) -> None:
        function = frame.can_id & 0x780
        if len(frame.data) != LENGTHS.get(function, len(frame.data)):
            self.bad_frames += 1
        elif function == 0x580:
            self.sdo.deliver(frame.can_id, frame.data, frame.time_s)
            if self._on_answer is not None:
                self._on_answer(frame)
        elif function == HEARTBEAT:
            self._heard(frame.data[0] & 0x7F)
        elif function == EMERGENCY:
            code = int.from_bytes(frame.data[:2], "little")
            if code:
                self._latch(f"reports the error {code:04X}h", "Look at the device, then reset")
        elif function in (0x180, 0x280, 0x380, 0x480):
            self._on_pdo(frame)

    def _heard(self, state: int) -> None:
        self._state = state
        if self._running and state != OPERATIONAL:
            what = "has restarted" if state == BOOT_UP else f"has left the operational state ({state:02X}h)"
            self._latch(what, "Check its power, then reset")

    def _latch(self, what: str, remedy: str) -> None:
        if self._running and self._fault is None:
            self._fault = DeviceError(f"{self.name}: node {self.node_id} {what}", remedy)
