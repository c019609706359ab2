"""RIFTEK requests and packets: the worked examples of the manual, and streams that lose and double bytes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.sensors import riftek_codec as codec
from estimation.errors import FrameError


def packet(code: int, number: int, fresh: bool = True) -> bytes:
    head = 0x80 | fresh << 6 | (number & 3) << 4
    return bytes(head | code >> 4 * i & 0xF for i in range(4))


def stream(codes: list[int]) -> list[bytes]:
    return [packet(code, number) for number, code in enumerate(codes)]


@pytest.mark.parametrize(
    ("request_", "wire"),
    [
        (codec.request(1, codec.IDENTIFY), "01 81"),
        (codec.request(1, codec.RESULT), "01 86"),
        (codec.request(1, codec.STREAM), "01 87"),
        (codec.request(1, codec.STOP), "01 88"),
        (codec.write_request(1, 0x02, 0x01), "01 83 82 80 81 80"),
        (codec.write_request(1, 0x09, 0x30), "01 83 89 80 80 83"),  # 12345, high byte first
        (codec.write_request(1, 0x08, 0x39), "01 83 88 80 89 83"),
        (codec.read_request(1, 0x05), "01 82 85 80"),  # the manual's example shows parameter 02h instead
        (codec.request(0, codec.LATCH), "00 85"),
    ],
)
def test_requests_as_in_the_manual(request_: bytes, wire: str) -> None:
    assert request_ == bytes.fromhex(wire)


def test_identity_as_in_the_manual() -> None:
    answer = codec.parse_packet(bytes.fromhex("9F 93 90 99 91 92 93 94 90 95 90 90 92 93 90 90"))
    assert (answer.number, answer.fresh) == (1, False)
    assert codec.parse_head(answer.data) == codec.Head(0x3F, 0x90, 0x4321, 80, 50)


def test_parameter_as_in_the_manual() -> None:
    answer = codec.parse_packet(bytes.fromhex("A4 A0"))
    assert (answer.data, answer.number) == (b"\x04", 2)


def test_result_as_in_the_manual() -> None:
    answer = codec.parse_packet(bytes.fromhex("F5 FA F2 F0"))
    assert (answer.number, answer.fresh) == (3, True)
    code = int.from_bytes(answer.data, "little")
    assert code == 677
    assert float(codec.distances(np.array([code]), 0.050)[0]) == pytest.approx(2.066e-3, abs=5e-7)
    assert float(codec.distances(np.array([15894]), 0.500)[0]) == pytest.approx(0.485046, abs=5e-7)


def test_ascii_answers_as_in_the_manual() -> None:
    assert codec.parse_ascii_head(b"603\n40\n19999\n125\n500") == codec.Head(603, 40, 19999, 125, 500)
    assert codec.parse_ascii_result(b"15894") == 15894
    for line in (b"", b"-1", b"12.5", b"70000", b"OK"):
        with pytest.raises(FrameError):
            codec.parse_ascii_result(line)
    for line in (b"603\n40", b"OK", b"603\n40\n19999\n125\nx"):
        with pytest.raises(FrameError):
            codec.parse_ascii_head(line)


@pytest.mark.parametrize("wire", ["F5 FA E2 F0", "75 7A 72 70", "F5 FA F2", "00 FA F2 F0", ""])
def test_bytes_that_are_no_packet_are_refused(wire: str) -> None:
    with pytest.raises(FrameError):
        codec.parse_packet(bytes.fromhex(wire))


@given(st.lists(st.integers(0, 0xFFFF), min_size=2), st.integers(1, 40))
def test_results_do_not_depend_on_how_bytes_are_split(codes: list[int], size: int) -> None:
    wire = b"".join(stream(codes))
    decoder = codec.ResultDecoder()
    got = [code for i in range(0, len(wire), size) for code in decoder.feed(wire[i : i + size]).tolist()]
    assert got == codes[:-1]  # the last one is not confirmed yet
    assert (decoder.bad_bytes, decoder.lost, decoder.stale) == (0, 0, 0)


@given(st.lists(st.integers(0, 0xFFFF), min_size=6, max_size=30), st.data())
def test_a_lost_or_doubled_byte_makes_no_value(codes: list[int], data: st.DataObject) -> None:
    wire = b"".join(stream(codes))
    at = data.draw(st.integers(4, len(wire) - 9))
    doubled = data.draw(st.booleans())
    decoder = codec.ResultDecoder()
    got = decoder.feed(wire[: at + 1] + wire[at:] if doubled else wire[:at] + wire[at + 1 :])
    hit = at // 4
    assert got.tolist() == codes[:hit] + codes[hit + 1 : -1]
    assert decoder.bad_bytes == (5 if doubled else 3) and decoder.lost == 1


@given(st.lists(st.integers(0, 0xFFFF), min_size=6, max_size=30), st.data())
def test_a_byte_of_wrong_parity_makes_no_value(codes: list[int], data: st.DataObject) -> None:
    wire = bytearray(b"".join(stream(codes)))
    at = data.draw(st.integers(4, len(wire) - 9))
    wire[at] = 0
    assert codec.ResultDecoder().feed(bytes(wire)).tolist() == codes[: at // 4] + codes[at // 4 + 1 : -1]


def test_packets_missing_in_the_numbering_are_counted() -> None:
    decoder = codec.ResultDecoder()
    packets = stream(list(range(10)))
    del packets[3:5]
    assert decoder.feed(b"".join(packets)).tolist() == [0, 1, 2, 5, 6, 7, 8]
    assert decoder.lost == 2


def test_a_result_that_was_not_refreshed_is_no_new_one() -> None:
    decoder = codec.ResultDecoder()
    wire = packet(100, 0) + packet(100, 1, fresh=False) + packet(101, 2) + packet(102, 3)
    assert decoder.feed(wire).tolist() == [100, 101]
    assert decoder.stale == 1 and decoder.lost == 0


def test_the_end_of_a_packet_whose_beginning_was_dropped_is_no_fault() -> None:
    decoder = codec.ResultDecoder()
    decoder.reset()
    wire = b"".join(stream([7, 8, 9, 10]))
    assert decoder.feed(wire[2:]).tolist() == [8, 9]
    assert decoder.bad_bytes == 0


@given(st.binary(max_size=400), st.integers(1, 50))
def test_any_bytes_are_digested(wire: bytes, size: int) -> None:
    decoder = codec.ResultDecoder()
    for i in range(0, len(wire), size):
        codes = decoder.feed(wire[i : i + size])
        assert ((codes >= 0) & (codes <= 0xFFFF)).all()


def test_the_end_of_a_packet_and_a_doubled_byte_are_no_value_after_input_was_dropped() -> None:
    decoder = codec.ResultDecoder()
    decoder.reset()
    assert decoder.feed(bytes.fromhex("FAFAF2F0 C5CAC2C0 D0")).tolist() == [0x02A5]
    assert decoder.bad_bytes == 0
