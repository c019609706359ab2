"""How the arm moves, what it reads, and what it does when its master is silent."""

import struct

import numpy as np
import pytest

from simulators.robots.canopen_arm import COUNT_RAD, SimulatedArm
from simulators.world.truth import stream
from simulators.world.world_file import WorldFile
from tests.simulators.can_master import Master


def test_a_move_obeys_speed_and_acceleration(master: Master) -> None:
    master.enable()
    master.write(3, 0x6083, 0, 100_000, 4)
    master.move(30_000, 20_000)
    master.wait(0.5)
    assert master.read(3, 0x606C) == 20_000 and not master.status(3) & 0x400
    master.wait(30_000 / 20_000 + 20_000 / 100_000)
    assert master.status(3) & 0x400 and master.joint_counts() == 30_000


def test_the_motors_have_a_top_speed(master: Master, world_file: WorldFile) -> None:
    master.enable()
    master.move(100_000, 1_000_000)
    master.wait(0.7)
    assert master.read(3, 0x606C) * COUNT_RAD == pytest.approx(world_file.arm.speed_limit_rad_s, rel=1e-4)


def test_a_target_beyond_the_limit_is_cut_and_flagged(master: Master) -> None:
    master.enable()
    master.move(175_000, 90_000)
    master.wait(5)
    assert master.joint_counts() == 170_000 and master.status(3) & 0xC00 == 0xC00


def test_halt_interrupts_and_its_end_resumes(master: Master) -> None:
    master.enable()
    master.move(40_000, 20_000)
    master.wait(0.5)
    master.write(3, 0x6040, 0, 0x10F, 2)
    master.wait(0.5)
    rest = master.joint_counts()
    assert master.read(3, 0x606C) == 0 and 0 < rest < 40_000 and master.status(3) & 0x6F == 0x27
    master.write(3, 0x6040, 0, 0x00F, 2)
    master.wait(3)
    assert master.joint_counts() == 40_000


def test_a_new_set_point_replaces_a_halted_move(master: Master) -> None:
    master.enable()
    master.move(40_000, 20_000)
    master.wait(0.5)
    master.write(3, 0x6040, 0, 0x10F, 2)
    master.wait(0.5)
    master.move(-10_000, 20_000, word=0x3F)
    master.wait(6)
    assert master.joint_counts() == -10_000


def test_set_points_queue_unless_told_otherwise(master: Master) -> None:
    master.enable()
    master.move(20_000, 20_000)
    master.wait(0.3)
    master.move(0, 20_000)
    assert master.status(3) & 0x1000  # its buffer is full
    master.wait(0.9)
    assert master.joint_counts() > 15_000
    master.wait(2)
    assert master.joint_counts() == 0 and master.status(3) & 0x1400 == 0x400


def test_quick_stop_is_quick_and_disables(master: Master) -> None:
    master.enable()
    master.move(80_000, 80_000)
    master.wait(0.8)
    before = master.joint_counts()
    master.write(3, 0x6040, 0, 0x02, 2)
    master.wait(0.5)
    assert master.joint_counts() - before < 80_000**2 / (2 * 800_000) * 1.5
    assert master.status(3) & 0x4F == 0x40


def test_only_fast_moves_are_sped_up_and_all_joints_alike(world_file: WorldFile) -> None:
    master = Master(SimulatedArm(world_file.arm, stream(1, "test"), np.zeros(6), motion_speed=10))
    for node in (3, 4):
        master.enable(node)
        master.send(0x000, bytes([1, node]))
    for node, counts, speed in ((3, 40_000, 20_000), (4, 4_000, 2_000)):
        master.send(0x300 + node, struct.pack("<iI", counts, speed))
        master.send(0x200 + node, struct.pack("<Hhi", 0x1F, 0, 0))
    master.sync(13)  # 2.1 s, ten times faster
    assert (master.joint_counts(0), master.joint_counts(1)) == (40_000, 4_000)
    master.move(0, 2_000, node=4)
    master.wait(1.0)
    assert master.joint_counts(1) > 1_500


# -- watchdogs -----------------------------------------------------------------------------------


def test_a_silent_sync_during_motion_stops_the_arm(master: Master) -> None:
    master.enable()
    master.send(0x000, "01 03")
    master.write(3, 0x1006, 0, 20_000, 4)
    master.sync()
    master.move(60_000, 10_000)
    master.sync(20)
    assert not [frame for frame in master.heard if frame.can_id == 0x083]
    frames = master.wait(1.0)  # 200Eh = 6 periods of 20 ms
    emergency = next(frame for frame in frames if frame.can_id == 0x083)
    assert emergency.data[:3].hex(" ") == "30 81 11"
    assert emergency.time_s == pytest.approx(master.time_s - 1.0 + 0.1, abs=0.01)
    assert master.status(3) & 0x4F == 0x08 and master.joint_counts() < 10_000


def test_a_silent_sync_at_rest_is_nothing(master: Master) -> None:
    master.enable()
    master.send(0x000, "01 03")
    master.sync()
    master.wait(10)
    assert master.status(3) & 0x6F == 0x27


def test_a_master_that_was_heard_must_go_on(master: Master) -> None:
    master.enable()
    master.write(3, 0x1016, 1, 1 << 16 | 300, 4)
    master.wait(5)
    assert master.status(3) & 0x6F == 0x27  # never heard, so not missed
    for _ in range(10):
        master.send(0x701, "05")
        master.wait(0.1)
    assert master.status(3) & 0x6F == 0x27
    master.move(60_000, 5_000)
    master.wait(1.0)
    assert master.status(3) & 0x4F == 0x08
    assert any(frame.can_id == 0x083 and frame.data[:2] == b"\x30\x81" for frame in master.heard)


def test_without_run_permission_nothing_can_be_enabled(arm: SimulatedArm, master: Master) -> None:
    master.enable()
    master.move(60_000, 5_000)
    arm.permit(False, master.time_s)
    master.wait(0.5)
    assert master.status(3) & 0x4F == 0x40 and master.read(3, 0x20A0, 7) == 0
    for word in (6, 7, 15):
        master.write(3, 0x6040, 0, word, 2)
    assert master.status(3) & 0x4F == 0x40
    arm.permit(True, master.time_s)
    master.enable()


# -- readings ------------------------------------------------------------------------------------


def test_readings_scatter_as_declared(world_file: WorldFile) -> None:
    factors = np.array([1, 1, 1, 3, 1, 1])
    master = Master(SimulatedArm(world_file.arm, stream(1, "test"), factors))
    master.send(0x000, "01 00")
    readings = np.array(
        [
            [int.from_bytes(frame.data[:4], "little", signed=True) for frame in frames[:6]]
            for frames in (
                sorted((f for f in master.sync() if f.can_id >> 7 == 0x380 >> 7), key=lambda f: f.can_id)
                for _ in range(2000)
            )
        ]
    )
    expected = np.sqrt((factors * world_file.arm.noise_rad / COUNT_RAD) ** 2 + 1 / 12)
    np.testing.assert_allclose(readings.std(axis=0), expected, rtol=0.08)
    np.testing.assert_allclose(
        readings.mean(axis=0), world_file.arm.start_joints_rad / COUNT_RAD, atol=5 * 4.5 / np.sqrt(2000)
    )
    correlation = np.corrcoef(readings.T) - np.eye(6)
    assert np.abs(correlation).max() < 0.12
