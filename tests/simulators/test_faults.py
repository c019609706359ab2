"""What a wire does to messages, and what a signal does to values."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import CellFileError
from simulators.faults import KINDS, Fault, FaultyBytes, WireFaults, parse_fault
from simulators.signals import Signal


class Sender:
    """Says one message each second from 1 s on."""

    def __init__(self, *messages: bytes) -> None:
        self._messages = [(float(i + 1), message) for i, message in enumerate(messages)]

    def receive(self, data: bytes, time_s: float) -> None:
        pass

    def next_output_s(self) -> float:
        return self._messages[0][0] if self._messages else math.inf

    def take(self, time_s: float) -> bytes:
        due = [message for at_s, message in self._messages if at_s <= time_s]
        del self._messages[: len(due)]
        return b"".join(due)

    def discard(self, time_s: float) -> None:
        self.take(time_s)


def received(
    *texts: str, messages: tuple[bytes, ...] = (b"abc", b"def", b"ghi")
) -> list[tuple[float, bytes]]:
    """(instant, bytes) of all that comes through."""
    faults = WireFaults(3)
    for text in texts:
        faults.schedule(parse_fault(text))
    wire, got = FaultyBytes(Sender(*messages), faults), list[tuple[float, bytes]]()
    while (at_s := wire.next_output_s()) < math.inf:
        if data := wire.take(at_s):
            got.append((at_s, data))
    return got


def test_without_faults_nothing_changes() -> None:
    assert received() == [(1.0, b"abc"), (2.0, b"def"), (3.0, b"ghi")]


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        ("drop@2s", [(1.0, b"abc"), (3.0, b"ghi")]),
        ("drop@1.5-9", [(1.0, b"abc")]),
        ("duplicate@2s", [(1.0, b"abc"), (2.0, b"defdef"), (3.0, b"ghi")]),
        ("reorder@1s", [(2.0, b"defabc"), (3.0, b"ghi")]),
        ("late:0.5@2s", [(1.0, b"abc"), (2.5, b"def"), (3.0, b"ghi")]),
        ("late:1.5@2s", [(1.0, b"abc"), (3.5, b"defghi")]),  # what follows waits
    ],
)
def test_faults_of_whole_messages(fault: str, expected: list[tuple[float, bytes]]) -> None:
    assert received(fault) == expected


def test_faults_inside_a_message() -> None:
    (flipped,) = (a ^ b for a, b in zip(b"abc", received("corrupt@1s")[0][1], strict=True) if a != b)
    assert flipped.bit_count() == 1
    assert len(received("lose-byte@1s")[0][1]) == 2
    assert sorted(set(received("double-byte@1s")[0][1])) == sorted(b"abc")
    assert b"abc".startswith(received("truncate", messages=(b"abc",) * 9)[0][1])
    assert received("garbage:4@1s")[0][1][4:] == b"abc" and len(received("garbage:4@1s")[0][1]) == 7
    assert received("split:0.1@1s")[:3] == [(1.0, b"a"), (1.1, b"b"), (1.2, b"c")]


def test_the_seed_alone_decides() -> None:
    many = (b"x",) * 400
    assert received("drop%25", messages=many) == received("drop%25", messages=many)
    assert 60 < 400 - len(received("drop%25", messages=many)) < 140


@given(st.sampled_from(sorted(KINDS)), st.floats(0.01, 9), st.floats(0, 50), st.integers(1, 100))
def test_what_is_written_is_read(kind: str, value: float, start_s: float, percent: int) -> None:
    text = f"{kind}:{value:.3f}@{start_s:.2f}s-{start_s + 1:.2f}s%{percent}"
    fault = parse_fault(text)
    assert (fault.kind, fault.once, fault.chance) == (kind, False, percent / 100)
    assert fault.value == pytest.approx(value, abs=1e-3) and fault.from_s == pytest.approx(start_s, abs=1e-2)


@pytest.mark.parametrize("text", ["", "late:x", "late@5s-2s", "drop%0", "drop%101", "late@", "LATE", "a b"])
def test_what_means_nothing_is_refused(text: str) -> None:
    with pytest.raises(CellFileError, match=r"cannot be read|chance|ends before|No wire"):
        WireFaults().schedule(parse_fault(text))


def test_a_value_tells_when_it_was_measured() -> None:
    signal = Signal(0.05, 0.15, 20.0)
    times_s = np.array([0.0, 3.0, 19.99, 20.5, 61.0])
    for time_s, value in zip(times_s, signal.at(times_s), strict=True):
        assert signal.instant_s(value, time_s + 1.0) == pytest.approx(time_s)


def test_signals_stick_are_lost_jump_and_drift() -> None:
    signal = Signal(0.0, 10.0, 10.0)
    for fault in (
        Fault("stuck", from_s=2.0, until_s=4.0),
        Fault("lost", from_s=5.0, until_s=6.0),
        Fault("jump", 3.0, from_s=7.0, until_s=8.0),
        Fault("drift", 0.1, from_s=8.0),
    ):
        signal.schedule(fault)
    values = signal.at(np.array([1.0, 3.5, 5.5, 7.5, 9.0]))
    assert values == pytest.approx([1.0, 2.0, np.nan, 10.5, 9.1], nan_ok=True)
    with pytest.raises(CellFileError, match="No signal has the fault 'late'"):
        signal.schedule(Fault("late"))
