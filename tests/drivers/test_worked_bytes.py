"""Byte examples of the manuals as a driver receives them, beside those in the tests of each codec."""

import numpy as np
import pytest

from drivers.links.interfaces import CanFrame
from drivers.links.modbus import ModbusClient
from drivers.links.modbus_rtu import ModbusRtu
from drivers.links.modbus_tcp import ModbusTcp
from drivers.sensors import gocator
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
