"""The arm driver against scripted drives in virtual time: what a user of the cell relies on."""

import math
import struct

import numpy as np
import pytest

from drivers.links.interfaces import CanFrame
from drivers.robots.canopen_arm import CanopenArm
from drivers.robots.canopen_arm_setup import ArmConfig
from estimation.errors import DeviceError, DeviceTimeout, IdentityMismatch, MotionStopped
from estimation.transform import FloatArray
from tests.drivers.fakes import FakeArmLink, VirtualClock

DEG = math.pi / 180.0
CONFIG = ArmConfig(
    node_ids=(3, 4, 5, 6, 7, 8),
    lower_rad=(-170 * DEG,) * 6,
    upper_rad=(170 * DEG,) * 6,
    speed_limit_rad_s=(60 * DEG,) * 6,
    acceleration_limit_rad_s2=(200 * DEG,) * 6,
    in_position_rad=0.005 * DEG,
    model="PRBT",
)
TARGET = np.array([10.0, -20.0, 30.0, 0.0, 5.0, -1.0]) * DEG


class Probe:
    """Trips at a given time of the virtual clock; each poll takes 2 ms."""

    poll_uncertainty_s = 0.004

    def __init__(self, clock: VirtualClock, contact_s: float = math.inf) -> None:
        self.clock, self.contact_s = clock, contact_s

    def touched_at_s(self) -> float | None:
        self.clock.sleep(0.002)
        return self.contact_s if self.clock.time_s >= self.contact_s else None


def connected(**changes: object) -> tuple[CanopenArm, FakeArmLink, VirtualClock]:
    clock = VirtualClock()
    link = FakeArmLink(clock)
    values = {name: getattr(CONFIG, name) for name in CONFIG.__slots__}
    arm = CanopenArm(link, ArmConfig(**(values | changes)), clock, keep_alive_thread=False)
    arm.connect()
    return arm, link, clock


def test_connect_reads_who_answers_and_enables_every_drive() -> None:
    clock = VirtualClock()
    link = FakeArmLink(clock)
    identity = CanopenArm(link, CONFIG, clock, keep_alive_thread=False).connect()
    assert identity.model == "PRBT"
    assert identity.serial_number == "1003,1004,1005,1006,1007,1008"
    assert all(drive.statusword & 0x6F == 0x27 for drive in link.drives.values())
    for node, drive in link.drives.items():
        assert drive.objects[0x1017, 0] == struct.pack("<H", 100)
        assert drive.objects[0x1016, 1] == bytes(4)  # without a keeper nobody could beat the heart
        assert [drive.objects[0x1A00, sub] for sub in (1, 2)] == [b"\x10\0\x41\x60", b"\x20\0\x64\x60"]
        assert drive.objects[0x1801, 1] == struct.pack("<I", 0x80000280 + node)


def test_no_object_is_touched_that_this_arm_lacks_and_no_driver_needs() -> None:
    _, link, _ = connected()
    asked = {struct.unpack_from("<H", data, 1)[0] for can_id, data in link.sent if can_id & 0x780 == 0x600}
    assert not asked & {0x603F, 0x6067, 0x6068, 0x6084, 0x6085, 0x60FF, *range(0x605A, 0x605F)}


def test_a_move_ends_at_the_target_and_all_joints_arrive_together() -> None:
    arm, link, _ = connected()
    arm.move_joints(TARGET)
    readings = arm.read_joints(3)
    assert readings.joints_rad == pytest.approx(np.tile(TARGET, (3, 1)), abs=0.001 * DEG)
    durations = [abs(d.target) / d.velocity for d in link.drives.values() if d.target]
    assert durations == pytest.approx([durations[0]] * len(durations), rel=1e-2)
    fastest = max(drive.velocity for drive in link.drives.values())
    assert fastest == pytest.approx(60_000, abs=1)


def test_readings_are_fresh_and_stamped_with_consecutive_syncs() -> None:
    arm, _, clock = connected()
    asked_s = clock.time_s
    readings = arm.read_joints(4)
    assert readings.time_s.min() >= asked_s
    assert np.diff(readings.time_s) == pytest.approx(0.02, abs=1e-6)


def test_a_target_outside_the_limits_is_refused_before_anything_moves() -> None:
    arm, link, _ = connected()
    before = len(link.sent)
    with pytest.raises(DeviceError, match=r"joint 2 is 171.000 deg, limits -170.000 to 170.000"):
        arm.move_joints(np.array([0, 171, 0, 0, 0, 0]) * DEG)
    assert len(link.sent) == before


def test_the_joints_at_contact_are_those_of_the_contact_and_not_of_the_stop() -> None:
    arm, link, clock = connected()
    arm.move_joints(np.zeros(6))
    speed = 2.0 * DEG
    probe = Probe(clock, contact_s=clock.time_s + 0.5)
    started = np.zeros(6)
    contact = arm.move_until_contact(np.array([5.0, 0, 0, 0, 0, 0]) * DEG, speed, probe)
    assert contact is not None and 1.0 <= contact.readings <= 2.0
    moving_from_s = (
        next(s.time_s for s in arm._master.samples if s.counts[0] > 0 and s.time_s > 100) - 0.02
    )  # drives start at the SYNC before the first moved sample
    assert contact.joints_rad[0] - started[0] == pytest.approx(
        speed * (probe.contact_s - moving_from_s), abs=0.002 * DEG
    )
    assert arm.is_at_rest()
    assert link.drives[3].position < 2_000  # came to rest soon after


def test_after_a_contact_the_old_target_is_not_resumed() -> None:
    arm, _, clock = connected()
    arm.move_until_contact(np.full(6, 5.0) * DEG, 2.0 * DEG, Probe(clock, clock.time_s + 0.3))
    arm.move_joints(np.zeros(6))
    assert arm.read_joints(1).joints_rad == pytest.approx(np.zeros((1, 6)), abs=0.001 * DEG)


def test_a_search_that_touches_nothing_returns_none_at_the_target() -> None:
    arm, _, clock = connected()
    target = np.full(6, 0.5) * DEG
    assert arm.move_until_contact(target, 2.0 * DEG, Probe(clock)) is None
    assert arm.read_joints(1).joints_rad[0] == pytest.approx(target, abs=0.001 * DEG)


def test_a_broken_probe_leaves_the_arm_at_rest() -> None:
    arm, link, clock = connected()

    class Broken(Probe):
        def touched_at_s(self) -> float | None:
            if self.clock.time_s > clock_start + 0.5:
                raise DeviceTimeout("ADAM-6052 silent", "Check it")
            return super().touched_at_s()

    clock_start = clock.time_s
    with pytest.raises(DeviceTimeout, match="ADAM"):
        arm.move_until_contact(np.full(6, 5.0) * DEG, 2.0 * DEG, Broken(clock))
    assert all(drive.quick_stops == 1 for drive in link.drives.values())


def test_stop_during_a_move_ends_it_at_rest_until_released() -> None:
    arm, link, _ = connected()
    start = link.syncs

    def stop_in_mid_move(number: int) -> None:
        if number == start + 15:
            link.on_sync = lambda number: None
            arm.stop()

    link.on_sync = stop_in_mid_move
    with pytest.raises(MotionStopped):
        arm.move_joints(TARGET)
    assert all(drive.quick_stops == 1 for drive in link.drives.values())
    assert arm.is_at_rest()
    with pytest.raises(MotionStopped):
        arm.move_joints(TARGET)
    arm.release()
    arm.move_joints(TARGET)
    assert arm.read_joints(1).joints_rad[0] == pytest.approx(TARGET, abs=0.001 * DEG)


def test_stop_is_safe_before_connecting_and_twice() -> None:
    clock = VirtualClock()
    arm = CanopenArm(FakeArmLink(clock), CONFIG, clock, keep_alive_thread=False)
    arm.stop()
    arm.stop()
    arm.connect()  # does not enable
    with pytest.raises(MotionStopped):
        arm.move_joints(TARGET)
    arm.release()
    arm.move_joints(TARGET)


def test_one_drive_in_fault_stops_all_six_and_is_named() -> None:
    arm, link, _ = connected()
    start = link.syncs

    def fault(number: int) -> None:
        if number >= start + 15:
            link.drives[5].statusword = 0x0208

    link.on_sync = fault
    with pytest.raises(DeviceError, match=r"Joint 3 \(node 5\) in fault: following error \(8611h\)"):
        arm.move_joints(TARGET)
    assert all(drive.quick_stops == 1 for node, drive in link.drives.items() if node != 5)


def test_an_emergency_message_is_reported_in_words() -> None:
    arm, link, _ = connected()
    link.later(0.0, 0x083, bytes.fromhex("11 86 21 00 00 00 00 00"))
    with pytest.raises(DeviceError, match=r"Joint 1 \(node 3\) reports following error \(EMCY 8611h\)"):
        arm.read_joints(3)
    link.send(0x080, b"")  # the quick stop has left and acts at the next SYNC
    assert all(drive.quick_stops == 1 for drive in link.drives.values())


def test_boot_up_in_operation_is_a_restart_until_connected_again() -> None:
    arm, link, _ = connected()
    link.later(0.01, 0x705, b"\x00")
    with pytest.raises(DeviceError, match=r"Joint 3 \(node 5\) restarted"):
        arm.read_joints(5)
    with pytest.raises(DeviceError, match="restarted"):
        arm.move_joints(TARGET)
    arm.connect()
    arm.read_joints(1)
    assert arm.health().reconnects == 1


def test_a_lost_heartbeat_is_noticed_in_time() -> None:
    arm, link, clock = connected()
    arm.read_joints(10)
    link.drives[4].heartbeat = False
    lost_s = clock.time_s
    with pytest.raises(DeviceTimeout, match=r"Joint 2 \(node 4\) lost: no heartbeat for 0.25 s"):
        arm.read_joints(1000)
    assert clock.time_s - lost_s < 0.3


def test_a_drive_that_does_not_answer_sync_is_noticed_in_time() -> None:
    arm, link, clock = connected()
    link.drives[8].silent = True
    lost_s = clock.time_s
    with pytest.raises(DeviceTimeout, match=r"Joint 6 \(node 8\): no answer to 3 SYNCs in a row"):
        arm.read_joints(1000)
    assert clock.time_s - lost_s < 0.15


def test_an_answer_later_than_the_period_is_not_taken_for_the_next_sync() -> None:
    arm, link, _ = connected()
    arm.move_joints(TARGET)

    def late_once(number: int) -> None:
        link.answer_delay_s = 0.025 if number == start + 3 else 0.0005

    start = link.syncs
    link.on_sync = late_once
    for drive in link.drives.values():
        drive.velocity = 1000  # moves on during the readings, 20 counts per SYNC
        drive.target = 10**6
    readings = arm.read_joints(8)
    speeds = np.diff(readings.joints_rad[:, 0]) / np.diff(readings.time_s) / DEG
    assert speeds == pytest.approx(1.0, abs=0.11)
    assert arm.health().timeouts == 1


def test_joint_held_by_an_obstacle_is_not_at_target() -> None:
    arm, link, _ = connected()
    start = link.syncs

    def obstacle(number: int) -> None:
        if number > start + 10:
            link.drives[4].velocity = 0

    link.on_sync = obstacle
    with pytest.raises(DeviceError, match=r"Joint 2 is at .* deg instead of -20.000 deg, window 0.005 deg"):
        arm.move_joints(TARGET)


def test_left_over_faults_are_reset_at_connect_and_persistent_ones_named() -> None:
    clock = VirtualClock()
    link = FakeArmLink(clock)
    link.drives[6].statusword = 0x0208
    arm = CanopenArm(link, CONFIG, clock, keep_alive_thread=False)
    arm.connect()
    arm.read_joints(1)

    def stays(number: int) -> None:
        link.drives[6].statusword = 0x0208

    link.on_sync = stays
    with pytest.raises(DeviceError, match=r"Joint 4 \(node 6\) in fault"):
        arm.connect()


def test_a_mode_display_that_disagrees_is_refused() -> None:
    clock = VirtualClock()
    link = FakeArmLink(clock)
    link.drives[3].absent = frozenset({0x1006})
    real_sdo = link.drives[3].sdo

    def stuck_mode(request: bytes) -> bytes:
        answer = real_sdo(request)
        link.drives[3].objects[0x6061, 0] = b"\x07"
        return answer

    link.drives[3].sdo = stuck_mode  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match=r"Joint 1 \(node 3\) shows mode 7, profile position is 1"):
        CanopenArm(link, CONFIG, clock, keep_alive_thread=False).connect()


def test_a_missing_joint_and_a_foreign_device_are_named() -> None:
    clock = VirtualClock()
    link = FakeArmLink(clock)
    link.drives[7].silent = True
    with pytest.raises(DeviceTimeout, match=r"Joint 5 \(node 7\) does not answer within 5 s"):
        CanopenArm(link, CONFIG, clock, keep_alive_thread=False).connect()
    link = FakeArmLink(clock)
    link.drives[7].objects[0x1000, 0] = struct.pack("<I", 401)
    with pytest.raises(IdentityMismatch, match="device type 401, a drive is 402"):
        CanopenArm(link, CONFIG, clock, keep_alive_thread=False).connect()


def test_another_drive_than_calibrated_is_an_identity_mismatch() -> None:
    with pytest.raises(IdentityMismatch, match=r"Joint 2 \(node 4\) has serial number 1004, the cell file 9"):
        connected(serial_numbers=(1003, 9, 1005, 1006, 1007, 1008))


def test_close_leaves_the_drives_disabled_and_is_safe_twice() -> None:
    arm, link, _ = connected()
    arm.close()
    arm.close()
    assert all(drive.statusword & 0x6F == 0x40 for drive in link.drives.values())
    assert all(drive.nmt == 0x7F for drive in link.drives.values())
    with pytest.raises(DeviceError, match="not connected"):
        arm.read_joints(1)


def test_close_leaves_drives_that_may_be_enabled_waiting_for_a_heartbeat() -> None:
    """They stop without it, whatever becomes of the bus."""
    arm, link, _ = connected()
    link.drives[3].objects[0x1016, 1] = bytes.fromhex("c8000100")
    link.drives[8].silent = True
    arm.close()
    assert link.drives[3].objects[0x1016, 1] == bytes.fromhex("c8000100")


def test_close_waits_for_a_drive_that_is_slow_to_lose_its_power() -> None:
    arm, link, _ = connected()
    for drive in link.drives.values():
        drive.objects[0x1016, 1] = bytes.fromhex("c8000100")
    slow, disabled_at = link.drives[8], list[int]()

    def brake(number: int) -> None:
        """For ten more SYNCs the drive says that it is enabled."""
        if not disabled_at and slow.statusword & 0x6F == 0x40:
            disabled_at.append(number)
        if disabled_at:
            slow.statusword = 0x0227 if number < disabled_at[0] + 10 else 0x0240

    link.on_sync = brake
    arm.close()
    assert disabled_at and all(each.objects[0x1016, 1] == bytes(4) for each in link.drives.values())


def test_a_pause_in_which_nobody_pumps_is_no_lost_node() -> None:
    arm, _, clock = connected()
    clock.sleep(3.0)
    assert len(arm.read_joints(2).time_s) == 2


def test_answers_unread_while_the_computer_stood_still_are_no_missed_sync() -> None:
    arm, link, clock = connected()
    real, stalls = link.receive, [0.3, 0.3, 0.3, 0.3]

    def stalling(timeout_s: float) -> list[CanFrame]:
        if stalls and link._events and link._events[0][2] == 0x183:  # just before the first answer is read
            clock.sleep(stalls.pop())
        return real(timeout_s)

    link.receive = stalling  # type: ignore[method-assign]
    assert len(arm.read_joints(8).time_s) == 8
    assert not stalls and arm.health().timeouts == 0


def test_two_nodes_with_one_id_are_told() -> None:
    arm, link, _ = connected()

    def double(number: int) -> None:
        link.later(0.0006, 0x185, struct.pack("<Hi", 0x0237, 99))

    link.on_sync = double
    with pytest.raises(DeviceError, match=r"Joint 3 \(node 5\) answers twice .* two nodes use 185h"):
        arm.read_joints(100)


def test_a_node_that_a_second_master_stops_is_told() -> None:
    arm, link, _ = connected()
    link.later(0.0, 0x706, b"\x04")
    with pytest.raises(DeviceError, match=r"Joint 4 \(node 6\) is stopped instead of operational"):
        arm.read_joints(10)


def test_a_safety_stop_in_mid_move_is_told_as_such() -> None:
    arm, link, _ = connected()
    start = link.syncs

    def torque_off(number: int) -> None:
        if number == start + 15:
            for drive in link.drives.values():
                drive.statusword = 0x0250

    link.on_sync = torque_off
    with pytest.raises(DeviceError, match="is switch on disabled during a move") as error:
        arm.move_joints(TARGET)
    assert "safety system" in error.value.remedy


def test_a_following_error_stops_all_joints() -> None:
    arm, link, _ = connected()
    start = link.syncs

    def lagging(number: int) -> None:
        if number == start + 15:
            link.drives[7].statusword |= 0x2000

    link.on_sync = lagging
    with pytest.raises(DeviceError, match=r"Joint 5 \(node 7\) does not follow its set-point"):
        arm.move_joints(TARGET)
    assert all(drive.quick_stops == 1 for drive in link.drives.values())


@pytest.mark.parametrize("fraction", [0.0, -0.5, 1.5, math.nan])
def test_senseless_speeds_are_refused(fraction: float) -> None:
    arm, _, _ = connected()
    with pytest.raises(DeviceError, match="Speed fraction"):
        arm.move_joints(TARGET, fraction)


@pytest.mark.parametrize("target", [np.zeros(5), np.full(6, math.nan)])
def test_senseless_targets_are_refused(target: FloatArray) -> None:
    arm, _, _ = connected()
    with pytest.raises(DeviceError, match="Give 6 finite angles"):
        arm.move_joints(target)


def test_half_the_speed_takes_about_twice_the_time() -> None:
    arm, _, clock = connected()
    durations = list[float]()
    for fraction in (1.0, 0.5):
        arm.move_joints(np.zeros(6))
        began_s = clock.time_s
        arm.move_joints(np.full(6, 90.0) * DEG, fraction)
        durations.append(clock.time_s - began_s)
    assert durations[1] == pytest.approx(2 * durations[0], rel=0.1)
