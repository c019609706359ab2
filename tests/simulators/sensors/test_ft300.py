"""The simulated FT 300: the manual's bytes, and what it does not answer."""

import numpy as np
import pytest

from estimation.transform import FloatArray
from simulators.modbus_slave import crc
from simulators.sensors.ft300 import Ft300, Ft300Spec
from tests.simulators.line import Host

WRENCH = np.array([12.34, -5.67, 98.76, 0.123, -0.456, 1.000])
FRAME = "20 4E D2 04 C9 FD 94 26 7B 00 38 FE E8 03 E2 E6"
READ_ALL = "09 03 00 B4 00 06 84 A6"
START = "09 10 01 9A 00 01 02 02 00 CD CA"


class Load:
    def wrenches(self, times_s: FloatArray) -> FloatArray:
        return np.tile(WRENCH, (len(times_s), 1))


def sensor(**spec: object) -> Host:
    return Host(Ft300(Ft300Spec(**spec), Load(), np.random.default_rng(1)))  # type: ignore[arg-type]


def rtu(text: str) -> bytes:
    body = bytes.fromhex(text)
    return body + crc(body)


def test_registers_of_the_manual() -> None:
    assert sensor().ask(READ_ALL) == "09 03 0C 04 D2 FD C9 26 94 00 7B FE 38 03 E8 64 C4"


def test_the_crc_that_the_manual_misprints_is_not_answered() -> None:
    assert sensor().ask("09 03 00 B4 00 06 04 A6") == ""


def test_a_stream_is_acknowledged_paced_and_ended() -> None:
    host = sensor()
    wire = host.ask(START, 1.0)
    assert wire.startswith("09 10 01 9A 00 01 21 52 " + FRAME)
    frames = bytes.fromhex(wire)[8:]
    assert frames == bytes.fromhex(FRAME) * (len(frames) // 16)
    assert len(frames) // 16 in (97, 98, 99)
    assert set(host.ask(READ_ALL, 0.1).split(" 20 4E ")) <= {FRAME, FRAME[6:]}  # no Modbus while it streams
    host.send(b"\xff" * 20)
    assert len(host.wait(0.5)) > 700  # too few
    host.send(b"\xff" * 50)
    host.wait(0.1)
    assert host.wait(1.0) == b""
    assert host.ask(READ_ALL) != ""


def test_an_unread_stream_is_lost_and_goes_on() -> None:
    host = sensor()
    host.ask(START, 0.1)
    host.time_s += 100.0
    host.device.discard(host.time_s)
    assert len(host.wait(1.0)) // 16 in (99, 100, 101)


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("09 03 00BE 0003", "09 03 06 0000 0000 FC18"),
        ("09 03 0202 0001", "09 03 02 07E8"),
        ("09 03 00B3 0001", "09 83 02"),
        ("09 04 00B4 0001", "09 84 01"),
        ("09 06 019A 0200", "09 86 01"),
        ("09 10 019A 0001 02 0100", "09 90 03"),
        ("09 10 00B4 0001 02 0200", "09 90 02"),
    ],
)
def test_answers_and_refusals(request_: str, answer: str) -> None:
    assert sensor().ask(rtu(request_)) == rtu(answer).hex(" ").upper()


def test_it_is_deaf_while_it_boots_and_may_stream_afterwards() -> None:
    host = sensor(streams_at_power_on=True)
    host.device.restart(host.time_s)  # type: ignore[attr-defined]
    assert host.ask(READ_ALL, 0.9) == ""
    assert len(host.wait(0.5)) > 0


def test_values_beyond_the_range_of_a_word_are_cut() -> None:
    class Crash:
        def wrenches(self, times_s: FloatArray) -> FloatArray:
            return np.full((len(times_s), 6), 1000.0)

    host = Host(Ft300(Ft300Spec(), Crash(), np.random.default_rng(1)))
    assert host.ask(READ_ALL).startswith("09 03 0C 7F FF 7F FF")
