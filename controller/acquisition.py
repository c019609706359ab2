"""From a step of the plan to a sample: move, settle, read joints and sensor together."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np

from controller.cellfile import Cell
from controller.knowledge import first_belief
from controller.own_pose import require_same_pose
from controller.planning.paths import accesses
from controller.planning.steps import Joints, Step, route
from controller.planning.workspace import Workspace
from controller.samples import Sample
from drivers.capabilities import Contact, Devices, JointReadings, PoseReporter, Quality, RangeReadings
from drivers.clock import Clock
from estimation.errors import DeviceError
from estimation.kinematics import ArmModel
from estimation.transform import FloatArray

BACK_OFF_M = 2e-4  # how far the ball leaves the surface between the fast and the slow touch
SLOW_TOUCHES = 4  # at most, when the polls of the probe come too far apart
OTHER_START = 1.4  # times the way of the touch before
GOOD_POLLS = 8.0  # poll periods: a touch known so well needs no other
WORST_POLLS = 25.0  # and one that is not even known so well does not count
MINIMUM_CYCLES = 20  # laser cycles in one measurement


class Acquisition:
    """Takes samples with the devices of one cell."""

    def __init__(self, cell: Cell, arm: ArmModel, devices: Devices, clock: Clock) -> None:
        self._cell, self._arm, self._devices, self._clock = cell, arm, devices, clock
        self._last: Step | None = None  # where the arm stands; None in a carrying posture
        self._lost = True  # nobody knows where the arm stands

    def take(self, step: Step, after: Step | None) -> Sample:
        """One sample; a missing target gives a bad sample, a failing device raises DeviceError.

        `after` is the step before it in its plan. If that is not where the arm stands (a restart, a
        reference, a single step taken again), the way leads over the carrying postures.
        """
        if self._lost:
            self._find_way_out(step)
        follows = after is not None and after is self._last
        way = step.via if follows else route(self._last, step)
        self._lost = True  # until the step has ended
        self._pass(way)
        self._devices.robot.move_joints(np.asarray(step.joints_rad))
        sample = self._touch(step) if step.kind == "touch" else self._measure_range(step)
        self._pass(step.retreat)
        self._last, self._lost = step, False
        return sample

    def park(self) -> None:
        """Bring the arm to a carrying posture, from wherever the last step left it."""
        if self._last is not None and not self._lost:
            last, self._last = self._last, None
            self._pass(() if last.retreat[-1:] == last.access[:1] else tuple(reversed(last.access)))

    def _pass(self, way: Sequence[Joints]) -> None:
        for posture in way:
            self._devices.robot.move_joints(np.asarray(posture))

    def _find_way_out(self, near: Step) -> None:
        """To a carrying posture, from where a stop, a fault or a restart left the arm."""
        here = self._devices.robot.read_joints(1).joints_rad
        workspace = Workspace(self._cell, self._arm, first_belief(self._cell))
        for touching in ("", "part", "sphere"):
            (way,) = accesses(workspace.keepout, here, touching)
            if way is not None:
                self._pass([tuple(posture.tolist()) for posture in reversed(way)])
                break
        else:  # pressed against something, or in the air between two postures: back the way that led here
            self._pass((near.joints_rad, *reversed(near.access)))
        self._last, self._lost = None, False

    def _measure_range(self, step: Step) -> Sample:
        self._clock.sleep(self._cell.robot.settle_time_s)
        laser = self._devices.laser
        laser.begin_window()
        joints = self._devices.robot.read_joints(step.readings or self._cell.robot.readings)
        ranges = laser.end_window(MINIMUM_CYCLES)
        if step.kind == "noise":
            self._compare_pose(joints)
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

    def _compare_pose(self, joints: JointReadings) -> None:
        """At rest: a robot that tells its pose must be where its joints are."""
        robot = self._devices.robot
        if robot.abilities.reports_pose:
            require_same_pose(self._cell, self._arm, joints, cast(PoseReporter, robot).read_pose())

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
        touch = self._touch_slowly(start, target, fast.joints_rad, fast.late_s)
        robot.move_joints(start)
        if touch is None:
            return replace(self._sample(step, before), quality=Quality.BAD.value, why="second touch missed")
        if not probe.is_open():
            raise DeviceError(
                "The probe stays tripped after the retreat", "Look at stylus and wiring, then Unhold"
            )
        contact, travel_m = touch
        sample = self._sample(step, JointReadings(before.time_s, contact.joints_rad[None, :]))
        return replace(sample, joint_readings=contact.readings, reading_scatter_m=travel_m)

    def _touch_slowly(
        self, start: FloatArray, target: FloatArray, found: FloatArray, late_s: float
    ) -> tuple[Contact, float] | None:
        """Back off from a contact `found` at most `late_s` late, and touch again until known well enough.

        Returns the joints in the middle of the way on which the contact lies, and the length of that way (m).
        """
        robot, probe, spec = self._devices.robot, self._devices.probe, self._cell.probe
        path_m = self._path_m(start, target)
        late_m = spec.search_speed_m_s * late_s  # so far in when it was noticed
        share = (BACK_OFF_M + late_m) / path_m
        robot_s = robot.abilities.contact_delay_s
        best = Contact(found, 1.0, math.inf)
        for _ in range(SLOW_TOUCHES):
            robot.move_joints(found + (start - target) * min(1.0, share))
            while not probe.is_open():  # the ball was deeper than its link let us know
                if share >= 1.0:
                    raise DeviceError(
                        "The probe stays tripped after backing off", "Look at stylus and wiring, then Unhold"
                    )
                share *= 2.0
                robot.move_joints(found + (start - target) * min(1.0, share))
            probe.arm()
            contact = robot.move_until_contact(
                target, self._joint_speed(start, target, spec.touch_speed_m_s), probe
            )
            if contact is None:
                return None
            if contact.late_s < best.late_s:
                best = contact
            if best.late_s <= robot_s + GOOD_POLLS * spec.poll_period_s:
                break
            share *= OTHER_START  # from the same place the contact would fall into the same gap of the polls
        if best.late_s > (limit_s := robot_s + WORST_POLLS * spec.poll_period_s):
            raise DeviceError(
                f"{SLOW_TOUCHES} touches known to {best.late_s * 1e3:.0f} ms at best, "
                f"limit {limit_s * 1e3:.0f} ms",
                "Check the network and the load of the computer, then Unhold",
            )
        travel_m = spec.touch_speed_m_s * best.late_s
        middle = best.joints_rad + (start - target) * (travel_m / 2.0 / path_m)
        return replace(best, joints_rad=middle), travel_m

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
