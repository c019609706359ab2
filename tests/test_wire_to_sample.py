"""From the wire to the sample: the drivers against the simulated devices, byte for byte, in virtual time."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from controller.cellfile import Cell, load_cell
from controller.devices import make_devices
from drivers.capabilities import Devices, RangeReadings
from drivers.clock import Clock
from estimation.errors import DeviceError, DeviceTimeout, FrameError, MotionStopped
from estimation.transform import FloatArray
from simulators.virtual import SimulatedCell
from tests.support.postures import looking_down

CELL = Path(__file__).parents[1] / "cells" / "bench-block"
COUNT_RAD = np.radians(0.001)


@dataclass
class Rig:
    """One simulated cell with its drivers, connected."""

    world: SimulatedCell
    cell: Cell
    devices: Devices

    @property
    def clock(self) -> Clock:
        return self.world.clock

    def truth_rad(self) -> FloatArray:
        return self.world.arm.joints_at(self.clock.now_s())

    def joints_with(self, tool: FloatArray, base_p: FloatArray) -> FloatArray:
        """Joints (6,) near the present ones that bring flange_T_tool (4, 4) to a point, looking down."""
        return looking_down(self.cell.robot.arm_model(), tool, base_p, self.truth_rad())

    def window(self) -> RangeReadings:
        self.devices.laser.begin_window()
        self.devices.robot.read_joints(3)
        return self.devices.laser.end_window(40)


@pytest.fixture(scope="module")
def cell() -> Cell:
    return load_cell(CELL)


@pytest.fixture
def rig(cell: Cell, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    cache = tmp_path_factory.getbasetemp() / "faces"
    world = SimulatedCell(CELL, seed=5, cache_dir=cache)
    devices = make_devices(cell, world.ports, world.clock, keep_alive_thread=False)
    for device in devices.all():
        device.connect()
    yield Rig(world, cell, devices)
    for device in devices.all():
        device.close()


def above_plate(rig: Rig, tool: FloatArray, height_m: float) -> FloatArray:
    plate = rig.world.truth.base_T_plate
    return rig.joints_with(tool, plate[:3, 3] + height_m * plate[:3, 2])


def test_the_arm_goes_where_it_is_told_and_says_so(rig: Rig) -> None:
    rng = np.random.default_rng(1)
    start = rig.truth_rad()
    for target in start + rng.uniform(-0.3, 0.3, (4, 6)):
        rig.devices.robot.move_joints(target)
        assert rig.devices.robot.is_at_rest()
        assert rig.truth_rad() == pytest.approx(target, abs=COUNT_RAD)
        readings = rig.devices.robot.read_joints(5)
        assert readings.joints_rad == pytest.approx(np.tile(target, (5, 1)), abs=12 * COUNT_RAD)


def test_readings_in_motion_belong_to_the_instant_of_their_sync(rig: Rig) -> None:
    robot, start = rig.devices.robot, rig.truth_rad()
    watched = list[tuple[float, FloatArray]]()
    seen = robot._master.samples  # type: ignore[attr-defined]
    robot.move_joints(start + 0.2)
    watched = [(sample.time_s, np.array(sample.counts) * COUNT_RAD) for sample in seen]
    moving = [
        (time_s, joints)
        for time_s, joints in watched
        if np.abs(rig.world.arm.joints_at(time_s + 0.01) - rig.world.arm.joints_at(time_s - 0.01)).max()
        > 1e-3
    ]
    assert len(moving) > 5
    for time_s, joints in moving:
        assert joints == pytest.approx(rig.world.arm.joints_at(time_s), abs=12 * COUNT_RAD)


def test_the_path_is_straight_in_joint_space(rig: Rig) -> None:
    robot, start = rig.devices.robot, rig.truth_rad()
    way = np.array([0.4, -0.1, 0.05, 0.3, 0.01, -0.2])
    began_s = rig.clock.now_s()
    robot.move_joints(start + way)
    times_s = np.linspace(began_s, rig.clock.now_s(), 60)
    moved = np.array([rig.world.arm.joints_at(t) for t in times_s]) - start
    share = moved / way
    assert np.ptp(share, axis=1).max() < 0.01


def test_a_laser_window_gives_the_true_distance(rig: Rig) -> None:
    truth = rig.world.truth
    for height_m in (0.065, 0.085, 0.110):
        rig.devices.robot.move_joints(above_plate(rig, truth.flange_T_laser, height_m))
        readings = rig.window()
        assert readings.rejected == 0
        assert len(readings.distance_m) >= 100  # 60 ms at 2 kHz
        joints = rig.truth_rad()
        hit = rig.world.world.beam_hit(joints)
        assert hit is not None and hit.surface == "plate"
        expected_m = (hit.distance_m - truth.laser_offset_m) / (1 + truth.laser_scale)
        noise_m = rig.cell.laser.noise_m + 0.002e-3
        assert np.mean(readings.distance_m) == pytest.approx(expected_m, abs=5 * noise_m)
        assert np.std(readings.distance_m) == pytest.approx(rig.cell.laser.reading_noise_m, rel=0.4)
        assert np.all(np.diff(readings.time_s) > 0)


def test_no_target_is_told_in_words(rig: Rig) -> None:
    readings = rig.window()  # the start posture looks into the air
    assert readings.distance_m.size == 0
    assert readings.rejected_kinds == ("no peak",)


def test_a_touch_gives_the_joints_at_contact(rig: Rig) -> None:
    robot, probe, truth = rig.devices.robot, rig.devices.probe, rig.world.truth
    start = above_plate(rig, truth.flange_T_probe, 0.010)
    robot.move_joints(start)
    end = above_plate(rig, truth.flange_T_probe, -0.004)  # nearest to where the arm now stands
    assert np.abs(end - start).max() < 0.2  # the same branch of the inverse kinematics
    assert probe.is_open()
    probe.arm()
    speed_rad_s = 0.001 * float(np.abs(end - start).max()) / 0.014  # 1 mm/s
    contact = robot.move_until_contact(end, speed_rad_s, probe)
    assert contact is not None and 1.0 <= contact.readings <= 2.0
    (touch,) = rig.world.contact.touches
    assert touch.surface == "plate"
    limit = speed_rad_s * probe.poll_uncertainty_s + 8 * COUNT_RAD
    assert contact.joints_rad == pytest.approx(rig.world.arm.joints_at(touch.time_s), abs=limit)
    assert robot.is_at_rest()
    assert rig.world.contact.deepest_m < 1e-4
    with pytest.raises(DeviceError, match="tripped before the approach"):
        probe.arm()
    robot.move_joints(start)
    assert probe.is_open()


def test_a_search_into_the_air_ends_without_a_touch(rig: Rig) -> None:
    robot, probe = rig.devices.robot, rig.devices.probe
    start = above_plate(rig, rig.world.truth.flange_T_probe, 0.050)
    robot.move_joints(start)
    probe.arm()
    assert robot.move_until_contact(start + 0.01, 0.02, probe) is None


def test_a_stop_ends_the_move_and_release_allows_the_next(rig: Rig) -> None:
    robot, start = rig.devices.robot, rig.truth_rad()

    class StopsTheArm:
        poll_uncertainty_s = 0.004

        def touched_at_s(self) -> float | None:
            rig.clock.sleep(0.004)
            if rig.clock.now_s() > began_s + 0.4:
                robot.stop()
            return None

    began_s = rig.clock.now_s()
    with pytest.raises(MotionStopped):
        robot.move_until_contact(start + 0.5, 0.5, StopsTheArm())  # type: ignore[arg-type]
    assert robot.is_at_rest()
    robot.release()
    robot.move_joints(start)


def test_a_fault_of_one_joint_stops_all_and_is_told_in_words(rig: Rig) -> None:
    robot, start = rig.devices.robot, rig.truth_rad()

    class FailingDrive:
        poll_uncertainty_s = 0.004
        failed = False

        def touched_at_s(self) -> float | None:
            rig.clock.sleep(0.004)
            if not self.failed and rig.clock.now_s() > began_s + 0.4:
                self.failed = True
                rig.world.arm.fault(2, 0x8611, rig.clock.now_s())
            return None

    began_s = rig.clock.now_s()
    with pytest.raises(DeviceError, match=r"Joint 3 \(node 5\) .*following error"):
        robot.move_until_contact(start + 0.5, 0.5, FailingDrive())  # type: ignore[arg-type]
    stood = rig.truth_rad()
    rig.clock.sleep(0.5)
    assert rig.truth_rad() == pytest.approx(stood, abs=1e-9)
    with pytest.raises(DeviceError, match="following error"):
        robot.read_joints(1)
    robot.connect()
    robot.move_joints(start)


def test_unplugged_devices_are_told_and_connect_repairs_them(rig: Rig) -> None:
    world = rig.world
    for link, ask, again in (
        (world.arm_link, lambda: rig.devices.robot.read_joints(1), rig.devices.robot.connect),
        (world.laser_link, lambda: rig.devices.laser.end_window(5), rig.devices.laser.connect),
        (world.probe_link, rig.devices.probe.is_open, rig.devices.probe.connect),
    ):
        link.unplugged = True
        with pytest.raises(DeviceError, match="is gone"):
            ask()
        with pytest.raises(DeviceError, match="is gone"):
            again()
        link.unplugged = False
        again()
        if link is world.laser_link:
            rig.devices.laser.begin_window()
        ask()
    assert [device.health().reconnects for device in rig.devices.all()] == [1, 1, 1]


def test_silent_devices_are_noticed_in_their_time(rig: Rig) -> None:
    world = rig.world
    rig.devices.laser.begin_window()
    for link, ask, limit_s in (
        (world.arm_link, lambda: rig.devices.robot.read_joints(100), 0.30),
        (world.laser_link, lambda: rig.devices.laser.end_window(50), 0.30),
        (world.probe_link, rig.devices.probe.is_open, 0.50),
    ):
        began_s = rig.clock.now_s()
        link.faults.add("drop")
        with pytest.raises(DeviceTimeout):
            ask()
        assert rig.clock.now_s() - began_s <= limit_s
        link.faults.clear()


def test_garbage_and_single_bytes_do_not_reach_the_sample(rig: Rig) -> None:
    rig.devices.robot.move_joints(above_plate(rig, rig.world.truth.flange_T_laser, 0.085))
    clean = rig.window()
    for noise in (b"\xff\x00\x41", b"->", b"\x80"):
        rig.world.laser_link.faults.add("garbage", payload=noise, once=True)
    spoiled = rig.window()
    assert np.mean(spoiled.distance_m) == pytest.approx(np.mean(clean.distance_m), abs=1e-5)
    assert spoiled.distance_m == pytest.approx(
        np.full(len(spoiled.distance_m), np.mean(clean.distance_m)), abs=1e-4
    )
    assert rig.devices.laser.health().bad_frames >= 1
    rig.world.probe_link.faults.add("split")
    assert rig.devices.probe.is_open()
    rig.world.probe_link.faults.add("garbage", payload=b"\1\2\3\4\5\6\7\x08", once=True)
    try:
        assert rig.devices.probe.is_open()
    except FrameError as error:
        assert "not a Modbus TCP frame" in str(error)
