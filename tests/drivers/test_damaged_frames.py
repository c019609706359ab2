"""Damaged frames, 10,000 for each parser: it raises what it documents, and accepts nothing against its check.

What makes a frame right is written here anew, without the codecs; the CRC is that of the simulators.
"""

import random
import re
import struct
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from drivers.links.can_bus import is_whole
from drivers.links.canopen_sdo import short_answer
from drivers.links.modbus_rtu import ModbusRtu
from drivers.links.modbus_tcp import ModbusTcp
from drivers.robots import abb_codec, canopen_arm_codec, melfa_codec, ur_codec
from drivers.sensors import dlrs1a_codec, ft300_codec, optoncdt_codec, riftek_codec
from estimation.errors import DeviceError
from simulators.modbus_slave import crc
from tests.drivers.fakes import FakeByteLink, VirtualClock

LONGEST_S = 0.01
CHARACTERS = b"0123456789+-.,;#QokRtTAF_ \r\n\0\x80\xff"


def damaged(frame: bytes, rng: random.Random) -> bytes:
    """The frame with one to three faults; sometimes another frame follows, or it is noise."""
    if rng.random() < 0.02:
        return rng.randbytes(rng.randrange(40))
    data = bytearray(frame * 2 if rng.random() < 0.1 else frame)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        at = rng.randrange(len(data)) if data else 0
        match rng.randrange(7):
            case 0 if data:
                data[at] ^= 1 << rng.randrange(8)
            case 1 if data:
                data[at] = rng.choice(CHARACTERS)
            case 2:
                del data[at : at + rng.choice((1, 1, 2, 5))]
            case 3:
                data[at:at] = bytes((rng.choice(CHARACTERS),))
            case 4:
                del data[at:]
            case 5 if data:
                other = rng.randrange(len(data))
                data[at], data[other] = data[other], data[at]
            case _:
                data[at:at] = data[at : at + 4]
    return bytes(data)


# --- parsers: each raises DeviceError, or returns and asserts that what it accepted is right ---------------


def ft300_stream(data: bytes) -> None:
    right = {
        struct.unpack_from("<6h", data, i + 2)
        for i in range(len(data) - 15)
        if data[i : i + 2] == b"\x20\x4e" and crc(data[i : i + 14]) == data[i + 14 : i + 16]
    }
    for wrench in ft300_codec.StreamDecoder().feed(data):
        counts = np.round(wrench * [100, 100, 100, 1000, 1000, 1000]).astype(int)
        assert tuple(counts.tolist()) in right


def optoncdt_stream(data: bytes) -> None:
    triples = zip(data, data[1:], data[2:], strict=False)
    right = [
        a & 63 | (b & 63) << 6 | (c & 63) << 12
        for a, b, c in triples
        if (a >> 6, b >> 6, c >> 6) == (0, 1, 2)
    ]
    assert optoncdt_codec.StreamDecoder().feed(data).tolist() == right


def optoncdt_reply(data: bytes) -> None:
    reply = optoncdt_codec.parse_reply(data)
    assert (reply is None) == (b"->" not in data)
    if reply is not None:
        optoncdt_codec.parse_info(reply)


def riftek_stream(data: bytes) -> None:
    """A run of exactly four bytes with one head, and another head behind it."""
    right, start = list[int](), 0
    for i in range(1, len(data)):
        if data[i] >> 4 != data[start] >> 4:
            if i - start == 4 and data[start] >> 6 == 3:
                right.append(sum((data[start + k] & 15) << 4 * k for k in range(4)))
            start = i
    assert riftek_codec.ResultDecoder().feed(data).tolist() == right


def riftek_packet(data: bytes) -> None:
    packet = riftek_codec.parse_packet(data)
    assert len({byte >> 4 for byte in data}) == 1 and data[0] & 0x80 and 2 * len(packet.data) == len(data)


def riftek_ascii_head(data: bytes) -> None:
    riftek_codec.parse_ascii_head(data)
    assert re.fullmatch(rb"[0-9]+(\n[0-9]+){4}", data)


def riftek_ascii_result(data: bytes) -> None:
    assert riftek_codec.parse_ascii_result(data) <= 0xFFFF
    assert re.fullmatch(rb"[0-9]+", data)


def dlrs1a_item(data: bytes) -> None:
    item = dlrs1a_codec.parse_item(data, b"SR,00,038")
    value = dlrs1a_codec.parse_value(item)
    assert data.startswith(b"SR,00,038,")
    assert value is None or re.fullmatch(rb"[+-][0-9]{2,3}\.[0-9]{3,4}", data[10:])


def dlrs1a_all(data: bytes) -> None:
    for value in dlrs1a_codec.parse_all(data):
        dlrs1a_codec.parse_value(value)
    assert data.startswith(b"M0,")


def abb_reply(data: bytes) -> None:
    if (values := abb_codec.parse_reply(data, 4, [3] * 6)) is not None:
        assert len(values) == 6 and re.fullmatch(rb"4 1( -?[0-9]+\.[0-9]{3}){6}", data)


def abb_information(data: bytes) -> None:
    abb_codec.parse_information(data)
    assert data.count(b"*") == 2


def melfa_lines(data: bytes) -> None:
    lines = melfa_codec.AnswerLines(b"\r")
    lines.feed(data)
    while (line := lines.next_line()) is not None:
        text = melfa_codec.parse_answer(line, "JPOSF").text
        assert np.isfinite(melfa_codec.parse_joints(text)).all()
        assert re.match(rb"Qo[Kk]J1;[+-]?[0-9.]+;J2;", line)


def melfa_pose(data: bytes) -> None:
    position_m, angles_rad = melfa_codec.parse_pose(melfa_codec.parse_answer(data, "PPOSF").text)
    assert np.isfinite([*position_m, *angles_rad]).all()
    assert re.match(rb"Qo[Kk]X;[+-]?[0-9.]+;Y;[+-]?[0-9.]+;Z;", data.lstrip(b"\r\n"))


def melfa_state(data: bytes) -> None:
    text = melfa_codec.parse_answer(data, "STATE").text
    melfa_codec.parse_state(text)
    assert re.match(r"[0-9A-F]{4}[0-9]+", text.split(";")[4])


def melfa_info(data: bytes) -> None:
    melfa_codec.parse_info(melfa_codec.parse_answer(data, "OPEN=X").text)


RECIPE = ur_codec.Recipe(24)
RECIPE.accept(b"\x01" + ",".join(RECIPE.fields.values()).encode())


def ur_recipe(data: bytes) -> None:
    ur_codec.Recipe(24).accept(data)
    assert data[1:] == ",".join(RECIPE.fields.values()).encode()


def ur_stream(data: bytes) -> None:
    reader = ur_codec.FrameReader()
    reader.feed(data)
    while (frame := reader.next_frame()) is not None:
        kind, payload = frame
        if kind == ur_codec.DATA:
            package = RECIPE.parse(payload)
            assert payload[0] == 1 and len(payload) == 125
            assert np.isfinite([package.timestamp_s, *package.joints_rad, *package.base_T_tcp]).all()


def slcan_line(data: bytes) -> None:
    line = data.decode("latin-1")
    if is_whole(line) and line[:1] == "t":
        assert line.endswith("\r") and len(line) == 6 + 2 * int(line[4]) <= 22
        bytes.fromhex(line[5:-1])
        assert int(line[1:4], 16) < 0x1000


def sdo_answer(data: bytes) -> None:
    if (value := short_answer(data, 0x6000, 1)) is not None:
        assert len(data) == 8 and data[1:4] == b"\x00\x60\x01" and 1 <= len(value) <= 4


def emergency(data: bytes) -> None:
    assert (canopen_arm_codec.parse_emergency(data) is None) == (len(data) != 8)


class Wire(FakeByteLink):
    """Answers every request with these bytes."""

    def __init__(self) -> None:
        super().__init__(VirtualClock())
        self.reply: Callable[[bytes], bytes] = bytes
        self.on_write = lambda request: self.later(0.01, self.reply(request))

    def ask(self, client: ModbusRtu | ModbusTcp) -> list[int]:
        self._events.clear()
        client.reset()
        return client.read_input_registers(6, 2)


RTU_WIRE, TCP_WIRE = Wire(), Wire()
RTU = ModbusRtu(RTU_WIRE, RTU_WIRE.clock, name="Device", unit=9, baud=19200)
TCP = ModbusTcp(TCP_WIRE, TCP_WIRE.clock, name="Device", tries=1)


def modbus_rtu(data: bytes) -> None:
    RTU_WIRE.reply = lambda request: data
    words = RTU_WIRE.ask(RTU)
    body = struct.pack(">BBB2H", 9, 4, 4, *words)
    assert data == body + crc(body)


def modbus_tcp(data: bytes) -> None:
    """The first two bytes of the frame stand for the transaction number, unless they were damaged."""
    sent = bytearray()

    def reply(request: bytes) -> bytes:
        sent[:] = request[:2] + data[2:] if data[:2] == b"\xaa\xaa" else data
        return bytes(sent)

    TCP_WIRE.reply = reply
    words = TCP_WIRE.ask(TCP)
    assert struct.pack(">HHBBB2H", 0, 7, 1, 4, 4, *words) in bytes(sent)


@dataclass(frozen=True)
class Parser:
    parse: Callable[[bytes], None]
    frames: tuple[bytes, ...]


WRENCH = bytes.fromhex("204ED204C9FD94267B0038FEE803E2E6")
PACKAGE = ur_codec.encode(ur_codec.DATA, struct.pack(">B13di2I2i", 1, 9.5, *[0.4] * 12, 7, 1, 3, 5, 5))
PARSERS = [
    Parser(ft300_stream, (WRENCH, WRENCH * 2, b"\x20" + WRENCH)),
    Parser(optoncdt_stream, (bytes.fromhex("387F87"), bytes.fromhex("034A80337A8B2D758F3D7EBF"))),
    Parser(optoncdt_reply, (b"GETINFO\r\nName: ILD1420-10\r\nSerial: 17\r\n->", b"E104 Timeout\r\n->")),
    Parser(riftek_stream, (bytes.fromhex("F5FAF2F0C1C2C3C4D5DAD2D0E0"), bytes.fromhex("F5FAF2F080"))),
    Parser(riftek_packet, (bytes.fromhex("9F939099919293949095909092939090"), bytes.fromhex("F5FAF2F0"))),
    Parser(riftek_ascii_head, (b"603\n40\n19999\n125\n500",)),
    Parser(riftek_ascii_result, (b"12345", b"7")),
    Parser(dlrs1a_item, (b"SR,00,038,+12.345", b"SR,00,038,+EE.EEE", b"ER,SR,65")),
    Parser(dlrs1a_all, (b"M0,+012.3456,-000.0001", b"ER,M0,00")),
    Parser(abb_reply, (b"4 1 10.000 -20.125 30.500 0.000 1.000 -179.999", b"4 0 ")),
    Parser(abb_information, (b"98 1 14-21858*6.15*IRB 120",)),
    Parser(
        melfa_lines,
        (
            b"QoKJ1;0.00;J2;-1.50;J3;90.00;J4;0.00;J5;45.00;J6;179.93;;****,****;100;0.00;00000000\r\n",
            b"QeR6020\r",
        ),
    ),
    Parser(
        melfa_pose,
        (b"QoKX;290.62;Y;-0.09;Z;11.26;A;-179.94;B;-0.26;C;179.93;L1;0.00;;6,0;100;0.00;00000000",),
    ),
    Parser(melfa_state, (b"Qok2.MB5;100;100;5;A1124220;1;1;;;;;;;;;REP;START;1;0", b"Qer4220")),
    Parser(melfa_info, (b"QoKXYZABC;XY;1;2;3;4;RV-4FL;CR750;F;S;R6;ENG;COPYRIGHT",)),
    Parser(ur_recipe, (b"\x01" + ",".join(RECIPE.fields.values()).encode(),)),
    Parser(ur_stream, (PACKAGE, PACKAGE * 2, ur_codec.encode(ur_codec.START, b"\x01"))),
    Parser(slcan_line, (b"t1836371200010000\r", b"t194101\r", b"t0800\r", b"T000001831AA\r")),
    Parser(sdo_answer, (bytes.fromhex("4F00600101000000"), bytes.fromhex("8000600100000206"))),
    Parser(emergency, (bytes.fromhex("1186210000000000"),)),
    Parser(
        modbus_rtu,
        ((b"\x09\x04\x04\x11\x70\x00\x01" + crc(b"\x09\x04\x04\x11\x70\x00\x01")), b"\x09\x84\x02\x03\x01"),
    ),
    Parser(modbus_tcp, (bytes.fromhex("AAAA0000000701040411700001"), bytes.fromhex("AAAA00000003018402"))),
]


@dataclass
class Outcome:
    """Of many damaged frames."""

    accepted: int = 0  # they were right, or nothing can tell that they were not
    refused: int = 0
    slowest_s: float = 0.0  # frame, by the clock on the wall; a slow one is measured once more


def attempt(parser: Parser, data: bytes) -> bool:
    """Whether these bytes were accepted. Fails for any exception but the documented ones."""
    try:
        parser.parse(data)
    except DeviceError:
        return False
    except Exception as error:
        pytest.fail(f"{data!r}: {error!r}")
    return True


def attack(parser: Parser, count: int, seed: int) -> Outcome:
    """Feed so many damaged frames; none may take longer than `LONGEST_S` of CPU time on a second try."""
    rng, outcome, clock_s = random.Random(seed), Outcome(), time.perf_counter
    for _ in range(count):
        data = damaged(rng.choice(parser.frames), rng)
        begun_s = clock_s()
        accepted = attempt(parser, data)
        outcome.accepted += accepted
        outcome.refused += not accepted
        if (took_s := clock_s() - begun_s) > LONGEST_S:
            begun_s = time.process_time()
            attempt(parser, data)
            took_s = time.process_time() - begun_s
            assert took_s < LONGEST_S, f"{data!r} takes {took_s:.3f} s"
        outcome.slowest_s = max(outcome.slowest_s, took_s)
    return outcome


@pytest.mark.parametrize("parser", PARSERS, ids=lambda parser: parser.parse.__name__)
class TestDamagedFrames:
    def test_whole_frames_are_read(self, parser: Parser) -> None:
        parser.parse(parser.frames[0])

    def test_ten_thousand(self, parser: Parser) -> None:
        attack(parser, 10_000, zlib.crc32(parser.parse.__name__.encode()))

    @pytest.mark.campaign
    def test_a_million(self, parser: Parser) -> None:
        outcome = attack(parser, 1_000_000, 1)
        cells = (outcome.accepted, outcome.refused, f"{outcome.slowest_s * 1e3:.1f}")
        print(f"| {parser.parse.__name__} | {' | '.join(str(cell) for cell in cells)} |")
