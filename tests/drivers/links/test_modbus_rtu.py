"""Modbus RTU: a reply that comes late, twice, cut, damaged or from another unit is never a value."""

import struct
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.links.modbus import ModbusRefusal
from drivers.links.modbus_rtu import ModbusRtu
from estimation.errors import DeviceError, DeviceTimeout, FrameError, IdentityMismatch
from simulators.modbus_slave import crc
from tests.drivers.fakes import FakeByteLink, VirtualClock

WORST_S = 0.1


class Slave(FakeByteLink):
    """Every register holds its own address. `tamper(number, reply)` gives what is sent, and when."""

    def __init__(self, clock: VirtualClock) -> None:
        super().__init__(clock)
        self.on_write = self._answer
        self.asked = 0
        self.tamper: Callable[[int, bytes], list[tuple[float, bytes]]] = lambda number, reply: [(0.02, reply)]

    def _answer(self, request: bytes) -> None:
        assert crc(request[:-2]) == request[-2:]
        self.asked += 1
        function, address, count = request[1], *struct.unpack_from(">HH", request, 2)
        if function in (3, 4):
            words = struct.pack(f">{count}H", *range(address, address + count))
            reply = bytes([request[0], function, 2 * count]) + words
        else:
            reply = request[:6]
        for delay_s, data in self.tamper(self.asked, reply + crc(reply)):
            self.later(delay_s, data)


def line(**settings: object) -> tuple[ModbusRtu, Slave]:
    clock = VirtualClock()
    slave = Slave(clock)
    client = ModbusRtu(slave, clock, name="Gauge", unit=9, baud=19200, worst_answer_s=WORST_S, **settings)  # type: ignore[arg-type]
    return client, slave


def read(client: ModbusRtu, *addresses: int) -> list[int | type]:
    """Values, or the kind of error, of reads in a row."""
    got: list[int | type] = []
    for address in addresses:
        try:
            got += client.read_holding_registers(address, 1)
        except DeviceError as error:
            got.append(type(error))
    return got


def test_frames_as_in_the_manuals() -> None:
    client, slave = line()
    client.read_holding_registers(180, 6)
    assert slave.sent[-1] == bytes.fromhex("09 03 00 B4 00 06 84 A6")
    client.write_registers(410, [0x0200])
    assert slave.sent[-1] == bytes.fromhex("09 10 01 9A 00 01 02 02 00 CD CA")


@pytest.mark.parametrize("late_s", [0.11, 0.15, 0.19])
def test_a_late_reply_is_never_taken_for_the_next_one(late_s: float) -> None:
    client, slave = line()
    slave.tamper = lambda number, reply: [(late_s if number == 1 else 0.02, reply)]
    assert read(client, 1, 5, 6, 7, 8) == [DeviceTimeout, 5, 6, 7, 8]
    assert client.timeouts == 1


def test_a_doubled_reply_is_never_taken_for_the_next_one() -> None:
    client, slave = line()
    slave.tamper = lambda number, reply: [(0.02, reply), (0.025, reply)] if number == 1 else [(0.02, reply)]
    assert read(client, 1) == [1]
    slave.clock.sleep(0.03)
    assert read(client, 5, 6, 7) == [5, 6, 7]
    assert client.bad_frames == 1
    slave.tamper = lambda number, reply: [(0.02, reply + reply)]
    assert read(client, 5) == [FrameError]


def test_nothing_is_asked_again_by_itself() -> None:
    client, slave = line()
    slave.tamper = lambda number, reply: []
    assert read(client, 1) == [DeviceTimeout]
    assert slave.asked == 1


def test_after_a_failure_the_line_is_silent_and_says_who_it_is() -> None:
    names = [7, 8, 7]
    client, slave = line(on_resync=lambda: check(client, names.pop(0)))

    def check(client: ModbusRtu, expected: int) -> None:
        if client.read_holding_registers(7, 1) != [expected]:
            raise IdentityMismatch("Another gauge", "Connect the right one")

    slave.tamper = lambda number, reply: [] if number == 1 else [(0.02, reply)]
    assert read(client, 1) == [DeviceTimeout]
    before_s = slave.clock.now_s()
    assert read(client, 2) == [2]
    assert slave.clock.now_s() - before_s > WORST_S
    slave.tamper = lambda number, reply: [] if number == 4 else [(0.02, reply)]
    assert read(client, 1, 2, 3, 4) == [DeviceTimeout, IdentityMismatch, 3, 4]


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda frame: frame[:-1] + bytes([frame[-1] ^ 1]), "wrong CRC"),
        (lambda frame: framed(b"\x08" + frame[1:-2]), "unit 8 instead of 9"),
        (lambda frame: framed(b"\x09\x04" + frame[2:-2]), "function 4 instead of 3"),
        (lambda frame: framed(b"\x09\x03\x04" + frame[3:-2]), "03 04 instead of 03 02"),
        (lambda frame: frame[:-2], "5 of 7 bytes"),
        (lambda frame: b"\x00" + frame, "bytes instead of 7"),
        (lambda frame: b"\x00" + frame[:-1], "wrong CRC"),
    ],
)
def test_what_is_not_the_reply_is_refused(spoil: Callable[[bytes], bytes], said: str) -> None:
    client, slave = line()
    slave.tamper = lambda number, reply: [(0.02, spoil(reply))] if number == 1 else [(0.02, reply)]
    with pytest.raises(DeviceError, match=said):
        client.read_holding_registers(3, 1)
    assert read(client, 4) == [4]


def framed(body: bytes) -> bytes:
    return body + crc(body)


def test_an_exception_is_a_refusal_and_leaves_the_line_in_step() -> None:
    client, slave = line()
    slave.tamper = lambda number, reply: [(0.02, framed(b"\x09\x83\x02"))] if number == 1 else [(0.02, reply)]
    with pytest.raises(ModbusRefusal, match="illegal address") as refusal:
        client.read_holding_registers(999, 1)
    assert refusal.value.code == 2
    before_s = slave.clock.now_s()
    assert read(client, 4) == [4]
    assert slave.clock.now_s() - before_s < WORST_S


def test_an_adapter_may_return_what_is_sent() -> None:
    client, slave = line(echo=True)
    answer = slave.on_write

    def echoed(data: bytes) -> None:
        slave.later(0.005, data)
        answer(slave.sent[-1])

    slave.on_write = echoed
    assert read(client, 3) == [3]
    client.write_register(4, 1)
    slave.on_write = lambda data: echoed(b"\x09\x04" + data[2:])
    with pytest.raises(FrameError, match="echo"):
        client.read_holding_registers(3, 1)


def test_a_line_that_babbles_is_told() -> None:
    client, slave = line()
    for i in range(100):
        slave.later(0.02 * i, b"\x55")
    slave.clock.sleep(0.01)
    with pytest.raises(FrameError, match="without being asked"):
        client.read_holding_registers(3, 1)


@given(st.lists(st.sampled_from(["good", "late", "lost", "twice", "cut", "noise"]), min_size=1, max_size=12))
def test_whatever_happens_a_value_belongs_to_its_request(fates: list[str]) -> None:
    client, slave = line()

    def tamper(number: int, reply: bytes) -> list[tuple[float, bytes]]:
        return {
            "good": [(0.02, reply)],
            "late": [(0.115, reply)],
            "lost": [],
            "twice": [(0.02, reply), (0.021, reply)],
            "cut": [(0.02, reply[:4]), (0.115, reply[4:])],
            "noise": [(0.01, b"\x09\x03"), (0.02, reply)],
        }[fates[number - 1] if number <= len(fates) else "good"]

    slave.tamper = tamper
    for address in range(1, 40):
        (got,) = read(client, address)
        assert got == address or isinstance(got, type)
        slave.clock.sleep(0.002)
    assert got == 39
