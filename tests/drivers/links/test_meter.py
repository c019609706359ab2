"""What a link counts: answers by how long they took, late ones, times that it broke."""

import pytest

from drivers.links.meter import BOUNDS_S, LinkMeter
from drivers.links.serial_port import SerialLink
from estimation.errors import DeviceError
from tests.drivers.fakes import VirtualClock
from tests.drivers.wires import pseudo_terminal


def test_an_answer_is_timed_from_the_question_to_its_first_bytes() -> None:
    clock = VirtualClock()
    meter = LinkMeter(clock.now_s)
    for took_s in (0.0005, 0.004, 0.004, 0.3, 2.0):
        meter.sent(8)
        clock.sleep(took_s)
        meter.received(3, 0.5)
        clock.sleep(0.05)
        meter.received(4, 0.5)  # the rest of it
    seen = meter.statistics("COM3")
    assert (seen.sent, seen.received, sum(seen.answers), seen.late) == (40, 35, 5, 0)
    assert seen.answers == (1, 0, 2, 0, 0, 0, 0, 0, 1, 0, 1)
    assert seen.longest_answer_s == pytest.approx(2.0)
    assert seen.answered_within_s(0.5) == 0.005
    assert seen.answered_within_s(0.8) == 0.5
    assert seen.answered_within_s(0.99) is None  # beyond the last bound


def test_an_answer_is_late_once_a_wait_was_given_up() -> None:
    clock = VirtualClock()
    meter = LinkMeter(clock.now_s)
    meter.sent(8)
    meter.received(0, 0.0)  # a look is no wait
    meter.received(4, 0.2)
    meter.sent(8)
    meter.received(0, 0.2)
    meter.received(4, 0.2)
    assert meter.statistics("").late == 1


def test_what_comes_unasked_or_after_reopening_answers_nothing() -> None:
    meter = LinkMeter(VirtualClock().now_s)
    meter.received(4, 0.2)
    meter.sent(8)
    meter.broken()
    meter.opened()
    meter.received(4, 0.2)
    seen = meter.statistics("")
    assert (seen.opened, seen.broken, sum(seen.answers)) == (1, 1, 0)
    assert seen.answered_within_s(0.5) is None
    assert len(seen.answers) == len(BOUNDS_S) + 1


@pytest.mark.wire
def test_a_serial_line_counts_what_it_does() -> None:
    with pseudo_terminal() as port:
        link = SerialLink(port.path, 921600)
        port.on_data = lambda data: port.write(b"12345")
        link.reopen()
        link.write(b"abc")
        while not link.read(0.5):
            pass
        port.unplug()
        with pytest.raises(DeviceError, match="is gone"):
            while True:
                link.read(0.5)
        with pytest.raises(DeviceError):
            link.reopen()
    seen = link.statistics
    assert (seen.port, seen.opened, seen.sent, seen.received) == (port.path, 1, 3, 5)
    assert seen.broken >= 2 and sum(seen.answers) == 1
