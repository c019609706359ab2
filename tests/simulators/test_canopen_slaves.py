"""Simulated CANopen devices that are no drives: worked frames, boot-up, events, timers, refusals."""

import math
import struct
from collections.abc import Iterator

import numpy as np
import pytest

from estimation.transform import FloatArray
from simulators.canopen_slave import CanopenSlave
from simulators.probes.wago750 import Wago750, WagoSpec
from simulators.sensors.ams335i import Ams335i, AmsSpec


class Contact:
    """Opened and closed by hand."""

    closed = False

    def update(self, time_s: float) -> None:
        pass

    def unchanged_until_s(self, time_s: float) -> float:
        return time_s


class Target:
    """At `m` metres."""

    m = 12.3456

    def beam_lengths_m(self, times_s: FloatArray) -> FloatArray:
        return np.full(len(times_s), self.m)


class Bus:
    """A master that speaks in bytes."""

    def __init__(self, device: CanopenSlave) -> None:
        self.device, self.time_s = device, 1.0

    def send(self, can_id: int, data: str = "", wait_s: float = 0.003) -> list[str]:
        """The frames that come within the time, as in the manuals."""
        self.device.receive(can_id, bytes.fromhex(data), self.time_s)
        return self.wait(wait_s)

    def wait(self, duration_s: float) -> list[str]:
        return [line for line, _ in self.timed(duration_s)]

    def timed(self, duration_s: float) -> Iterator[tuple[str, float]]:
        end_s = self.time_s + duration_s
        while frames := self.device.next_frames(end_s):
            for frame in frames:
                yield (
                    f"{frame.can_id:03X} [{len(frame.data)}] {frame.data.hex(' ').upper()}".strip(),
                    frame.time_s,
                )
        self.time_s = end_s

    def sdo(self, request: str) -> str:
        (answer,) = self.send(0x600 + self.device.node, request)
        return answer

    def write(self, index: int, sub: int, value: int, size: int) -> str:
        data = struct.pack("<BHBI", 0x23 | (4 - size) << 2, index, sub, value)
        return self.sdo(data.hex())[-11:]

    def start(self) -> None:
        self.send(0x000, f"01 {self.device.node:02X}")


@pytest.fixture
def contact() -> Contact:
    return Contact()


@pytest.fixture
def station(contact: Contact) -> Bus:
    bus = Bus(Wago750(WagoSpec(), contact))
    bus.write(0x6005, 0, 1, 1)
    return bus


@pytest.fixture
def laser() -> Bus:
    return Bus(Ams335i(AmsSpec(), Target(), 0.0, 0.0, np.random.default_rng(1)))


def test_touch_and_release_as_calculated(station: Bus, contact: Contact) -> None:
    station.start()
    assert station.wait(1.0) == []  # the first state is not sent
    contact.closed = True
    assert station.wait(1.0) == ["194 [1] 01"]
    contact.closed = False
    assert station.wait(1.0) == ["194 [1] 00"]


def test_nothing_is_sent_before_the_start_or_without_interrupts(station: Bus, contact: Contact) -> None:
    contact.closed = True
    assert station.wait(1.0) == []
    station.write(0x6005, 0, 0, 1)
    station.start()
    contact.closed = False
    assert station.wait(1.0) == []


@pytest.mark.parametrize(("mask", "sent"), [(0x6007, ["194 [1] 01"]), (0x6008, ["194 [1] 00"])])
def test_masks_choose_the_edge(station: Bus, contact: Contact, mask: int, sent: list[str]) -> None:
    station.write(0x6006, 1, 0, 1)
    station.write(mask, 1, 1, 1)
    station.start()
    frames = []
    for contact.closed in (True, False):
        frames += station.wait(0.1)
    assert frames == sent


def test_communication_parameters_change_only_while_the_pdo_is_off(station: Bus) -> None:
    assert station.write(0x1800, 5, 20, 2) == "22 00 00 08"
    assert station.write(0x1800, 1, 0x80000194, 4) == "00 00 00 00"
    assert station.write(0x1800, 5, 20, 2) == "00 00 00 00"
    assert station.write(0x1800, 1, 0x194, 4) == "00 00 00 00"
    station.start()
    times = [at_s for _, at_s in station.timed(1.0)]
    assert np.diff(times) == pytest.approx(0.02)


def test_the_inhibit_time_holds_a_change_back(station: Bus, contact: Contact) -> None:
    station.write(0x1800, 1, 0x80000194, 4)
    station.write(0x1800, 3, 500, 2)  # 50 ms
    station.write(0x1800, 1, 0x194, 4)
    station.start()
    station.wait(1.0)
    contact.closed = True
    first = [at_s for _, at_s in station.timed(0.01)]
    contact.closed = False
    second = [at_s for _, at_s in station.timed(0.1)]
    assert second[0] - first[0] == pytest.approx(0.05, abs=0.002)


def test_outputs_by_process_data(station: Bus) -> None:
    assert station.send(0x214, "80") == []
    station.start()
    station.send(0x214, "80")
    assert station.sdo("40 00 62 01 00 00 00 00") == "594 [8] 4F 00 62 01 80 00 00 00"


def test_boot_up_heartbeat_and_lost_settings(station: Bus) -> None:
    station.write(0x1017, 0, 100, 2)
    assert station.wait(0.25) == ["714 [1] 7F", "714 [1] 7F"]
    station.start()
    assert station.wait(0.2) == ["714 [1] 05", "714 [1] 05"]
    station.device.restart(station.time_s)
    assert station.send(0x614, "40 00 10 00 00 00 00 00", 0.1) == []
    station.start()  # before boot-up it is lost
    assert station.wait(1.0) == ["714 [1] 00"]
    assert station.sdo("40 17 10 00 00 00 00 00") == "594 [8] 4B 17 10 00 00 00 00 00"


def test_reset_of_communication_keeps_what_belongs_to_the_application(station: Bus) -> None:
    station.write(0x1017, 0, 50, 2)
    station.write(0x6206, 1, 0x0F, 1)
    station.send(0x000, "82 14")
    assert station.wait(1.0) == ["714 [1] 00"]  # and no heartbeat
    assert station.sdo("40 06 62 01 00 00 00 00").endswith("4F 06 62 01 0F 00 00 00")
    station.send(0x000, "81 14")
    station.wait(1.0)
    assert station.sdo("40 06 62 01 00 00 00 00").endswith("4F 06 62 01 FF 00 00 00")


def test_refusals(station: Bus) -> None:
    assert station.sdo("40 99 60 00 00 00 00 00").endswith("00 00 02 06")
    assert station.write(0x6000, 1, 1, 1) == "02 00 01 06"
    assert station.sdo("40 00 60 09 00 00 00 00").endswith("11 00 09 06")
    station.send(0x000, "02 14")
    assert station.send(0x614, "40 00 10 00 00 00 00 00") == []  # stopped


def test_position_as_calculated(laser: Bus) -> None:
    laser.start()
    assert "290 [8] 40 E2 01 00 00 00 00 00" in laser.send(0x080)
    assert laser.sdo("40 04 60 00 00 00 00 00") == "590 [8] 43 04 60 00 40 E2 01 00"
    assert laser.sdo("40 00 10 00 00 00 00 00") == "590 [8] 43 00 10 00 96 01 08 00"


def test_a_broken_beam_is_hidden_for_a_while_and_then_as_calculated(laser: Bus) -> None:
    laser.start()
    laser.send(0x080)
    laser.device._beam.m = math.nan  # type: ignore[attr-defined]
    assert "290 [8] 40 E2 01 00 00 00 00 00" in laser.send(0x080)  # stale by design
    laser.wait(0.1)
    assert "290 [8] 00 00 00 00 00 00 01 00" in laser.send(0x080)


def test_nothing_is_hidden_without_suppression_and_delay(laser: Bus) -> None:
    laser.write(0x2070, 0, 1, 1)
    laser.start()
    laser.send(0x080)
    laser.device._beam.m = math.nan  # type: ignore[attr-defined]
    assert "290 [8] 00 00 00 00 00 00 01 00" in laser.send(0x080)
    laser.write(0x2070, 0, 0, 1)
    assert "290 [8] 40 E2 01 00 00 00 01 00" in laser.send(0x080)  # the last good one, and says so
