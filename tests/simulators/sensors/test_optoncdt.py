"""The laser's line: worked bytes, commands, and a stream that keeps the time."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.sensors.optoncdt import LaserConfig, OptoncdtLaser
from estimation.transform import FloatArray
from simulators.sensors.optoncdt import OptoNcdt1420, encode_values
from simulators.virtual import VirtualByteLink, VirtualClock
from simulators.world.truth import stream
from simulators.world.world_file import WorldFile

LATENCY_S = 0.004


class Beam:
    def __init__(self) -> None:
        self.length_m = 0.1

    def beam_lengths_m(self, times_s: FloatArray) -> FloatArray:
        return np.full(len(times_s), self.length_m)


class Line:
    """A host that waits; `values` are the 18-bit numbers of a stream."""

    def __init__(self, laser: OptoNcdt1420) -> None:
        self.laser, self.time_s = laser, 0.0

    def wait(self, duration_s: float) -> bytes:
        self.time_s += duration_s
        return self.laser.take(self.time_s)

    def command(self, text: str) -> str:
        self.laser.receive(text.encode() + b"\n", self.time_s)
        return self.wait(0.02).decode("latin-1")


def values(data: bytes) -> FloatArray:
    low, middle, high = np.frombuffer(data, dtype=np.uint8).reshape(-1, 3).T.astype(int)
    assert (low >> 6 == 0).all() and (middle >> 6 == 1).all() and (high >> 6 == 2).all()
    return (low & 63) | (middle & 63) << 6 | (high & 63) << 12


@pytest.fixture
def beam() -> Beam:
    return Beam()


@pytest.fixture
def line(world_file: WorldFile, beam: Beam) -> Line:
    line = Line(OptoNcdt1420(world_file.laser, beam, 0.0, 0.0, stream(1, "test"), noise_factor=0.0))
    line.command("OUTPUT NONE")
    return line


@pytest.mark.parametrize(
    ("number", "wire"),
    [(643, "03 4A 80"), (32760, "38 7F 87"), (48819, "33 7A 8B"), (64877, "2D 75 8F"), (262077, "3D 7E BF")],
)
def test_worked_bytes(number: int, wire: str) -> None:
    assert encode_values(np.array([number])).tobytes().hex(" ").upper() == wire


@given(st.lists(st.integers(0, 2**18 - 1), min_size=1))
def test_every_value_can_be_read_back(numbers: list[int]) -> None:
    assert values(encode_values(np.array(numbers)).tobytes()).tolist() == numbers
    further = encode_values(np.array(numbers), first=False)
    assert (further[:, 2] >> 6 == 3).all()


def test_distance_in_the_middle_of_the_range(line: Line, beam: Beam) -> None:
    """25 mm of 50 is 32760; so is 50 mm of 100. The reading starts at the start of the range."""
    line.command("OUTPUT RS422")
    assert set(values(line.wait(0.1)).tolist()) == {32760}
    beam.length_m = 0.05
    assert set(values(line.wait(0.1))[50:].tolist()) == {642}


@pytest.mark.parametrize(
    ("length_m", "code"), [(0.0489, 262077), (0.1511, 262078), (np.nan, 262076), (0.0, 262077), (9.0, 262078)]
)
def test_no_distance_is_an_error_value(line: Line, beam: Beam, length_m: float, code: int) -> None:
    beam.length_m = length_m
    line.command("OUTPUT RS422")
    assert set(values(line.wait(0.1)).tolist()) == {code}


def test_scale_offset_and_noise(world_file: WorldFile, beam: Beam) -> None:
    """True distance = (1 + scale) * reading + offset."""
    line = Line(OptoNcdt1420(world_file.laser, beam, 0.01, 0.002, stream(1, "test")))
    numbers = values(line.wait(1.0))
    reading_m = 0.05 + ((numbers * 102 / 65520) - 1) / 100 * 0.1
    sigma = world_file.laser.reading_noise_m
    assert np.mean(reading_m) == pytest.approx((0.1 - 0.002) / 1.01, abs=5 * sigma / np.sqrt(len(numbers)))
    assert np.std(reading_m) == pytest.approx(sigma, rel=0.1)


def test_commands_answer_with_the_setting_and_the_prompt(line: Line) -> None:
    assert line.command("MEASRATE 2") == "MEASRATE 2\r\n->"
    assert line.command("MEASRATE") == "MEASRATE 2\r\n->"
    assert line.command("OUTREDUCEDEVICE NONE") == "OUTREDUCEDEVICE NONE\r\n->"
    assert line.command("measrate 3").startswith("E236")
    assert line.command("MEASRATE 2 2").startswith("E232")
    assert line.command("SING").startswith("E210") and line.command("SING").endswith("\r\n->")
    assert line.command("x" * 300).startswith(("E210", "E214"))


def test_a_setting_can_be_sent_back_as_a_command(line: Line) -> None:
    for name in ("MEASRATE", "OUTADD_RS422", "BAUDRATE", "OUTPUT", "LASERPOW"):
        reply = line.command(name)
        assert line.command(reply.removesuffix("\r\n->")) == reply


def test_it_says_who_it_is(line: Line, world_file: WorldFile) -> None:
    information = line.command("GETINFO")
    assert information.startswith("GETINFO\r\n") and information.endswith("->")
    lines = dict(text.split(":", 1) for text in information.splitlines()[1:-1])
    assert lines["Name"].strip() == world_file.laser.model
    assert lines["Serial"].strip() == world_file.laser.serial_number
    assert lines["Measuring range"].strip() == "100.00mm"


def test_a_command_may_arrive_in_pieces(line: Line) -> None:
    for piece in (b"MEAS", b"RATE", b" 1\r\n"):
        line.laser.receive(piece, line.time_s)
    assert line.wait(0.02) == b"MEASRATE 1\r\n->"


def test_the_stream_keeps_the_rate_whenever_it_is_read(line: Line, world_file: WorldFile) -> None:
    line.command("MEASRATE 2")
    line.command("OUTPUT RS422")
    line.wait(0.1)
    pieces = np.random.default_rng(1).uniform(0, 0.01, 400)
    count = sum(len(line.wait(piece)) // 3 for piece in pieces)
    assert count == pytest.approx(2000 * pieces.sum(), abs=9)
    before = line.time_s
    while len(line.laser.take(line.laser.next_output_s())) // 3 == 0:
        pass
    assert line.laser.next_output_s() - before <= 2 * LATENCY_S + 1e-9


def test_what_is_discarded_is_gone_and_no_more(line: Line, beam: Beam) -> None:
    line.command("MEASRATE 1")
    line.command("OUTPUT RS422")
    line.wait(0.4)
    line.time_s += 0.4
    line.laser.discard(line.time_s)
    beam.length_m = 0.12
    later = values(line.wait(0.1))
    assert len(later) in range(98, 103) and len(set(later.tolist())) == 1


def test_a_port_that_nobody_reads_loses_the_newest(line: Line) -> None:
    line.command("OUTPUT RS422")
    assert len(line.wait(100.0)) == 65536 // 3 * 3
    assert len(line.wait(1.0)) // 3 == pytest.approx(4000, abs=20)


def test_too_much_for_the_line_is_said_so(line: Line) -> None:
    line.command("BAUDRATE 115200")
    line.command("MEASRATE 4")
    line.command("OUTPUT RS422")
    assert set(values(line.wait(0.1)).tolist()) == {262075}


def test_a_restarted_sensor_comes_back_streaming(line: Line) -> None:
    line.command("MEASRATE 2")
    line.laser.restart(line.time_s)
    assert line.wait(1.0) == b""
    assert len(line.wait(1.5)) // 3 == pytest.approx(4000, rel=0.01)
    assert line.command("OUTPUT NONE").endswith("OUTPUT NONE\r\n->")
    assert line.command("MEASRATE") == "MEASRATE 4\r\n->"


def test_the_laser_can_be_switched_off(line: Line) -> None:
    line.command("LASERPOW OFF")
    line.command("OUTPUT RS422")
    assert set(values(line.wait(0.05)).tolist()) == {262082}


def test_a_mastered_sensor_counts_on_from_the_master_value_in_another_scale(line: Line, beam: Beam) -> None:
    """d = ((x 102 / 65520) - 51) / 100 MR, 18 bits."""
    assert line.command("MASTERMV MASTER 20").startswith("MASTERMV MASTER 20\r\n")
    beam.length_m += 0.010
    line.command("OUTPUT RS422")
    (number,) = set(values(line.wait(0.1)).tolist())
    assert (number * 102 / 65520 - 51) / 100 * line.laser._spec.range_m == pytest.approx(0.030, abs=1e-6)
    line.command("OUTPUT NONE")
    line.command("MASTERMV NONE")
    line.command("OUTPUT RS422")
    assert max(values(line.wait(0.1))) <= 65520


def test_a_driver_reads_true_distances_from_a_sensor_that_was_left_mastered(
    world_file: WorldFile, beam: Beam
) -> None:
    clock, spec = VirtualClock(), world_file.laser
    sensor = OptoNcdt1420(spec, beam, 0.0, 0.0, stream(1, "test"), noise_factor=0.0)
    sensor.receive(b"MASTERMV MASTER 5\n", 0.0)
    config = LaserConfig(range_m=spec.range_m, range_start_m=spec.range_start_m, baud=spec.baud)
    laser = OptoncdtLaser(VirtualByteLink("laser", clock, lambda: sensor), config, clock)
    laser.connect()
    laser.begin_window()
    assert laser.end_window(5).distance_m == pytest.approx(beam.length_m, abs=2e-6)
