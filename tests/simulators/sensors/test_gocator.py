"""The simulated Gocator: the manual's bytes, commands on change, buffer, refusals."""

import math

import numpy as np
import pytest

from estimation.transform import FloatArray
from simulators.sensors.gocator import Gocator, GocatorSpec
from tests.simulators.line import Host

START = "00 01 00 00 00 06 01 06 00 00 00 01"
STOP = "00 01 00 00 00 06 01 06 00 00 00 00"
MEASUREMENT_0 = "00 02 00 00 00 06 01 03 03 E8 00 03"


class Target:
    m = 0.3 - 0.012345

    def beam_lengths_m(self, times_s: FloatArray) -> FloatArray:
        return np.full(len(times_s), self.m)


def head(**spec: object) -> tuple[Host, Target, Gocator]:
    target = Target()
    device = Gocator(GocatorSpec(**spec), target, 0.0, 0.0, np.random.default_rng(1))  # type: ignore[arg-type]
    return Host(device.connect()), target, device


def read(host: Host, register: int, count: int = 1) -> list[int]:
    answer = bytes.fromhex(host.ask(f"0009 0000 0006 01 03 {register:04X} {count:04X}", 0.003))
    return [int.from_bytes(answer[at : at + 2], "big") for at in range(9, len(answer), 2)]


def test_start_and_measurement_as_calculated() -> None:
    host, target, _ = head()
    assert host.ask(START) == START
    assert host.ask(MEASUREMENT_0) == "00 02 00 00 00 09 01 03 06 00 00 30 39 00 01"
    target.m = math.nan
    host.wait(0.1)
    assert host.ask(MEASUREMENT_0) == "00 02 00 00 00 09 01 03 06 80 00 00 00 00 02"


def test_the_decision_of_measurement_4_is_where_the_map_says_not_the_text() -> None:
    host, _, _ = head(running=True)
    assert read(host, 1012, 3) == [0x8000, 0, 2]
    assert read(host, 1015) == [0x8000]  # the value of measurement 5


def test_a_command_runs_when_the_register_changes() -> None:
    host, _, device = head()
    host.ask(START)
    assert read(host, 300) == [1]
    device.running = False
    host.ask(START)
    assert read(host, 300) == [0]
    host.ask(STOP), host.ask(START)
    assert read(host, 300) == [1]


def test_busy_while_it_executes() -> None:
    host, _, _ = head()
    host.ask(START, 0.01)
    assert read(host, 300, 2) == [0, 1]
    host.wait(0.5)
    assert read(host, 300, 2) == [1, 0]


def test_a_job_is_loaded_with_its_name_in_one_request() -> None:
    host, _, device = head()
    host.ask("0003 0000 0013 01 10 0000 0006 0C 0005 006F 0074 0068 0065 0072")
    host.wait(1.0)
    assert read(host, 311, 6) == [5, *b"other"]
    assert device.job == "other"


def test_the_frame_index_counts_the_profiles() -> None:
    host, _, _ = head(running=True)
    first = read(host, 996, 4)
    host.wait(1.0 - 0.003)
    assert read(host, 996, 4)[3] - first[3] == 200


def test_a_buffer_that_nobody_takes_from_freezes_and_says_so() -> None:
    host, target, _ = head(running=True, buffered=True)
    host.wait(2.0)
    assert read(host, 977, 2) == [10, 1]
    frozen = read(host, 999)
    host.wait(1.0)
    assert read(host, 999) == frozen
    read(host, 976)
    assert read(host, 999) != frozen and read(host, 978) == [1]
    target.m = 0.29
    for _ in range(30):
        read(host, 976)
    assert read(host, 1000, 3) == [0, 10_000, 1]


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("03 0400 0001", "03 04 00 00"),  # measurement 8, high word: not set up
        ("04 012C 0001", "04 02 00 00"),
        ("03 0000 0001", "83 02"),
        ("03 07CF 0001", "83 02"),
        ("03 0170 0008", "83 02"),
        ("06 0041 0001", "86 02"),
        ("06 0000 0009", "86 03"),
        ("05 0000 FF00", "85 01"),
    ],
)
def test_answers_and_refusals(request_: str, answer: str) -> None:
    host, _, _ = head()
    pdu = bytes.fromhex(request_)
    reply = bytes.fromhex(host.ask(b"\0\7\0\0" + bytes([0, 1 + len(pdu), 9]) + pdu))
    assert reply[:4] == b"\0\7\0\0" and reply[6] == 9  # transaction and unit come back
    if answer.startswith("8"):
        assert reply[7:] == bytes.fromhex(answer)
    else:
        assert len(reply) == 11


def test_requests_are_found_however_they_are_cut_and_other_bytes_ignored() -> None:
    host, _, _ = head(running=True)
    host.send("00 02 00 00 00 06 01 03"), host.send("03 E8 00 03 00 02 00 00")
    host.send("00 06 01 03 03 E8 00 03")
    assert len(host.wait()) == 30
    assert host.ask(b"GET / HTTP/1.1\r\n") == ""


def test_nobody_answers_while_it_boots() -> None:
    host, _, device = head()
    device.restart(host.time_s)
    assert host.ask(MEASUREMENT_0) == "00 02 00 00 00 03 01 83 02"
