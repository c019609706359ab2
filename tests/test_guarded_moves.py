"""Guarded moves with every robot and every probe: a contact is as late as it is said to be."""

from itertools import product
from pathlib import Path

import numpy as np
import pytest

from controller.cellfile import load_cell
from controller.demo_cell import copy_bench_block
from controller.devices import make_devices
from estimation.errors import DeviceError
from simulators.probes.kinds import PROBES
from simulators.robots.kinds import ROBOTS
from simulators.virtual import SimulatedCell
from tests.support.postures import looking_down

ROBOT_NAMES = [kind.name for kind in ROBOTS]
PROBE_NAMES = [kind.name for kind in PROBES]
OWN = ("canopen-402", "adam-6052")
ABOVE_M, BELOW_M = 0.003, 0.002
SLOWEST_IGUS_RAD_S = np.radians(0.09)  # a thousandth of its speed
LEVER_M = 0.4  # of the flange about most axes
PRETRAVEL_M = 2e-5  # of a force or a stroke that must reach its threshold


def pairs() -> list[object]:
    """In CI each robot with the bench's probe, and each probe with the bench's robot."""
    return [
        pytest.param(
            robot,
            probe,
            id=f"{robot}+{probe}",
            marks=[] if robot == OWN[0] or probe == OWN[1] else pytest.mark.campaign,
        )
        for robot, probe in product(ROBOT_NAMES, PROBE_NAMES)
    ]


@pytest.mark.parametrize(("robot_name", "probe_name"), pairs())
def test_the_joints_of_a_contact_are_as_late_as_declared(
    robot_name: str, probe_name: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    others = [name for name in (robot_name, probe_name) if name not in OWN]
    cell = load_cell(copy_bench_block(tmp_path, others))
    cache = tmp_path_factory.getbasetemp() / "faces"
    world = SimulatedCell(
        tmp_path,
        seed=5,
        cache_dir=cache,
        robot=robot_name,
        probe=probe_name,
        error_factor=0.0,
        noise_factor=0.0,
    )
    devices = make_devices(cell, world.ports, world.clock, keep_alive_thread=False)
    robot, probe = devices.robot, devices.probe
    robot.connect()
    probe.connect()

    plate, tool = world.truth.base_T_plate, world.truth.flange_T_probe
    model, near = cell.robot.arm_model(), np.array(cell.robot.start_joints_rad)
    radius_m = cell.probe.ball_radius_m
    above = looking_down(model, tool, plate[:3, 3] + (radius_m + ABOVE_M) * plate[:3, 2], near)
    below = looking_down(model, tool, plate[:3, 3] + (radius_m - BELOW_M) * plate[:3, 2], above)
    robot.move_joints(above)
    probe.arm()
    speed_m_s = cell.probe.touch_speed_m_s
    speed_rad_s = float(np.abs(below - above).max()) * speed_m_s / (ABOVE_M + BELOW_M)
    if robot_name == "igus-irc" and speed_rad_s < SLOWEST_IGUS_RAD_S:
        with pytest.raises(DeviceError, match=r"the slowest of this robot is 0\.0900"):
            robot.move_until_contact(below, speed_rad_s, probe)
        return  # what the slow probes ask for, this controller cannot do
    contact = robot.move_until_contact(below, speed_rad_s, probe)
    assert contact is not None and robot.is_at_rest() and not probe.is_open()
    (touch,) = world.contact.touches
    assert touch.surface == "plate"
    true_rad = world.arm.joints_at(touch.time_s)
    late_m = contact.late_s * speed_m_s
    off_m = float(
        np.linalg.norm(
            world.world.flange_pose(contact.joints_rad)[:3, 3] - world.world.flange_pose(true_rad)[:3, 3]
        )
    )
    print(f"{robot_name}, {probe_name}: {off_m * 1e6:.0f} um off, {late_m * 1e6:.0f} um declared")
    rounding_m = robot.abilities.joint_resolution_rad / 2.0 * LEVER_M
    assert off_m <= late_m + rounding_m + PRETRAVEL_M
    robot.move_joints(above)
    assert probe.is_open()
