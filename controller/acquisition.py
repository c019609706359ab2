"""From a step of the plan to a sample: move, settle, read joints and sensor together."""

from dataclasses import replace

import numpy as np

from controller.cellfile import Cell
from controller.planning.steps import Step
from controller.samples import Sample
from drivers.capabilities import Devices, JointReadings, Quality, RangeReadings
from drivers.clock import Clock
from estimation.errors import DeviceError
from estimation.kinematics import ArmModel
from estimation.transform import FloatArray

BACK_OFF_M = 7e-4  # how far the ball leaves the surface between the fast and the slow touch
MINIMUM_CYCLES = 20  # laser cycles in one measurement


class Acquisition:
    """Takes samples with the devices of one cell."""

    def __init__(self, cell: Cell, arm: ArmModel, devices: Devices, clock: Clock) -> None:
        self._cell, self._arm, self._devices, self._clock = cell, arm, devices, clock

    def take(self, step: Step) -> Sample:
        """One sample; a missing target gives a bad sample, a failing device raises DeviceError."""
        for via in step.via:
            self._devices.robot.move_joints(np.asarray(via))
        self._devices.robot.move_joints(np.asarray(step.joints_rad))
        if step.kind == "touch":
            return self._touch(step)
        return self._measure_range(step)

    def retreat(self, step: Step) -> None:
        """Back out the way that the step came, as far as it says."""
        for via in step.retreat:
            self._devices.robot.move_joints(np.asarray(via))

    def _measure_range(self, step: Step) -> Sample:
        self._clock.sleep(self._cell.robot.settle_time_s)
        laser = self._devices.laser
        laser.begin_window()
        joints = self._devices.robot.read_joints(step.readings or self._cell.robot.readings)
        ranges = laser.end_window(MINIMUM_CYCLES)
        sample = self._sample(step, joints)
        why = self._doubt(ranges)
        if why:
            return replace(sample, quality=Quality.BAD.value, why=why, readings=len(ranges.distance_m))
        return replace(
            sample,
            reading_m=float(np.mean(ranges.distance_m)),
            reading_scatter_m=float(np.std(ranges.distance_m, ddof=1)),
            readings=len(ranges.distance_m),
        )

    def _doubt(self, ranges: RangeReadings) -> str:
        """Why the window is no measurement, or "" if it is one."""
        valid = len(ranges.distance_m)
        if ranges.rejected > 0.05 * (valid + ranges.rejected):
            kinds = ", ".join(ranges.rejected_kinds) or "error values"
            return f"{ranges.rejected} of {valid + ranges.rejected} cycles without a distance ({kinds})"
        lowest, highest = self._cell.laser.working_range_m
        mean = float(np.mean(ranges.distance_m))
        if not lowest <= mean <= highest:
            return (
                f"target at {mean * 1e3:.2f} mm, working range {lowest * 1e3:.0f} to {highest * 1e3:.0f} mm"
            )
        return ""

    def _touch(self, step: Step) -> Sample:
        """Fast until contact, back off, slowly until contact again: the slow one counts."""
        robot, probe = self._devices.robot, self._devices.probe
        start, target = np.asarray(step.joints_rad), np.asarray(step.contact_rad)
        self._clock.sleep(self._cell.robot.settle_time_s)
        before = robot.read_joints(1)
        probe.arm()
        fast = robot.move_until_contact(
            target, self._joint_speed(start, target, self._cell.probe.search_speed_m_s), probe
        )
        if fast is None:
            robot.move_joints(start)
            return replace(self._sample(step, before), quality=Quality.BAD.value, why="nothing touched")
        path_m = self._path_m(start, target)
        back = fast + (start - target) * min(1.0, BACK_OFF_M / path_m)
        robot.move_joints(back)
        if not probe.is_open():
            raise DeviceError(
                "The probe stays tripped after backing off", "Look at stylus and wiring, then Unhold"
            )
        probe.arm()
        contact = robot.move_until_contact(
            target, self._joint_speed(start, target, self._cell.probe.touch_speed_m_s), probe
        )
        robot.move_joints(start)
        if contact is None:
            return replace(self._sample(step, before), quality=Quality.BAD.value, why="second touch missed")
        if not probe.is_open():
            raise DeviceError(
                "The probe stays tripped after the retreat", "Look at stylus and wiring, then Unhold"
            )
        return self._sample(step, JointReadings(before.time_s, contact[None, :]))

    def _path_m(self, start: FloatArray, target: FloatArray) -> float:
        offset = self._cell.probe.mount.transform().origin_m
        ends = self._arm.flange_pose(np.stack([start, target]))
        points = ends[:, :3, :3] @ offset + ends[:, :3, 3]
        return float(np.linalg.norm(points[1] - points[0]))

    def _joint_speed(self, start: FloatArray, target: FloatArray, speed_m_s: float) -> float:
        """Speed of the fastest joint at which the ball moves at `speed_m_s`."""
        return float(speed_m_s * np.max(np.abs(target - start)) / self._path_m(start, target))

    def _sample(self, step: Step, joints: JointReadings) -> Sample:
        count = len(joints.joints_rad)
        scatter = (
            np.std(joints.joints_rad, axis=0, ddof=1) if count > 1 else np.zeros(joints.joints_rad.shape[1])
        )
        return Sample(
            step=step.id,
            kind=step.kind,
            object=step.object,
            feature=step.feature,
            joints_rad=tuple(np.mean(joints.joints_rad, axis=0).tolist()),
            joint_scatter_rad=tuple(scatter.tolist()),
            joint_readings=count,
            reading_m=0.0,
            reading_scatter_m=0.0,
            readings=0,
            quality=Quality.GOOD.value,
            why="",
            source_time_s=float(np.mean(joints.time_s)),
            utc_s=self._clock.utc_s(),
        )
