"""Modbus TCP transactions and the touch probe, against a scripted module in virtual time."""

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.links.modbus import ModbusRefusal
from drivers.links.modbus_tcp import ModbusTcp
from drivers.probes.adam6052 import AdamProbe, ProbeConfig
from estimation.errors import DeviceError, DeviceTimeout, FrameError, IdentityMismatch
from tests.drivers.fakes import FakeByteLink, VirtualClock


class FakeModule(FakeByteLink):
    """Answers FC 2, 3 and 4; `tamper(number, request, reply)` gives when an answer leaves, and which."""

    def __init__(self, clock: VirtualClock) -> None:
        super().__init__(clock)
        self.on_write = self._answer
        self.count, self.closed, self.name = 0, False, (0x6052, 0)
        self.requests = 0
        self.tamper: Callable[[int, bytes, bytes], tuple[float, bytes]] = lambda n, request, reply: (
            3e-4,
            reply,
        )

    def _answer(self, request: bytes) -> None:
        function, address, quantity = (
            request[7],
            *(int.from_bytes(request[i : i + 2], "big") for i in (8, 10)),
        )
        if function == 2:
            payload = bytes([1, self.closed << 0 if address == 0 else 0])
        else:
            words = {0: self.count & 0xFFFF, 1: self.count >> 16, 210: self.name[0], 211: self.name[1]}
            values = [words.get(address + i, 0) for i in range(quantity)]
            payload = bytes([2 * quantity]) + b"".join(value.to_bytes(2, "big") for value in values)
        reply = request[:4] + (2 + len(payload)).to_bytes(2, "big") + request[6:8] + payload
        self.requests += 1
        delay_s, data = self.tamper(self.requests, request, reply)
        self.later(delay_s, data)


def client(link: FakeByteLink) -> ModbusTcp:
    return ModbusTcp(link, link.clock, name="ADAM-6052")


def connected(**settings: object) -> tuple[AdamProbe, FakeModule, VirtualClock]:
    clock = VirtualClock()
    link = FakeModule(clock)
    probe = AdamProbe(link, ProbeConfig(**settings), clock)  # type: ignore[arg-type]
    probe.connect()
    return probe, link, clock


def test_worked_frames_of_the_manual() -> None:
    link = FakeByteLink(VirtualClock())
    modbus = client(link)
    for _ in range(5):
        next(modbus._transactions)
    link.on_write = lambda data: link.later(0.001, bytes.fromhex("00 06 00 00 00 04 01 02 01 05"))
    inputs = modbus.read_inputs(0, 8)
    assert [i for i, on in enumerate(inputs) if on] == [0, 2]
    link.on_write = lambda data: link.later(0.001, bytes.fromhex("00 07 00 00 00 07 01 04 04 11 70 00 01"))
    assert modbus.read_input_registers(4, 2) == [0x1170, 1]
    assert link.sent == [
        bytes.fromhex("00 06 00 00 00 06 01 02 00 00 00 08"),
        bytes.fromhex("00 07 00 00 00 06 01 04 00 04 00 02"),
    ]


def test_counter_takes_the_low_word_first() -> None:
    probe, link, _ = connected()
    link.count = 70_000
    assert probe._counter() == 70_000


@given(st.integers(1, 11), st.integers(0, 0xFFFF))
def test_replies_may_come_in_pieces(cut: int, value: int) -> None:
    clock = VirtualClock()
    link = FakeByteLink(clock)

    def answer(request: bytes) -> None:
        reply = request[:4] + b"\0\x05\x01\x04\x02" + value.to_bytes(2, "big")
        link.later(0.001, reply[:cut])
        link.later(0.002, reply[cut:])

    link.on_write = answer
    assert client(link).read_input_registers(0, 1) == [value]


def test_a_late_reply_is_never_taken_for_the_next_one() -> None:
    clock = VirtualClock()
    link = FakeByteLink(clock)
    asked = 0

    def answer(request: bytes) -> None:
        nonlocal asked
        asked += 1
        value = request[8:10]  # each register holds its own address
        link.later(0.22 if asked == 1 else 0.001, request[:4] + b"\0\x05\x01\x04\x02" + value)

    link.on_write = answer
    modbus = client(link)
    assert [modbus.read_input_registers(address, 1)[0] for address in (1, 5, 6, 7)] == [1, 5, 6, 7]
    assert modbus.timeouts == 1


def test_a_stale_transaction_within_the_deadline_is_dropped_and_counted() -> None:
    clock = VirtualClock()
    link = FakeByteLink(clock)

    def answer(request: bytes) -> None:
        link.later(
            0.001, b"\xab\xcd\0\0\0\x05\x01\x04\x02\x00\x63" + request[:4] + b"\0\x05\x01\x04\x02\x00\x07"
        )

    link.on_write = answer
    modbus = client(link)
    assert modbus.read_input_registers(0, 1) == [7]
    assert modbus.bad_frames == 1


def test_silence_ends_after_two_tries_within_half_a_second() -> None:
    link = FakeByteLink(VirtualClock())
    started_s = link.clock.time_s
    with pytest.raises(DeviceTimeout, match=r"ADAM-6052: no answer within 0\.2 s"):
        client(link).read_inputs(0, 1)
    assert len(link.sent) == 2
    assert link.clock.time_s - started_s < 0.5


@pytest.mark.parametrize(("code", "requests"), [(1, 1), (2, 1), (3, 1), (4, 1), (5, 4), (6, 4), (0x0B, 1)])
def test_exceptions_are_mapped_and_only_busy_is_asked_again(code: int, requests: int) -> None:
    link = FakeByteLink(VirtualClock())
    link.on_write = lambda request: link.later(0.001, request[:4] + b"\0\x03\x01\x84" + bytes([code]))
    with pytest.raises(ModbusRefusal, match="refused function 4 at address 40") as refusal:
        client(link).read_input_registers(40, 1)
    assert refusal.value.code == code
    assert len(link.sent) == requests
    assert ("cell file" in refusal.value.remedy) == (code <= 3)


@pytest.mark.parametrize(
    ("reply", "message"),
    [
        ("00 00 00 05 04 04 02 00 07", "reply from unit 4 while asking 1"),
        ("00 00 00 05 01 03 02 00 07", "reply to function 3 while asking 4"),
        ("00 00 00 07 01 04 04 00 07 00 08", "reply of 6 bytes instead of 4"),
        ("12 34 00 05 01 04 02 00 07", "not a Modbus TCP frame"),
        ("00 00 ff 05 01 04 02 00 07", "not a Modbus TCP frame"),
    ],
)
def test_wrong_replies_are_frame_errors(reply: str, message: str) -> None:
    link = FakeByteLink(VirtualClock())
    link.on_write = lambda request: link.later(0.001, request[:2] + bytes.fromhex(reply))
    with pytest.raises(FrameError, match=message):
        client(link).read_input_registers(0, 1)


@given(st.binary(min_size=1, max_size=60))
def test_garbage_ends_in_an_error_of_ours(garbage: bytes) -> None:
    link = FakeByteLink(VirtualClock())
    link.on_write = lambda request: link.later(0.001, garbage)
    with pytest.raises(DeviceError):
        client(link).read_input_registers(0, 1)


def test_identity_of_another_module_is_refused() -> None:
    clock = VirtualClock()
    link = FakeModule(clock)
    link.name = (0x6060, 0)
    with pytest.raises(IdentityMismatch, match="says 6060 0000, the cell file ADAM-6052"):
        AdamProbe(link, ProbeConfig(), clock).connect()


def test_a_touch_is_seen_by_its_edge_even_when_it_is_over() -> None:
    probe, link, clock = connected()
    probe.arm()
    assert probe.touched_at_s() is None
    contact_s = clock.time_s
    link.count += 1  # closed and open again between two polls
    touched_s = probe.touched_at_s()
    assert touched_s is not None
    assert 0.0 <= touched_s - contact_s <= probe.poll_uncertainty_s
    assert probe.touched_at_s() == touched_s
    probe.arm()
    assert probe.touched_at_s() is None


def test_polls_keep_their_period() -> None:
    probe, link, clock = connected(poll_period_s=0.004)
    probe.arm()
    began_s, asked = clock.time_s, link.requests
    while clock.time_s < began_s + 0.1:
        probe.touched_at_s()
    assert link.requests - asked == pytest.approx(25, abs=1)


def test_bounce_is_one_touch_and_noted() -> None:
    probe, link, _ = connected()
    probe.arm()
    link.count += 3
    assert probe.touched_at_s() is not None
    assert probe.bounces == 2


def test_more_edges_than_the_input_can_count_are_no_touch() -> None:
    probe, link, _ = connected()
    probe.arm()
    link.count += 851_967  # what a damaged answer once gave
    with pytest.raises(DeviceError, match=r"counted 851967 edges in \d+ ms, at most \d\d? are possible"):
        probe.touched_at_s()
    assert probe.bounces == 0
    link.count -= 851_967 - 1
    assert probe.touched_at_s() is not None


def test_the_counter_may_wrap_but_not_go_back() -> None:
    probe, link, _ = connected()
    link.count = 0xFFFFFFFF
    probe.arm()
    link.count = 0
    assert probe.touched_at_s() is not None
    link.count = 5
    probe.arm()
    link.count = 0
    with pytest.raises(DeviceError, match="counter 0 went back, the module restarted"):
        probe.touched_at_s()


def test_a_tripped_probe_cannot_be_armed() -> None:
    probe, link, _ = connected()
    link.closed = True
    assert not probe.is_open()
    with pytest.raises(DeviceError, match="tripped before the approach"):
        probe.arm()
    link.closed = False
    assert probe.is_open()


def test_a_touch_between_polls_too_far_apart_is_refused() -> None:
    probe, link, clock = connected()
    probe.arm()
    clock.sleep(0.3)  # the computer stood still
    link.count += 1
    with pytest.raises(DeviceError, match=r"Touched between polls 30\d ms apart, limit 50 ms"):
        probe.touched_at_s()


def test_a_slow_poll_widens_the_stated_uncertainty() -> None:
    probe, link, clock = connected()
    probe.arm()
    clock.sleep(0.03)
    link.count += 1
    assert probe.touched_at_s() is not None
    assert probe.poll_uncertainty_s > 0.03


def test_after_a_timeout_the_identity_is_read_again() -> None:
    probe, link, _ = connected()
    probe.arm()
    lost = link.requests + 1
    link.tamper = lambda n, request, reply: (9.0 if n == lost else 3e-4, reply)
    assert probe.touched_at_s() is None
    assert [request[7] for request in link.sent[-3:]] == [4, 3, 4]
    lost = link.requests + 1
    link.name = (0x6060, 0)
    with pytest.raises(IdentityMismatch):
        probe.touched_at_s()


def test_a_lost_connection_is_told_and_connect_repairs_it() -> None:
    probe, link, _ = connected()
    link.gone = True
    with pytest.raises(DeviceError, match="gone"):
        probe.is_open()
    probe.connect()
    assert probe.is_open()
    assert probe.health().reconnects == 1


@pytest.mark.parametrize(
    ("ask", "request_", "reply"),
    [
        (lambda m: m.read_coils(16, 8), "01 0010 0008", "01 01 05"),
        (lambda m: m.write_coil(17, True), "05 0011 FF00", "05 0011 FF00"),
        (lambda m: m.write_register(0, 1), "06 0000 0001", "06 0000 0001"),
        (lambda m: m.write_registers(302, [0x80, 7]), "10 012E 0002 04 0080 0007", "10 012E 0002"),
    ],
)
def test_a_write_counts_once_the_reply_repeats_it(
    ask: Callable[[ModbusTcp], object], request_: str, reply: str
) -> None:
    link = FakeByteLink(VirtualClock())
    modbus = client(link)
    pdu = bytearray.fromhex(reply)

    def answer(request: bytes) -> None:
        link.later(0.001, request[:4] + (1 + len(pdu)).to_bytes(2, "big") + request[6:7] + pdu)

    link.on_write = answer
    ask(modbus)
    assert link.sent[-1][7:] == bytes.fromhex(request_)
    pdu[1] += 1  # another address, or another number of bytes
    with pytest.raises(FrameError, match="begins with"):
        ask(modbus)


def test_another_module_behind_the_connection_is_refused_until_the_right_one_is_back() -> None:
    probe, link, _ = connected()
    lost = iter([True])
    link.tamper = lambda number, request, reply: (9.0 if next(lost, False) else 3e-4, reply)
    link.name = (0x6050, 0)
    for _ in range(2):
        with pytest.raises(IdentityMismatch, match="6050"):
            probe.is_open()
    link.name = (0x6052, 0)
    assert probe.is_open()
