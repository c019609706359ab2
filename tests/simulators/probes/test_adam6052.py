"""The remote I/O behind Modbus TCP: worked frames, the counter, refusals."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.modbus_tcp_slave import RegisterConnection
from simulators.probes.adam6052 import FUNCTIONS, Adam6052

DELAY_S = 0.0015


class Switch:
    def __init__(self) -> None:
        self.closed, self.count, self.asked_s = False, 0, -1.0

    def update(self, time_s: float) -> None:
        self.asked_s = time_s


class Client:
    def __init__(self, channel: int = 0) -> None:
        self.switch = Switch()
        self.module = Adam6052(self.switch, 0x6052, channel)
        self.connection = RegisterConnection(self.module, FUNCTIONS, DELAY_S)
        self.time_s = 0.0

    def ask(self, request: str) -> str:
        self.connection.receive(bytes.fromhex(request), self.time_s)
        self.time_s += 0.01
        return self.connection.take(self.time_s).hex(" ").upper()


def test_inputs_as_in_the_manual() -> None:
    client = Client(channel=2)
    client.switch.closed = True
    assert client.ask("00 06 00 00 00 06 01 02 00 00 00 08") == "00 06 00 00 00 04 01 02 01 04"


def test_a_counter_is_two_words_low_word_first() -> None:
    client = Client(channel=2)
    client.switch.count = 70_000
    answer = client.ask("00 07 00 00 00 06 01 04 00 04 00 02")
    assert answer == "00 07 00 00 00 07 01 04 04 11 70 00 01"
    assert client.ask("00 08 00 00 00 06 01 03 00 04 00 02").endswith("01 03 04 11 70 00 01")
    assert client.ask("00 09 00 00 00 06 01 04 00 00 00 02").endswith("01 04 04 00 00 00 00")


def test_its_name() -> None:
    assert Client().ask("00 01 00 00 00 06 01 03 00 D2 00 02").endswith("04 60 52 00 00")


def test_the_counter_can_be_cleared() -> None:
    client = Client()
    client.switch.count = 5
    assert client.ask("00 01 00 00 00 06 01 05 00 21 FF 00") == "00 01 00 00 00 06 01 05 00 21 FF 00"
    client.switch.count = 7
    assert client.ask("00 02 00 00 00 06 01 04 00 00 00 02").endswith("04 00 02 00 00")
    client.module.restart()
    assert client.ask("00 03 00 00 00 06 01 04 00 00 00 02").endswith("04 00 00 00 00")


def test_outputs_by_coil_and_by_word() -> None:
    client = Client()
    client.ask("00 01 00 00 00 06 01 05 00 11 FF 00")
    assert client.ask("00 02 00 00 00 06 01 01 00 10 00 08").endswith("01 01 01 02")
    assert client.ask("00 03 00 00 00 06 01 03 01 2E 00 01").endswith("01 03 02 00 02")
    client.ask("00 04 00 00 00 09 01 10 01 2E 00 01 02 00 80")
    assert client.ask("00 05 00 00 00 06 01 01 00 10 00 08").endswith("01 01 01 80")
    client.ask("00 06 00 00 00 08 01 0F 00 10 00 03 01 05")
    assert client.ask("00 07 00 00 00 06 01 01 00 10 00 08").endswith("01 01 01 85")


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("00 01 00 00 00 06 01 04 03 E8 00 01", "00 01 00 00 00 03 01 84 02"),
        ("00 01 00 00 00 06 01 02 00 08 00 01", "00 01 00 00 00 03 01 82 02"),
        ("00 01 00 00 00 06 01 05 00 00 FF 00", "00 01 00 00 00 03 01 85 02"),  # an input is no coil
        ("00 01 00 00 00 06 01 06 00 00 00 01", "00 01 00 00 00 03 01 86 02"),  # a counter is not written
        ("00 01 00 00 00 02 01 63", "00 01 00 00 00 03 01 E3 01"),
        ("00 01 00 00 00 06 01 04 00 00 00 00", "00 01 00 00 00 03 01 84 03"),  # no register
        ("00 01 00 00 00 06 01 03 00 00 00 7E", "00 01 00 00 00 03 01 83 03"),  # more than fit in a frame
        ("00 01 00 00 00 06 01 02 00 00 07 D1", "00 01 00 00 00 03 01 82 03"),
        ("00 01 00 00 00 06 01 05 00 10 00 01", "00 01 00 00 00 03 01 85 03"),  # neither on nor off
        ("00 01 00 00 00 08 01 0F 00 10 00 09 01 05", "00 01 00 00 00 03 01 8F 03"),  # a byte is missing
        ("00 01 00 00 00 09 01 10 01 2E 00 01 04 00 80", "00 01 00 00 00 03 01 90 03"),
    ],
)
def test_refusals(request_: str, answer: str) -> None:
    client = Client()
    assert client.ask(request_) == answer
    assert client.ask("00 02 00 00 00 06 01 04 00 00 00 02").startswith("00 02")


def test_what_is_refused_is_not_half_done() -> None:
    client = Client()
    assert client.ask("00 01 00 00 00 08 01 0F 00 16 00 04 01 0F").endswith("8F 02")  # two of four exist
    assert client.ask("00 02 00 00 00 06 01 01 00 10 00 08").endswith("01 01 01 00")


@given(st.integers(1, 30))
def test_requests_may_be_cut_and_joined_anywhere(size: int) -> None:
    client = Client()
    wire = b"".join(bytes.fromhex(f"{tid:04x} 0000 0006 01 04 0000 0002") for tid in range(1, 6))
    for start in range(0, len(wire), size):
        client.connection.receive(wire[start : start + size], 0.0)
    answers = client.connection.take(1.0)
    assert [answers[i : i + 2] for i in range(0, len(answers), 13)] == [bytes([0, t]) for t in range(1, 6)]


def test_the_input_is_sampled_when_asked_and_answered_later() -> None:
    client = Client()
    client.connection.receive(bytes.fromhex("00 01 00 00 00 06 01 04 00 00 00 02"), 5.0)
    assert client.switch.asked_s == 5.0
    assert client.connection.take(5.0) == b"" and client.connection.next_output_s() == 5.0 + DELAY_S
    assert client.connection.take(5.0 + DELAY_S)


def test_what_is_not_modbus_is_dropped() -> None:
    client = Client()
    assert client.ask("47 45 54 20 2F 20 48 54 54 50") == ""
    assert client.ask("00 02 00 00 00 06 01 04 00 00 00 02").startswith("00 02")
