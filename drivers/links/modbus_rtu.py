"""Modbus RTU requests, one at a time, on a serial ByteLink. Frames and PDUs are pymodbus's; the rest is ours.

A reply names neither its register nor its request: see `in_step`. Nothing is asked again in here.
"""

from collections.abc import Callable
from typing import Any, Final

from pymodbus.framer import FramerRTU
from pymodbus.pdu import DecodePDU, ModbusPDU

from drivers.clock import Clock
from drivers.links.in_step import InStep
from drivers.links.interfaces import ByteLink
from drivers.links.modbus import ModbusClient, refusal
from estimation.errors import DeviceTimeout, FrameError

EXCEPTION_BYTES: Final = 5  # unit, function, code, CRC
FRAME_BYTES: Final = 3  # around a PDU: unit and CRC


class ModbusRtu(ModbusClient):
    """A client of one unit.

    `worst_answer_s` is the longest time between the end of a request and the start of its reply, with what a
    converter adds; `echo` is for two-wire adapters that return what they send. `on_resync` reads and compares
    an identity; it is called after the silence that follows a failure.
    """

    def __init__(
        self,
        link: ByteLink,
        clock: Clock,
        *,
        name: str,
        unit: int,
        baud: int,
        bits_per_byte: int = 10,
        worst_answer_s: float = 0.1,
        echo: bool = False,
        on_resync: Callable[[], None] | None = None,
    ) -> None:
        super().__init__()
        self._link, self._clock, self._name, self._unit = link, clock, name, unit
        self._byte_s, self._worst_answer_s = bits_per_byte / baud, worst_answer_s
        self._echo = echo
        self._step = InStep(link, clock, name, worst_answer_s, on_resync)
        self._decoder = DecodePDU(is_server=False)
        self._framer = FramerRTU(self._decoder)

    def reset(self) -> None:
        """Forget an earlier failure: after the link was opened and its input dropped."""
        self._step.reset()

    def _ask(self, request: Any, head: bytes, length: int) -> ModbusPDU:
        strays = self._step.strays
        try:
            with self._step.transaction():
                reply = self._exchange(request, head, length)
        finally:
            self.bad_frames += self._step.strays - strays
        self.frames += 1
        if reply.isError():
            raise refusal(self._name, request, reply.exception_code)
        return reply

    def _exchange(self, request: Any, head: bytes, length: int) -> ModbusPDU:
        request.dev_id = self._unit
        sent = self._framer.buildFrame(request)
        echoed = len(sent) if self._echo else 0
        self.sent_s = self._clock.now_s()
        on_the_way_s = (len(sent) + length + FRAME_BYTES) * self._byte_s
        self._link.write(sent)
        received = self._receive(echoed, length + FRAME_BYTES, self.sent_s + on_the_way_s)
        self.received_s = self._clock.now_s()
        if received[:echoed] != sent[:echoed]:
            raise self._bad(
                f"echo {received[:echoed].hex(' ')} of {sent.hex(' ')}", "Check wiring and baud rate"
            )
        return self._checked(received[echoed:], request.function_code, head, length)

    def _receive(self, echoed: int, size: int, sent_and_answered_s: float) -> bytes:
        """Echo and reply, by the deadline; not one byte more than they have."""
        deadline_s = sent_and_answered_s + self._worst_answer_s
        received = b""
        while True:
            refused = len(received) >= echoed + 2 and bool(received[echoed + 1] & 0x80)
            wanted = echoed + (EXCEPTION_BYTES if refused else size)
            if len(received) >= wanted:
                break
            remaining_s = deadline_s - self._clock.now_s()
            if remaining_s <= 0.0:
                self.timeouts += 1
                raise DeviceTimeout(
                    f"{self._name}: {len(received)} of {wanted} bytes in {deadline_s - self.sent_s:.2g} s",
                    "Check cable, power, baud rate, parity and unit number",
                )
            received += self._link.read(remaining_s)
        if len(received) > wanted:
            raise self._bad(
                f"{len(received)} bytes instead of {wanted}", "Look for a second master on the line"
            )
        return received

    def _checked(self, frame: bytes, function: int, head: bytes, length: int) -> ModbusPDU:
        pdu = frame[1:-2]
        if not self._framer.check_CRC(frame[:-2], int.from_bytes(frame[-2:], "big")):
            raise self._bad(f"{frame.hex(' ')} with a wrong CRC", "Check cable, baud rate and parity")
        if frame[0] != self._unit:
            raise self._bad(f"unit {frame[0]} instead of {self._unit}", "Give every unit its own number")
        if pdu[0] & 0x7F != function:
            raise self._bad(f"function {pdu[0] & 0x7F} instead of {function}", "Look for a second master")
        if pdu[0] == function and (len(pdu) != length or not pdu.startswith(head)):
            raise self._bad(f"{pdu[: len(head)].hex(' ')} instead of {head.hex(' ')}", "Check unit and model")
        reply = self._decoder.decode(pdu)
        if reply is None:
            raise self._bad(f"{pdu.hex(' ')}, which cannot be read", "Check unit and model")
        return reply

    def _bad(self, what: str, remedy: str) -> FrameError:
        self.bad_frames += 1
        return FrameError(f"{self._name} answered {what}", remedy)
