"""The simulated DL-RS1A: the manual's lines, answer times, refusals."""

import math

import numpy as np
import pytest

from estimation.transform import FloatArray
from simulators.sensors.dlrs1a import Amplifier, AmplifierSpec, DlRs1a
from tests.simulators.line import Host

GAUGE = AmplifierSpec(kind="GT2", zero_m=0.0, span_m=0.02, towards=False)


class Target:
    def __init__(self, m: float) -> None:
        self.m = m

    def beam_lengths_m(self, times_s: FloatArray) -> FloatArray:
        return np.full(len(times_s), self.m)


def unit(spec: AmplifierSpec = GAUGE, m: float = 0.0123456, count: int = 1) -> tuple[Host, Target, DlRs1a]:
    target, rng = Target(m), np.random.default_rng(1)
    device = DlRs1a([Amplifier(spec, target, 0.0, 0.0, rng) for _ in range(count)])
    return Host(device), target, device


def ask(host: Host, line: str, end: bytes = b"\r\n") -> str:
    host.send(line.encode() + end)
    answer = host.wait(1.0)
    assert answer == b"" or answer.endswith(b"\r\n")
    return answer[:-2].decode()


def test_one_gauge_as_calculated() -> None:
    host, _, _ = unit()
    assert host.ask("4D 30 0D 0A") == "4D 30 2C 2B 30 31 32 2E 33 34 35 36 0D 0A"
    assert ask(host, "M0", b"\r") == "M0,+012.3456"


def test_documented_examples() -> None:
    host, _, _ = unit(count=2)
    assert ask(host, "SR,01,134") == "SR,01,134,1"
    assert ask(host, "SR,06,101") == "ER,SR,65"
    assert ask(host, "MS") == "MS,4,+012.3456,4,+012.3456"


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("XX", "ER,XX,00"),
        ("SR,00", "ER,SR,21"),
        ("M0,1", "ER,M0,21"),
        ("SR,0,002", "ER,SR,20"),
        ("SR,00,ABC", "ER,SR,22"),
        ("SR,00,999", "ER,SR,22"),
        ("SW,00,002,1", "ER,SW,22"),
        ("SW,00,050", "ER,SW,21"),
    ],
)
def test_refusals(line: str, answer: str) -> None:
    host, _, _ = unit()
    assert ask(host, line) == answer


def test_fifteen_gauges_take_the_time_of_the_manual() -> None:
    host, _, _ = unit(count=15)
    host.send(b"M0\r\n")
    begin_s, received = host.time_s, b""
    while len(received) < 154:
        host.time_s = host.device.next_output_s()
        received += host.device.take(host.time_s)
    assert len(received) == 154
    assert host.time_s - begin_s == pytest.approx(0.19, abs=0.015)


def test_formats_and_special_values_of_a_laser() -> None:
    host, target, device = unit(AmplifierSpec(), 0.098)
    assert ask(host, "SR,00,038") == "SR,00,038,+02.000"
    target.m = 0.2
    assert ask(host, "M0") == "M0,-99.999"
    target.m = 0.0
    assert ask(host, "M0") == "M0,+99.999"
    target.m = math.nan
    assert ask(host, "M0") == "M0,-99.998"
    device.amplifiers[0].error_bits = 33
    assert ask(host, "M0") == "M0,+EE.EEE"
    assert ask(host, "SR,00,033") == "SR,00,033,00033"


def test_a_preset_acts_on_the_change_from_0_to_1_and_leaves_the_raw_value_alone() -> None:
    host, target, _ = unit()
    assert ask(host, "SW,00,050,1") == "SW,00,050"
    assert ask(host, "M0") == "M0,+000.0000"
    target.m = 0.0133456
    ask(host, "SW,00,050,1")  # still 1: nothing happens
    assert ask(host, "M0") == "M0,+001.0000"
    ask(host, "SW,00,050,0"), ask(host, "SW,00,050,1")
    assert ask(host, "M0") == "M0,+000.0000"
    assert ask(host, "SR,00,002") == "SR,00,002,+013.3456"


def test_writing_needs_its_switch() -> None:
    host, _, device = unit()
    device.writable = False
    assert ask(host, "SW,00,050,1").startswith("ER,SW,")
    assert ask(host, "M0") == "M0,+012.3456"


def test_it_is_deaf_while_it_boots() -> None:
    host, _, device = unit()
    device.restart(host.time_s)
    assert ask(host, "M0") == ""
    host.wait(1.5)
    assert ask(host, "M0") == "M0,+012.3456"
