"""Byte examples and traps of the manuals as a driver meets them, beside those in the tests of each codec."""

import numpy as np
import pytest

from drivers.links.interfaces import CanFrame
from drivers.links.modbus import ModbusClient
from drivers.links.modbus_rtu import ModbusRtu
from drivers.links.modbus_tcp import ModbusTcp
from drivers.probes.adam6052 import AdamProbe, ProbeConfig
from drivers.sensors import gocator, optoncdt_codec
from drivers.sensors.ams335i import Ams335i, AmsConfig
from drivers.sensors.riftek_codec import distances
from tests.drivers.fakes import FakeByteLink, VirtualClock


def answered(client: type[ModbusClient], question: str, answer: str, **settings: object) -> ModbusClient:
    """A client whose next request must be `question`."""
    link = FakeByteLink(VirtualClock())

    def reply(sent: bytes) -> None:
        assert sent == bytes.fromhex(question)
        link.later(0.001, bytes.fromhex(answer))

    link.on_write = reply
    made = client(link, link.clock, name="Device", **settings)  # type: ignore[call-arg]
    return made


def signed(words: list[int]) -> list[int]:
    return [word - 0x10000 if word & 0x8000 else word for word in words]


def test_ft300_reads_all_six() -> None:
    client = answered(
        ModbusRtu,
        "09 03 00 B4 00 06 84 A6",
        "09 03 0C 04 D2 FD C9 26 94 00 7B FE 38 03 E8 64 C4",
        unit=9,
        baud=19200,
    )
    words = client.read_holding_registers(180, 6)
    assert signed(words) == [1234, -567, 9876, 123, -456, 1000]


def test_ft300_takes_the_order_to_stream() -> None:
    client = answered(
        ModbusRtu, "09 10 01 9A 00 01 02 02 00 CD CA", "09 10 01 9A 00 01 21 52", unit=9, baud=19200
    )
    client.write_registers(410, [0x0200])
    assert (client.frames, client.bad_frames) == (1, 0)


def test_riftek_measured_value() -> None:
    client = answered(
        ModbusRtu,
        "01 04 00 06 00 01 D1 CB",
        "01 04 02 3E 16 28 9E",
        unit=1,
        baud=9600,
        bits_per_byte=11,
    )
    (result,) = client.read_input_registers(6, 1)
    assert result == 15894
    assert distances(np.array([result]), 0.5) == pytest.approx([0.485046], abs=5e-7)


def test_gocator_without_a_value() -> None:
    """80000000h and a decision of "fail, invalid value" are no distance."""
    link = FakeByteLink(VirtualClock())
    link.on_write = lambda sent: link.later(
        0.001, sent[:2] + bytes.fromhex("00 00 00 09 01 03 06 80 00 00 00 00 02")
    )
    *value, decision = ModbusTcp(link, link.clock, name="Laser").read_holding_registers(1000, 3)
    assert gocator._number(value, signed=True) == gocator.INVALID
    assert gocator.NO_VALUE[decision >> 1] == "invalid value" and not decision & 1


@pytest.mark.parametrize(
    ("data", "distance_m", "why"),
    [
        ("40 E2 01 00 00 00 00 00", 12.3456, ""),
        ("00 00 00 00 00 00 01 00", None, "implausible value"),
    ],
)
def test_ams_position_and_status(data: str, distance_m: float | None, why: str) -> None:
    class Bus:
        def __init__(self) -> None:
            self.sent = list[int]()

        def send(self, can_id: int, data: bytes) -> None:
            self.sent.append(can_id)

        def receive(self, timeout_s: float) -> list[CanFrame]:
            asked, self.sent = bool(self.sent), []
            return [CanFrame(0x290, bytes.fromhex(data), 0.0)] if asked else []

    laser = Ams335i(Bus(), AmsConfig(16), VirtualClock())  # type: ignore[arg-type]
    answer = laser._ask()
    assert answer.why == why
    if distance_m is not None:
        assert answer.distance_m == pytest.approx(distance_m)


# --- traps in the documents ---------------------------------------------------------------------------


def test_the_range_of_an_optoncdt_ends_where_manual_and_formula_say() -> None:
    """64877; one public parser has 64887."""
    codes = np.array([64877, 64878, 64887])
    assert optoncdt_codec.in_range(codes).tolist() == [True, False, False]


@pytest.mark.parametrize(("measurement", "value"), [(0, 1000), (4, 1012)])
def test_the_decision_of_a_gocator_stands_two_behind_its_value(measurement: int, value: int) -> None:
    """Of measurement 4 that is 1014: the manual's text says 1015, its map 1014."""
    asked = list[tuple[int, int]]()

    class Registers(FakeModbus):
        def read_holding_registers(self, address: int, count: int) -> list[int]:
            asked.append((address, count))
            return [0] * count

    head = gocator.Gocator(
        FakeByteLink(VirtualClock()), gocator.GocatorConfig(0.3, 200.0, measurement), VirtualClock()
    )
    head._modbus = Registers()  # type: ignore[assignment]
    head._newest()
    first, count = asked[-1]
    assert first + count - 1 == value + 2


class FakeModbus:
    received_s = 0.0


def test_an_adam_whose_addresses_begin_at_one() -> None:
    """Manual and public clients disagree by one: the offset is a setting, and holds for all registers."""
    asked = list[bytes]()
    link = FakeByteLink(VirtualClock())

    def reply(sent: bytes) -> None:
        asked.append(sent[7:12])
        size = 1 if sent[7] == 2 else 4
        name = b"\x60\x52\0\0" if sent[7] == 3 else b"\0" * size
        link.later(0.001, sent[:4] + bytes((0, 3 + size)) + sent[6:8] + bytes((size,)) + name)

    link.on_write = reply
    AdamProbe(link, ProbeConfig(channel=2, address_offset=1), link.clock).connect()
    assert asked == [
        bytes.fromhex(words) for words in ("03 00D3 0002", "02 0003 0001", "04 0005 0002")
    ]  # name at 210, input 2, counter at 4
