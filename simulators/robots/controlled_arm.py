"""The mechanical arm under a controller that plans its moves: joint moves, straight lines, stops."""

import math
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from estimation.transform import FloatArray
from simulators.robots.mechanism import MechanicalArm, reading_noise
from simulators.robots.motion_profile import AxisMotion, Phase, State, plan_move
from simulators.world.kinematics import TrueArm
from simulators.world.world_file import LINK_PARAMETERS, ArmSpec

LINE_STEP_S: Final = 0.01  # between two points of a straight line; joints run evenly in between
NEWTON_STEPS: Final = 20
REACHED: Final = 1e-9  # m and rad


class ControlledArm(MechanicalArm):
    """All joints of a move start and arrive together, on a straight line in joint space.

    The controller knows the nominal geometry of the arm, not the errors that this arm has.
    `noise_factors` (n,) multiply the noise of each joint's readings; `motion_speed` shortens fast moves.
    """

    def __init__(
        self,
        spec: ArmSpec,
        rng: np.random.Generator,
        noise_factors: FloatArray | None = None,
        motion_speed: float = 1.0,
    ) -> None:
        motions = [AxisMotion(float(q)) for q in spec.start_joints_rad]
        super().__init__(motions, unit_rad=1.0)
        factors = np.ones(len(motions)) if noise_factors is None else np.asarray(noise_factors)
        self._noise = [reading_noise(rng, float(factor) * spec.noise_rad) for factor in factors]
        self._spec, self._motion_speed = spec, motion_speed
        self._factor = 1.0  # by which the present move is sped up
        self.lower_rad = np.array([link.lower_rad for link in spec.links])
        self.upper_rad = np.array([link.upper_rad for link in spec.links])
        self._geometry = TrueArm(
            np.array([[link.values[name] for name, _ in LINK_PARAMETERS] for link in spec.links])
        )

    @property
    def speed_limit_rad_s(self) -> float:
        """Of every joint."""
        return self._spec.speed_limit_rad_s

    # -- what the controller knows ---------------------------------------------------------------

    def measured(self, time_s: float) -> FloatArray:
        """Joint angles (n,) as the encoders give them, before the protocol rounds them, rad."""
        noise: FloatArray = np.array([draw() for draw in self._noise])
        return self.joints_at(time_s) + noise

    def pose_of(self, joints_rad: FloatArray) -> FloatArray:
        """base_T_flange (4, 4) by the nominal geometry."""
        return self._geometry.flange_pose(joints_rad).copy()

    def moving(self, time_s: float) -> bool:
        """Whether a move is under way."""
        return any(motion.moving(time_s) for motion in self._motions)

    def end_s(self) -> float:
        """When the present move ends."""
        return max(motion.end_s for motion in self._motions)

    def within_limits(self, joints_rad: FloatArray) -> bool:
        """Whether the joints may be there."""
        return bool(((joints_rad >= self.lower_rad) & (joints_rad <= self.upper_rad)).all())

    # -- motion ----------------------------------------------------------------------------------

    def move(
        self, start_s: float, target_rad: FloatArray, speed_rad_s: float, acceleration_rad_s2: float = 0.0
    ) -> None:
        """Move so that the fastest joint has this speed; a move under way is stopped first."""
        start_s = self.halt(start_s)
        here = self.joints_at(start_s)
        way = np.asarray(target_rad, dtype=np.float64) - here
        longest = float(np.max(np.abs(way)))
        if longest == 0.0:
            return
        speed = min(speed_rad_s, self.speed_limit_rad_s)
        self._factor = self._motion_speed if speed >= self._spec.fast_move_rad_s else 1.0
        acceleration = (acceleration_rad_s2 or self._spec.acceleration_rad_s2) * self._factor**2
        course = plan_move(start_s, 0.0, 0.0, longest, speed * self._factor, acceleration)
        for motion, begin, share in zip(self._motions, here, (way / longest).tolist(), strict=True):
            motion.follow([_part(phase, float(begin), share) for phase in course])

    def move_linear(self, start_s: float, pose: FloatArray, speed_m_s: float) -> bool:
        """Move the flange on a straight line to `pose` (4, 4), nominal; False if it cannot get there."""
        start_s = self.halt(start_s)
        joints = self.joints_at(start_s)
        first = self.pose_of(joints)
        way_m = float(np.linalg.norm(pose[:3, 3] - first[:3, 3]))
        turn = Rotation.from_matrix(first[:3, :3].T @ pose[:3, :3]).as_rotvec()
        longest = max(way_m, float(np.linalg.norm(turn)) * 0.1)  # a turn on the spot takes time as well
        if longest == 0.0:
            return True
        course = AxisMotion(0.0)
        course.follow(plan_move(start_s, 0.0, 0.0, longest, speed_m_s, 2.0))
        count = max(2, math.ceil((course.end_s - start_s) / LINE_STEP_S) + 1)
        instants = np.linspace(start_s, course.end_s, count).tolist()
        path = [joints]
        for time_s in instants[1:]:
            part = course.position(time_s) / longest
            wanted = np.eye(4)
            wanted[:3, 3] = first[:3, 3] + part * (pose[:3, 3] - first[:3, 3])
            wanted[:3, :3] = first[:3, :3] @ Rotation.from_rotvec(turn * part).as_matrix()
            solved = self._solve(path[-1], wanted)
            if solved is None or not self.within_limits(solved):
                return False
            path.append(solved)
        self._factor = 1.0
        for axis, motion in enumerate(self._motions):
            angles = [float(point[axis]) for point in path]
            phases = [
                Phase(t, a, (b - a) / (after - t), 0.0)
                for t, after, a, b in zip(instants, instants[1:], angles, angles[1:], strict=False)
            ]
            motion.follow([*phases, Phase(instants[-1], angles[-1], 0.0, 0.0)])
        return True

    def halt(self, time_s: float) -> float:
        """Come to rest on the path as soon as the drives can; returns when."""
        states = [State(motion.position(time_s), motion.velocity(time_s)) for motion in self._motions]
        if not self.moving(time_s):
            return time_s
        fastest = max(abs(state.velocity) for state in states)
        duration = fastest / (self._spec.quick_stop_rad_s2 * self._factor**2)
        for motion, (position, velocity) in zip(
            self._motions, [(state.position, state.velocity) for state in states], strict=True
        ):
            end = Phase(time_s + duration, position + velocity * duration / 2, 0.0, 0.0)
            slope = -velocity / duration if duration > 0 else 0.0
            motion.follow([Phase(time_s, position, velocity, slope), end] if duration > 0 else [end])
        return time_s + duration

    def _solve(self, joints: FloatArray, wanted: FloatArray) -> FloatArray | None:
        """Joints near these whose nominal pose is `wanted` (4, 4), by Newton's method."""
        q = joints.copy()
        for _ in range(NEWTON_STEPS):
            error = _difference(self.pose_of(q), wanted)
            if float(np.max(np.abs(error))) < REACHED:
                return q
            steps = np.eye(len(q)) * 1e-6
            columns = [_difference(self.pose_of(q), self.pose_of(q + step)) / 1e-6 for step in steps]
            change, *_ = np.linalg.lstsq(np.column_stack(columns), error, rcond=1e-9)
            q = q + np.clip(change, -0.2, 0.2)
        return None


def _part(phase: Phase, begin: float, share: float) -> Phase:
    return Phase(
        phase.start_s, begin + share * phase.position, share * phase.velocity, share * phase.acceleration
    )


def _difference(now: FloatArray, wanted: FloatArray) -> FloatArray:
    """What leads from one pose to the other (6,): translation in base, rotation vector."""
    return np.concatenate(
        [wanted[:3, 3] - now[:3, 3], Rotation.from_matrix(wanted[:3, :3] @ now[:3, :3].T).as_rotvec()]
    )
