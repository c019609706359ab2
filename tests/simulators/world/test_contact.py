"""The stylus: every contact is found, whenever one asks, at the right instant."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.transform import FloatArray
from simulators.robots.motion_profile import AxisMotion, Phase
from simulators.world.contact import StylusContact
from simulators.world.truth import Truth
from simulators.world.world import World
from simulators.world.world_file import WorldFile

SPEED_RAD_S = 0.05
SWEEP_RAD = 0.05


class OneJoint:
    """Only joint 2 moves: back and forth by SWEEP_RAD, from `start`, at a constant speed."""

    def __init__(self, start: FloatArray, sweeps: int) -> None:
        self.start, self.axis = start, AxisMotion(0.0)
        self.turn_s = SWEEP_RAD / SPEED_RAD_S
        phases = [
            Phase(1 + n * self.turn_s, SWEEP_RAD * (n % 2), SPEED_RAD_S * (1 - 2 * (n % 2)), 0.0)
            for n in range(sweeps)
        ]
        self.axis.follow([*phases, Phase(1 + sweeps * self.turn_s, SWEEP_RAD * (sweeps % 2), 0.0, 0.0)])

    def advance(self, time_s: float) -> None:
        pass

    def joints_at(self, time_s: float) -> FloatArray:
        return self.start + np.array([0, self.axis.position(time_s), 0, 0, 0, 0])

    def standstill(self, time_s: float) -> tuple[int, ...] | None:
        return None

    def course(self, time_s: float) -> tuple[list[float], list[float], float]:
        speed, _, until_s = self.axis.course(time_s)
        return [0, speed, 0, 0, 0, 0], [0.0] * 6, until_s

    def plans(self) -> int:
        return self.axis.plans


def scene(world_file: WorldFile, nominal: Truth, sweeps: int) -> tuple[StylusContact, World, OneJoint]:
    """The plate lies across the way of the ball, and is thicker than the ball goes in."""
    arm = OneJoint(world_file.arm.start_joints_rad, sweeps)
    world = World(world_file, nominal, arm, noise_factor=0.0)
    here, there = (np.array(world.ball(arm.joints_at(t))) for t in (1.0, 1.0 + arm.turn_s))
    way = (there - here) / np.linalg.norm(there - here)
    across = np.linalg.svd(way[None])[2]
    plate = np.eye(4)
    plate[:3, :3] = np.column_stack([across[1], np.cross(-way, across[1]), -way])
    plate[:3, 3] = here + 0.6 * (there - here)
    world = World(world_file, replace(nominal, base_T_plate=plate), arm, noise_factor=0.0)
    return StylusContact(world, arm), world, arm


def first_contact_s(world: World, arm: OneJoint) -> float:
    low, high = 1.0, 1.0 + arm.turn_s
    for _ in range(60):
        middle = (low + high) / 2
        touches = min(gap for _, gap in world.clearances_m(arm.joints_at(middle))) <= 0
        low, high = (low, middle) if touches else (middle, high)
    return high


@given(st.lists(st.floats(1e-4, 0.5), min_size=1, max_size=60))
@settings(max_examples=15, deadline=None)
def test_contacts_do_not_depend_on_when_one_asks(
    world_file: WorldFile, nominal: Truth, pauses: list[float]
) -> None:
    contact, world, arm = scene(world_file, nominal, sweeps=4)
    time_s = 0.0
    for pause in pauses:
        time_s += pause
        contact.update(time_s)
    contact.update(1 + 4 * arm.turn_s + 1)
    assert contact.count == 2 and not contact.closed
    assert {touch.surface for touch in contact.touches} == {"plate"}
    expected = first_contact_s(world, arm)
    assert contact.touches[0].time_s == pytest.approx(expected, abs=1e-4)
    assert contact.touches[1].time_s == pytest.approx(expected + 2 * arm.turn_s, abs=1e-4)


def test_the_switch_is_closed_while_pressed(world_file: WorldFile, nominal: Truth) -> None:
    contact, world, arm = scene(world_file, nominal, sweeps=2)
    touched_s = first_contact_s(world, arm)
    contact.update(touched_s - 0.001)
    assert (contact.closed, contact.count) == (False, 0)
    contact.update(touched_s + 0.001)
    assert (contact.closed, contact.count) == (True, 1)
    contact.update(1 + arm.turn_s)
    assert contact.closed and contact.deepest_m > 5e-3
    contact.update(100.0)
    assert (contact.closed, contact.count) == (False, 1)


def test_contacts_scatter_along_the_normal(world_file: WorldFile, nominal: Truth) -> None:
    quiet, world, arm = scene(world_file, nominal, sweeps=2)
    quiet.update(100.0)
    sweeps = 200
    contact, noisy, arm = scene(world_file, nominal, sweeps=sweeps)
    noisy.noise_factor = 1.0
    contact._draw_scatter()
    contact.update(1e4)
    assert contact.count == sweeps // 2
    starts = 1 + 2 * arm.turn_s * np.arange(sweeps // 2)
    late_s = np.array([touch.time_s for touch in contact.touches]) - starts
    here, there = (np.array(world.ball(arm.joints_at(t))) for t in (1.5, 1.501))
    speed = float(np.linalg.norm(there - here)) / 0.001
    sigma = np.hypot(world_file.probe.noise_m, world_file.plate.flatness_m)
    assert np.std(late_s) * speed == pytest.approx(sigma, rel=0.25)
    assert np.mean(late_s) == pytest.approx(quiet.touches[0].time_s - 1, abs=4.5 * sigma / speed / 10)


def test_a_part_that_is_taken_away_no_longer_presses(world_file: WorldFile, nominal: Truth) -> None:
    arm = OneJoint(world_file.arm.start_joints_rad, 0)
    ball = np.array(World(world_file, nominal, arm).ball(arm.start))
    part = np.eye(4)
    part[:3, 3] = ball - (0.05, 0.02, 0.1005)
    world = World(world_file, replace(nominal, base_T_part=part), arm)
    contact = StylusContact(world, arm)
    assert contact.closed
    world.part_present = False
    contact.update(1.0)
    contact.update(2.0)
    assert not contact.closed
