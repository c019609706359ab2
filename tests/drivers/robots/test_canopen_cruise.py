"""The longer SYNC period of a free move: where it holds, and what ends it at once."""

from itertools import pairwise

import numpy as np
import pytest

from estimation.errors import DeviceError, DeviceTimeout, MotionStopped
from tests.drivers.fakes import FakeArmLink, VirtualClock
from tests.drivers.robots.test_canopen_arm import CONFIG, DEG, TARGET, Probe, connected

PERIOD_S, CRUISE_S = CONFIG.sync_period_s, 0.05


def sync_times(link: FakeArmLink, clock: VirtualClock) -> list[float]:
    """Filled with the time of each SYNC from now on."""
    times = list[float]()

    def note(number: int) -> None:
        times.append(clock.time_s)

    link.on_sync = note
    return times


def test_a_free_move_is_watched_seldom_and_its_start_and_end_as_always() -> None:
    arm, link, clock = connected(cruise_sync_period_s=CRUISE_S)
    times = sync_times(link, clock)
    note, begin = link.on_sync, link.syncs

    def as_long_as_computed(number: int) -> None:
        note(number)
        if number == begin + 5:  # these drives have no ramps, which take 0.3 s
            for drive in link.drives.values():
                drive.velocity = round(drive.velocity * 0.5 / 0.8)

    link.on_sync = as_long_as_computed
    arm.move_joints(TARGET)
    seldom = [late - early > CRUISE_S - 1e-6 for early, late in pairwise(times)]
    assert 5 <= sum(seldom) < len(seldom)
    first, last = seldom.index(True), len(seldom) - seldom[::-1].index(True)
    assert first >= 3  # the handshake of the set-point
    assert not any(seldom[last:])
    assert len(seldom) - last >= 3
    assert all(late - early < CRUISE_S + 1e-6 for early, late in pairwise(times))


def test_readings_and_touches_are_never_seldom() -> None:
    arm, link, clock = connected(cruise_sync_period_s=CRUISE_S)
    arm.move_joints(np.zeros(6))
    times = sync_times(link, clock)
    arm.read_joints(10)
    arm.move_until_contact(TARGET, 2.0 * DEG, Probe(clock, contact_s=clock.time_s + 0.5))
    arm.read_joints(10)
    assert max(late - early for early, late in pairwise(times)) < PERIOD_S + 0.003  # a poll takes 2 ms


def test_an_arm_that_is_faster_than_computed_is_read_at_the_short_period_afterwards() -> None:
    arm, link, clock = connected(cruise_sync_period_s=CRUISE_S)

    def quick(number: int) -> None:
        for drive in link.drives.values():
            drive.velocity = 10_000_000

    link.on_sync = quick
    arm.move_joints(TARGET)
    times = sync_times(link, clock)
    arm.read_joints(5)
    assert max(late - early for early, late in pairwise(times)) < PERIOD_S + 1e-6


def test_a_stop_acts_at_once_also_between_two_seldom_syncs() -> None:
    arm, link, clock = connected(cruise_sync_period_s=CRUISE_S)
    begin_s = clock.time_s
    stopped_s: list[float] = []
    times = sync_times(link, clock)
    receive = link.receive

    def stop_in_between(timeout_s: float) -> object:
        if not stopped_s and clock.time_s > begin_s + 0.2:
            stopped_s.append(clock.time_s)
            arm.stop()
        return receive(timeout_s)

    link.receive = stop_in_between  # type: ignore[assignment, method-assign]
    with pytest.raises(MotionStopped):
        arm.move_joints(TARGET)
    assert stopped_s[0] in times
    assert all(drive.quick_stops == 1 for drive in link.drives.values())
    assert clock.time_s - stopped_s[0] < 0.2


def test_a_drive_in_fault_stops_the_others_within_the_short_period() -> None:
    arm, link, clock = connected(cruise_sync_period_s=CRUISE_S)
    times = sync_times(link, clock)
    note, begin = link.on_sync, link.syncs

    def emergency(number: int) -> None:
        note(number)
        if number == begin + 8:
            link.later(0.001, 0x85, bytes.fromhex("3073210000000000"))

    link.on_sync = emergency
    with pytest.raises(DeviceError):
        arm.move_joints(TARGET)
    assert times[8] - times[7] < PERIOD_S + 1e-6
    assert link.drives[3].quick_stops == 1


def test_a_missing_answer_is_asked_for_again_at_the_short_period() -> None:
    arm, link, clock = connected(cruise_sync_period_s=CRUISE_S)
    times = sync_times(link, clock)
    note, begin = link.on_sync, link.syncs

    def fall_silent(number: int) -> None:
        note(number)
        link.drives[8].silent = number >= begin + 8

    link.on_sync = fall_silent
    with pytest.raises(DeviceTimeout, match=r"Joint 6 \(node 8\): no answer to 3 SYNCs"):
        arm.move_joints(TARGET)
    missed = times[7:10]
    assert missed[1] - missed[0] == pytest.approx(CRUISE_S + PERIOD_S)  # one period of silence in between
    assert missed[2] - missed[1] == pytest.approx(2 * PERIOD_S)
