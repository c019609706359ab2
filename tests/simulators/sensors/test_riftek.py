"""The simulated RIFTEK head: the manual's bytes, true timing, three protocols, strictness."""

import itertools

import numpy as np
import pytest

from estimation.transform import FloatArray
from simulators.modbus_slave import crc
from simulators.sensors.riftek import Rf60x
from simulators.sensors.riftek_head import ASCII, AUTOSTART, HOLD, MODBUS_RTU, PERIOD, RiftekSpec
from tests.simulators.line import Host

BYTE_S = 11 / 9600


class Target:
    """What the beam meets, in mm from the base surface; None for nothing."""

    def __init__(self, mm: float | None) -> None:
        self.mm = mm

    def beam_lengths_m(self, times_s: FloatArray) -> FloatArray:
        return np.full(len(times_s), np.nan if self.mm is None else self.mm * 1e-3)


def head(mm: float | None = 82.066, **spec: object) -> tuple[Host, Target, Rf60x]:
    target = Target(mm)
    laser = Rf60x(RiftekSpec(**spec), target, 0.0, 0.0, np.random.default_rng(1))  # type: ignore[arg-type]
    return Host(laser), target, laser


def results(wire: bytes) -> list[int]:
    assert len(wire) % 4 == 0
    return [
        sum((byte & 15) << 4 * i for i, byte in enumerate(wire[at : at + 4])) for at in range(0, len(wire), 4)
    ]


def rtu(text: str) -> bytes:
    body = bytes.fromhex(text)
    return body + crc(body)


def test_identity_as_in_the_manual() -> None:
    host, _, _ = head()
    assert host.ask("01 81") == "9F 93 90 99 91 92 93 94 90 95 90 90 92 93 90 90"


def test_result_as_in_the_manual() -> None:
    host, _, _ = head()
    host.ask("01 81"), host.ask("01 82 82 80")
    assert host.ask("01 86") == "F5 FA F2 F0"


def test_a_result_not_refreshed_since_is_marked() -> None:
    host, _, _ = head(parameters=((PERIOD + 1, 0xFF),))  # 65 ms
    first, second = host.ask("01 86", 0.01), host.ask("01 86", 0.01)
    assert [int(answer[:2], 16) >> 6 for answer in (first, second)] == [3, 2]
    assert results(bytes.fromhex(first)) == results(bytes.fromhex(second))


def test_parameters_are_written_without_an_answer_and_read_back() -> None:
    host, _, _ = head()
    assert host.ask("01 83 82 80 81 80") == ""
    assert host.ask("01 82 82 80") == "91 90"
    assert host.ask("01 82 8F 8F") == ""  # no such parameter


def test_what_is_not_saved_is_lost_with_the_power() -> None:
    host, _, laser = head()
    host.ask("01 83 86 80 84 80")
    laser.restart(host.time_s)
    assert host.ask("01 81", 0.1) == ""  # it boots
    host.wait(1.0)
    assert host.ask("01 82 86 80").startswith("91 90")
    host.ask("01 83 86 80 84 80")
    assert host.ask("01 84 8A 8A") == "AA AA"
    laser.restart(host.time_s)
    host.wait(1.1)
    assert host.ask("01 82 86 80") == "94 90"


@pytest.mark.parametrize("request_", ["02 81", "01 01", "01 91", "81 81", "01 89", "01 84 80 80"])
def test_what_is_not_for_it_is_not_answered(request_: str) -> None:
    host, _, _ = head()
    assert host.ask(request_) == ""
    assert host.ask("01 81") != ""


def test_a_first_byte_restarts_a_request_that_was_cut() -> None:
    host, _, _ = head()
    assert host.ask("01 83 82 01 86").startswith("D5")


def test_broadcast_latch_keeps_the_result_for_the_one_who_asks() -> None:
    host, target, _ = head()
    assert host.ask("00 85") == ""
    target.mm = 100.0
    assert results(bytes.fromhex(host.ask("01 86"))) == [677]
    assert results(bytes.fromhex(host.ask("01 86"))) == [round(20 / 50 * 0x4000)]


def test_the_stream_follows_the_sampling_period_and_numbers_its_packets() -> None:
    host, _, _ = head()
    host.send("01 87")
    wire = host.wait(1.0)
    assert len(wire) // 4 == pytest.approx(200, abs=3)
    numbers = [byte >> 4 & 3 for byte in wire[::4]]
    assert all((b - a) % 4 == 1 for a, b in itertools.pairwise(numbers))
    assert all(byte & 0xC0 == 0xC0 for byte in wire)
    host.send("01 88")
    host.wait(0.05)
    assert host.wait(1.0) == b""


def test_the_line_carries_no_more_than_its_baud_rate() -> None:
    host, _, _ = head(parameters=((PERIOD, 1000 & 0xFF), (PERIOD + 1, 1000 >> 8)))
    host.send("01 87")
    assert len(host.wait(1.0)) <= 1.0 / BYTE_S


def test_an_answer_takes_its_time() -> None:
    host, _, laser = head()
    host.send("01 81")
    assert laser.take(host.time_s + 2 * BYTE_S) == b""
    assert len(laser.take(host.time_s + 0.003 + 4 * BYTE_S)) <= 4
    assert len(laser.take(host.time_s + 0.004 + 19 * BYTE_S)) > 8


def test_nothing_seen_is_held_and_then_zero() -> None:
    host, target, _ = head(parameters=((HOLD, 4),))  # 20 ms
    host.send("01 87")
    host.wait(0.5)
    target.mm = None
    held = results(host.wait(0.1))
    assert held[0] == 677 and held[-1] == 0
    assert held.count(677) in (3, 4, 5, 6)


def test_a_discarded_stream_is_gone_and_keeps_its_numbering() -> None:
    host, target, laser = head()
    host.send("01 87")
    before = host.wait(0.5)[-1] >> 4 & 3
    host.time_s += 10.0
    laser.discard(host.time_s)
    target.mm = 100.0
    after = host.wait(0.1)
    assert set(results(after)) == {round(20 / 50 * 0x4000)}
    assert before in range(4)


def test_it_may_stream_by_itself_after_power_on() -> None:
    host, _, laser = head(parameters=((AUTOSTART, 1),))
    laser.restart(host.time_s)
    assert host.wait(20.0) == b""
    assert len(host.wait(2.0)) // 4 == pytest.approx(200, abs=5)


def test_ascii_as_in_the_manual() -> None:
    spec = {"device_type": 603, "firmware": 40, "serial_number": 19999, "base_mm": 125, "range_mm": 500}
    host, _, _ = head(200.0, protocol=ASCII, **spec)
    host.send(b"V\r\n")
    assert host.wait() == b"603\n40\n19999\n125\n500\r\n"
    host.send(b"R0\r\n")
    assert host.wait() == b"%d\r\n" % round(75 / 500 * 0x4000)
    for line, answer in ((b"W0\r\n", b"OK\r\n"), (b"W9\r\n", b""), (b"PR", b"")):
        host.send(line)
        assert host.wait() == answer
    host.send(b"T\r\n")
    assert host.wait() == b"OK\r\n"
    assert host.ask("01 81") != ""


def test_modbus_result_as_calculated() -> None:
    host, _, _ = head(protocol=MODBUS_RTU, base_mm=125, range_mm=500, mm=125 + 485.046)
    assert host.ask("01 04 00 06 00 01 D1 CB") == "01 04 02 3E 16 28 9E"


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("01 04 0001 0005", "01 04 0A 003F 0090 4321 0050 0032"),
        ("01 03 000E 0001", "01 03 02 0004"),
        ("01 06 000F 0004", "01 06 000F 0004"),
        ("01 10 0010 0002 04 1388 0C80", "01 10 0010 0002"),
        ("01 04 0007 0001", "01 84 02"),
        ("01 04 0000 0001", "01 84 02"),
        ("01 03 0016 0001", "01 83 02"),  # reserved
        ("01 03 0001 0001", "01 83 02"),  # an input register
        ("01 06 000F 0081", "01 86 03"),
        ("01 06 0028 0001", "01 86 03"),
        ("01 03 000E 0000", "01 83 03"),
        ("01 10 000E 0002 02 0001", "01 90 03"),
        ("01 2B 0E 01 00", "01 AB 01"),
        ("01 01 0000 0001", "01 81 01"),
    ],
)
def test_modbus_answers_and_refusals(request_: str, answer: str) -> None:
    host, _, _ = head(protocol=MODBUS_RTU)
    assert host.ask(rtu(request_)) == rtu(answer).hex(" ").upper()


@pytest.mark.parametrize("request_", ["02 04 0001 0001", "00 04 0001 0001", "00 06 000F 0004"])
def test_modbus_slaves_are_silent_for_others_and_after_a_broadcast(request_: str) -> None:
    host, _, laser = head(protocol=MODBUS_RTU)
    assert host.ask(rtu(request_)) == ""
    assert laser.parameters[0x06] == (4 if request_.startswith("00 06") else 1)


def test_a_modbus_frame_with_a_wrong_crc_or_a_pause_in_it_is_not_answered() -> None:
    host, _, _ = head(protocol=MODBUS_RTU)
    assert host.ask("01 04 00 06 00 01 D1 CC") == ""
    host.send("01 04 00 06")
    host.wait(0.05)
    assert host.ask("00 01 D1 CB") == ""
    assert host.ask("01 04 00 06 00 01 D1 CB") != ""


def test_where_register_one_lies_is_a_setting() -> None:
    host, _, _ = head(protocol=MODBUS_RTU, first_register=0)
    assert host.ask(rtu("01 04 0000 0001")) == rtu("01 04 02 003F").hex(" ").upper()
