"""The laser's stream and replies: worked bytes of the manual, and streams that are cut and spoiled."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.sensors import optoncdt_codec as codec

codes_st = st.lists(st.integers(0, 0x3FFFF), min_size=1, max_size=60)


def encode(code: int, flag: int = 0x80) -> bytes:
    """From the manual's table, independent of the decoder."""
    return bytes([code & 63, 64 | code >> 6 & 63, flag | code >> 12 & 63])


@pytest.mark.parametrize(
    ("distance_mm", "code", "sent"),
    [
        (0.0005, 643, "03 4A 80"),
        (25.000, 32760, "38 7F 87"),
        (37.500, 48819, "33 7A 8B"),
        (49.9995, 64877, "2D 75 8F"),
    ],
)
def test_worked_values_of_the_50_mm_sensor(distance_mm: float, code: int, sent: str) -> None:
    codes = codec.StreamDecoder().feed(bytes.fromhex(sent))
    assert codes.tolist() == [code]
    assert encode(code) == bytes.fromhex(sent)
    # The worked distances are rounded; neighbouring codes lie 0.8 um apart.
    assert codec.distances(codes, 0.050)[0] * 1e3 == pytest.approx(distance_mm, abs=0.0006)
    assert codec.in_range(codes).all()


def test_error_value_is_not_masked_to_sixteen_bits() -> None:
    codes = codec.StreamDecoder().feed(bytes.fromhex("3D 7E BF"))
    assert codes.tolist() == [262077]
    assert not codec.in_range(codes).any()
    assert codec.code_words(262077) == "peak before the range"


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (642, "before the measuring range"),
        (64878, "behind the measuring range"),
        (65521, "error value 65521"),
        (262082, "laser off"),
    ],
)
def test_reserves_and_errors_are_rejected_with_words(code: int, words: str) -> None:
    assert not codec.in_range(np.array([code])).any()
    assert codec.code_words(code) == words


@given(codes_st, st.integers(1, 40))
def test_values_do_not_depend_on_how_bytes_are_split(sent: list[int], size: int) -> None:
    wire = b"".join(encode(code) for code in sent)
    decoder, got = codec.StreamDecoder(), list[int]()
    for start in range(0, len(wire), size):
        got += decoder.feed(wire[start : start + size]).tolist()
    assert got == sent
    assert decoder.bad_bytes == 0


@given(codes_st, st.data())
def test_a_lost_byte_costs_one_value(sent: list[int], data: st.DataObject) -> None:
    wire = bytearray(b"".join(encode(code) for code in sent))
    lost = data.draw(st.integers(0, len(wire) - 1))
    del wire[lost]
    decoder = codec.StreamDecoder()
    assert decoder.feed(bytes(wire)).tolist() == sent[: lost // 3] + sent[lost // 3 + 1 :]


@given(codes_st, codes_st, st.binary(max_size=30))
def test_garbage_between_values_harms_none_after_the_first(
    before: list[int], after: list[int], garbage: bytes
) -> None:
    wire = b"".join(map(encode, before)) + garbage + b"".join(map(encode, after))
    got = codec.StreamDecoder().feed(wire).tolist()
    assert got[: len(before)] == before
    assert got[-len(after) :] == after


@given(st.binary(max_size=200), st.integers(1, 7))
def test_every_byte_is_accounted_for(garbage: bytes, size: int) -> None:
    decoder, values = codec.StreamDecoder(), 0
    for start in range(0, len(garbage), size):
        values += decoder.feed(garbage[start : start + size]).size
    assert decoder.bad_bytes + 3 * values + len(decoder._rest) == len(garbage)
    assert len(decoder._rest) <= 2


def test_further_values_of_a_measurement_are_not_distances() -> None:
    decoder = codec.StreamDecoder()
    assert decoder.feed(encode(1000) + encode(77, flag=0xC0) + encode(1001)).tolist() == [1000, 1001]
    assert decoder.bad_bytes == 3


def test_text_and_a_cut_value_fabricate_nothing_when_the_first_value_is_discarded() -> None:
    cut = encode(40000)[2:]  # its H byte only
    decoder = codec.StreamDecoder()
    decoder.discard_next()
    assert decoder.feed(b"OUTPUT RS422\r\n->" + b"\x01A" + cut + encode(40000)).tolist() == [40000]


def test_replies_with_errors_warnings_and_values_in_between() -> None:
    assert codec.parse_reply(b"MEASRATE 2\r\n") is None
    assert codec.parse_reply(b"MEASRATE 2\r\n->") == codec.Reply(("MEASRATE 2",), "", "")
    reply = codec.parse_reply(b"MEASRATE 99\r\nE210 Value out of range\r\n->")
    assert reply is not None and reply.error == "E210 Value out of range"
    reply = codec.parse_reply(encode(40000) * 3 + b"\r\nOUTPUT NONE\r\nW320 something\r\n->")
    assert reply is not None and reply.lines[-2] == "OUTPUT NONE" and reply.warning


@pytest.mark.parametrize(
    "text",
    [
        "GETINFO\r\nName:            ILD1420-100\r\nSerial:          1420100\r\nOption:          000\r\n"
        "Measuring range:   100.00mm\r\nVersion:         004.093\r\n->",
        "GETINFO\r\nSensor: ILD1420-100\r\nSerial number: 1420100\r\nRange: 100 mm\r\n->",
    ],
)
def test_identity_is_read_leniently(text: str) -> None:
    reply = codec.parse_reply(text.encode())
    assert reply is not None
    info = codec.parse_info(reply)
    assert (info["model"], info["serial_number"]) == ("ILD1420-100", "1420100")
    assert float(info["range_mm"]) == 100.0


@given(codes_st, st.integers(0, 2))
def test_the_end_of_a_value_cut_by_dropping_input_is_not_counted_as_bad(sent: list[int], cut: int) -> None:
    decoder = codec.StreamDecoder()
    decoder.reset()
    got = decoder.feed((encode(777) + b"".join(map(encode, sent)))[cut:]).tolist()
    assert got == ([777] if cut == 0 else []) + sent
    assert decoder.bad_bytes == 0
