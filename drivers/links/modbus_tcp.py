"""Modbus TCP requests, one at a time, on a ByteLink. Frames and PDUs are pymodbus's; deadlines are ours.

After a timeout a late reply is on its way: the link stays silent, drains, and only then asks again. Replies
are matched by transaction number, unit, function and length.
"""

import functools
import itertools
from collections.abc import Callable
from typing import Any, Final

from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU, ModbusPDU

from drivers.clock import Clock
from drivers.links.interfaces import ByteLink
from drivers.links.modbus import BUSY_CODES, ModbusClient, refusal
from estimation.errors import DeviceError, DeviceTimeout, FrameError

HEADER_BYTES: Final = 7
MOST_BYTES: Final = 260
BUSY_RETRIES: Final = 3
BUSY_PAUSE_S: Final = 0.05


class ModbusTcp(ModbusClient):
    """A client of one unit. `on_resync` is called after the silence that follows a timeout."""

    def __init__(
        self,
        link: ByteLink,
        clock: Clock,
        *,
        name: str,
        unit: int = 1,
        reply_timeout_s: float = 0.2,
        tries: int = 2,
        silence_s: float = 0.05,
        on_resync: Callable[[], None] | None = None,
    ) -> None:
        super().__init__()
        self._link, self._clock, self._name, self._unit = link, clock, name, unit
        self._reply_timeout_s, self._tries, self._silence_s = reply_timeout_s, tries, silence_s
        self._on_resync = on_resync
        decoder = DecodePDU(is_server=False)
        self._framer = FramerSocket(decoder)
        # A touch asks the same thing hundreds of times, and is told the same until it is one.
        self._decode = functools.lru_cache(maxsize=16)(decoder.decode)
        self._transactions = itertools.cycle(range(1, 0x10000))
        self._received = b""
        self._out_of_step = self._resynchronising = False

    def reset(self) -> None:
        """Forget what was received: after the link was opened."""
        self._received, self._out_of_step = b"", False

    def _ask(self, request: Any, head: bytes, length: int) -> ModbusPDU:
        busy = 0
        failures = list[DeviceError]()
        while len(failures) < (1 if self._resynchronising else self._tries):
            try:
                self._resynchronise()
                reply = self._exchange(request, head, length)
            except (DeviceTimeout, FrameError) as failure:
                self._out_of_step = True
                failures.append(failure)
                continue
            if not reply.isError():
                return reply
            if reply.exception_code not in BUSY_CODES or busy == BUSY_RETRIES:
                raise refusal(self._name, request, reply.exception_code)
            busy += 1
            self._clock.sleep(BUSY_PAUSE_S)
        raise failures[-1]

    def _resynchronise(self) -> None:
        """After a timeout: silence until nothing comes any more, then prove who answers."""
        if not self._out_of_step or self._resynchronising:
            return
        deadline_s = self._clock.now_s() + 4 * self._silence_s
        while self._link.read(self._silence_s):
            if self._clock.now_s() > deadline_s:
                raise FrameError(f"{self._name} sends without being asked", "Reset the connection")
        self._received = b""
        if self._on_resync is not None:
            self._resynchronising = True
            try:
                self._on_resync()
            finally:
                self._resynchronising = False
        self._out_of_step = False

    def _exchange(self, request: Any, head: bytes, length: int) -> ModbusPDU:
        request.dev_id, request.transaction_id = self._unit, next(self._transactions)
        self.sent_s = now = self._clock.now_s()
        deadline_s = now + self._reply_timeout_s
        self._link.write(self._framer.buildFrame(request))
        while True:
            while (frame := self._next_frame()) is not None:
                reply = self._matching(frame, request, head, length)
                if reply is not None:
                    self.received_s = self._clock.now_s()
                    self.frames += 1
                    return reply
            remaining_s = deadline_s - self._clock.now_s()
            if remaining_s <= 0.0:
                self.timeouts += 1
                raise DeviceTimeout(
                    f"{self._name}: no answer within {self._reply_timeout_s:g} s", "Check cable and power"
                )
            self._received += self._link.read(remaining_s)

    def _next_frame(self) -> tuple[int, int, bytes] | None:
        """Transaction, unit and PDU of the next complete frame."""
        head = self._received
        if len(head) < HEADER_BYTES + 1:
            return None
        self._refuse_unless_frame(head)
        used, unit, transaction, pdu = self._framer.decode(head)
        if not used:
            return None
        self._received = head[used:]
        if self._received:  # a reply that came twice, or one with a byte too many
            self._refuse_unless_frame(self._received)
        return transaction, unit, pdu

    def _refuse_unless_frame(self, data: bytes) -> None:
        length = int.from_bytes(data[4:6], "big")
        if len(data) < HEADER_BYTES or data[2:4] != b"\0\0" or not 2 <= length <= MOST_BYTES - 6:
            self.bad_frames += 1
            self._received = b""
            raise FrameError(
                f"{self._name} sent {data[:8].hex(' ')}, not a Modbus TCP frame", "Check host and port"
            )

    def _matching(
        self, frame: tuple[int, int, bytes], request: Any, head: bytes, length: int
    ) -> ModbusPDU | None:
        """The reply in this frame; None if it answers something else."""
        transaction, unit, pdu = frame
        if transaction != request.transaction_id:
            self.bad_frames += 1  # late: the request that it answers was given up
            return None
        function = request.function_code
        if unit != self._unit:
            problem = f"{self._name}: reply from unit {unit} while asking {self._unit}"
        elif pdu[0] & 0x7F != function:
            problem = f"{self._name}: reply to function {pdu[0] & 0x7F} while asking {function}"
        elif pdu[0] == function and len(pdu) != length:
            problem = f"{self._name}: reply of {len(pdu)} bytes instead of {length}"
        elif pdu[0] == function and not pdu.startswith(head):
            problem = f"{self._name}: reply begins with {pdu[: len(head)].hex(' ')}, not {head.hex(' ')}"
        elif (reply := self._decode(pdu)) is None:
            problem = f"{self._name}: unreadable reply {pdu.hex(' ')}"
        else:
            return reply
        self.bad_frames += 1
        raise FrameError(problem, "Check that only this controller talks to the device")
