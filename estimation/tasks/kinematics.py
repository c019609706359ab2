"""Kinematic parameters of an arm from whatever a task measures, alone or together with the mount.

What no such measurement can tell apart is found from the rank of the Jacobian, at the joints of the data and
all over their limits. For each such freedom one parameter keeps its nominal value, the first that takes part
in it of: theta and d of joint 1 (they place the base frame), all of the last link (they place the flange
frame), d of joints whose axis is parallel to the next, from the base outwards, the longest link (the scale,
where nothing of known length is seen), compliance, and the others. A parameter with a prior is never held.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.belief import Belief, Value
from estimation.errors import EstimationError
from estimation.gauge import Gauge, gauges
from estimation.kinematics import PARAMETER_NAMES, ArmModel
from estimation.model import values_of, vector_of
from estimation.observability import Direction, rank_report
from estimation.tasks import checks
from estimation.tasks.chain import SensorChain
from estimation.tasks.elsewhere import elsewhere
from estimation.tasks.findings import Cause, Finding
from estimation.tasks.motion import COMPLIANCE, KINEMATICS, Joints
from estimation.tasks.sensing import SensorTask
from estimation.tasks.solve import Result, solve

_ELSEWHERE: Final = 300  # measurements to find gauge freedoms with, and
_FOR_EACH: Final = 4  # times as many as there are unknowns at least
_SMALLEST_MOTION_RAD: Final = np.radians(20.0)
_SAME_SCALE: Final = 1e-3  # of all lengths, by which they may grow differently and still be one scale


@dataclass(frozen=True, eq=False, kw_only=True)
class KinematicTask:
    """Kinematic parameters from the readings of another task, whose arm is not its nominal self.

    Attributes
    ----------
    measured : a task with `Joints`. Parameters that are free there have the prior that stands there. Its
        load, where it has one, makes the joints yield (compliance, flat unless it has a prior).
    identify : (joint index from 0, name) of parameters without a prior that are wanted, too; None for all
        of `ArmModel.every_parameter`. Others are as they are in the arm.
    """

    measured: SensorTask
    identify: tuple[tuple[int, str], ...] | None = None

    @property
    def task(self) -> str:
        """Name in the registry."""
        return f"kinematics-{self.measured.task}"

    @property
    def consider(self) -> tuple[str, ...]:
        return self.measured.consider

    def check(self) -> Sequence[Finding]:
        """Everything wrong at sight; an empty list for sound data."""
        return checks.first_of(
            self._check_motion,
            lambda: list(self.measured.check()),
            self._check_count,
        )

    def _check_motion(self) -> list[Finding]:
        try:
            motion = self._every
            if motion.load is not None:
                motion.load.torque_nm(motion.arm, np.zeros((1, motion.arm.joint_count)))
        except EstimationError as error:
            return [Finding(Cause.WRONG_SHAPE, error.problem, error.remedy)]
        if motion.arm.free or len(motion.soft_joints):
            return []
        return [
            Finding(Cause.TOO_FEW, "No parameter is to be calibrated", "Name some, or leave out the list")
        ]

    def _check_count(self) -> list[Finding]:
        model = self.reduced.model()
        return checks.count(len(model), int(self.reduced.rough().flat.sum()))

    @property
    def _every(self) -> Joints:
        """The motion with all parameters free that are not declared known."""
        motion = self.measured.motion
        if not isinstance(motion, Joints):
            raise EstimationError(
                "Poses of the flange say nothing of single joints", "Give joint angles, with the nominal arm"
            )
        arm = motion.arm
        std = {} if motion.kinematics_std is None else _std_of(motion)
        wanted = arm.every_parameter if self.identify is None else self.identify
        order = [(joint, name) for joint in range(arm.joint_count) for name in PARAMETER_NAMES]
        chosen = {*wanted, *std}
        free = [each for each in order if each in chosen]
        free += sorted(chosen - set(order))  # for the arm to refuse
        soft = None
        if motion.load is not None:
            soft = np.inf if motion.compliance_std is None else motion.compliance_std
        return replace(
            motion,
            arm=replace(arm, free=tuple(free)),
            kinematics_std=np.array([std.get(each, np.inf) for each in free]),
            compliance_std=soft,
        )

    @cached_property
    def gauges(self) -> tuple[Gauge, ...]:
        """What no such measurement can tell, and what is held for it."""
        motion = self._every
        task = replace(self.measured, motion=motion)
        belief = task.rough().started(self._best_start())
        values, count = values_of(belief), max(_ELSEWHERE, _FOR_EACH * int(belief.flat.sum()))
        rows = elsewhere(task, motion, values, count).model().rows(values)
        found = gauges(belief, rows.dense(belief), rows.noise_variance, _order(motion))
        return tuple(_as_scale(gauge, motion.arm) for gauge in found)

    def _best_start(self) -> Mapping[str, Value]:
        """The start of the nominal arm with the smallest residuals."""
        model = self.measured.model()
        known = values_of(self.measured.rough())
        costs = []
        for start in self._nominal_starts:
            rows = model.rows({**known, **start})
            costs.append(float(np.sum(rows.residual_m**2)))
        return {} if not costs else self._nominal_starts[int(np.argmin(costs))]

    @cached_property
    def _nominal_starts(self) -> Sequence[Mapping[str, Value]]:
        return self.measured.starts()

    @cached_property
    def motion(self) -> Joints:
        """The motion with the parameters free that such measurements can tell apart."""
        every = self._every
        held = {gauge.held for gauge in self.gauges}
        labels = every.arm.parameter_labels
        kept = [place for place, label in enumerate(labels) if f"{KINEMATICS}.{label}" not in held]
        soft = None
        if every.compliance_std is not None:
            soft = np.array(np.broadcast_to(every.compliance_std, every.arm.joint_count), dtype=np.float64)
            rigid = [joint for joint in every.soft_joints if f"{COMPLIANCE}.joint{joint + 1}" in held]
            soft[rigid] = 0.0
        return replace(
            every,
            arm=replace(every.arm, free=tuple(every.arm.free[place] for place in kept)),
            kinematics_std=np.asarray(every.kinematics_std)[kept],
            compliance_std=soft,
        )

    @cached_property
    def reduced(self) -> SensorTask:
        """The measured task with that motion."""
        return replace(self.measured, motion=self.motion)

    def belief(self) -> Belief:
        return self.reduced.belief()

    def rough(self) -> Belief:
        return self.reduced.rough()

    def model(self) -> SensorChain:
        return self.reduced.model()

    def starts(self) -> Sequence[Mapping[str, Value]]:
        """Those of the nominal arm."""
        belief = self.rough()
        own = {
            name: np.zeros(len(belief.block(name).freedoms))
            for name in (KINEMATICS, COMPLIANCE)
            if name in belief and _flat(belief, name)
        }
        return [{**start, **own} for start in self._nominal_starts]

    def settled(self, values: Mapping[str, Value]) -> Mapping[str, Value]:
        return self.reduced.settled(values)

    def explanations(self) -> Sequence[tuple[Finding, "KinematicTask"]]:
        """Mistakes with motion, units and labels."""
        return [(finding, replace(self, measured=other)) for finding, other in self.measured.explanations()]

    def diagnose(self, values: Mapping[str, Value], rejected: NDArray[np.bool_] | None) -> Sequence[Finding]:
        found = list(self.reduced.diagnose(values, rejected))
        return found if rejected is not None else found + self._still_joints()

    def _still_joints(self) -> list[Finding]:
        moved = np.ptp(self.motion.joints_rad, axis=0)
        return [
            Finding(
                Cause.STILL_JOINT,
                f"Joint {joint + 1} moves by {np.degrees(moved[joint]):.3g} deg, limit "
                f"{np.degrees(_SMALLEST_MOTION_RAD):g} deg: the links before and after it look like one",
                "Move it through 60 deg or more, or identify fewer parameters",
            )
            for joint in np.flatnonzero(moved < _SMALLEST_MOTION_RAD)
        ]


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """What calibrating an arm found.

    Attributes
    ----------
    result : estimate, covariance and findings; block "kinematics" has deviations from the nominal arm.
    gauges : freedoms that such measurements leave open, with the parameter that is held for each.
    prior_only : directions of which the data say next to nothing, so that only their prior holds them.
    arm : the nominal arm with the deviations that were found; None when refused.
    """

    result: Result
    gauges: tuple[Gauge, ...] = ()
    prior_only: tuple[Direction, ...] = ()
    arm: ArmModel | None = None


def calibrate(problem: KinematicTask, explain: bool = True) -> Calibrated:
    """Estimate; never raises for bad data, which come back refused with their cause."""
    result = solve(problem, explain)
    if result.estimate is None:
        return Calibrated(result)
    arm = problem.motion.arm
    belief = result.belief
    if KINEMATICS not in belief:
        return Calibrated(result, problem.gauges, (), arm)
    rows = problem.model().rows(result.values)
    used = ~result.rejected
    initial = problem.belief()
    held: tuple[Direction, ...] = ()
    if not initial.block(KINEMATICS).flat:
        report = rank_report(
            initial, belief, rows.dense(belief)[used], rows.noise_variance[used], (KINEMATICS,)
        )
        held = report.held_by_prior
    return Calibrated(result, problem.gauges, held, arm.with_deviation(vector_of(result.values, KINEMATICS)))


def _std_of(motion: Joints) -> dict[tuple[int, str], float]:
    std = np.asarray(motion.kinematics_std, dtype=np.float64)
    return dict(zip(motion.arm.free, np.broadcast_to(std, (len(motion.arm.free),)).tolist(), strict=True))


def _flat(belief: Belief, name: str) -> bool:
    """Whether a block has no prior at all."""
    block = belief.block(name)
    return len(block.flat) == len(block.freedoms) > 0


def _order(motion: Joints) -> list[str]:
    """Labels of what may be held, the first choice first."""
    arm, last = motion.arm, motion.arm.joint_count
    ends = ["theta1", "d1", *(f"{name}{last}" for name in PARAMETER_NAMES)]
    parallel = [f"d{joint + 1}" for joint in np.flatnonzero(arm.parallel_to_next)]
    lengths = {
        f"{name}{joint + 1}": abs(getattr(arm, name)[joint]) for joint, name in arm.free if name in "da"
    }
    longest = sorted(lengths, key=lambda label: -float(lengths[label]))[:1]
    others = [f"{name}{joint + 1}" for name in reversed(PARAMETER_NAMES) for joint in range(last)]
    soft = [f"{COMPLIANCE}.joint{joint + 1}" for joint in motion.soft_joints]
    return [
        *(f"{KINEMATICS}.{label}" for label in (*ends, *parallel, *longest)),
        *soft,
        *(f"{KINEMATICS}.{label}" for label in others),
    ]


def _as_scale(gauge: Gauge, arm: ArmModel) -> Gauge:
    """The gauge with words of its own where all lengths of the arm grow together."""
    nominal = {
        f"{KINEMATICS}.{name}{joint + 1}": float(getattr(arm, name)[joint])
        for joint in range(arm.joint_count)
        for name in ("a", "d")
    }
    amounts = dict(gauge.partners)
    own = nominal.get(gauge.held, 0.0)
    if not own or not any(nominal.get(label) for label in amounts):
        return gauge
    grown = [
        abs(amounts.get(label, 0.0) - length / own) for label, length in nominal.items() if label in amounts
    ]
    if max(grown) > _SAME_SCALE:
        return gauge
    return replace(
        gauge,
        words=f"{gauge.held.rpartition('.')[2]} says how large the arm is: nothing of known length is seen",
    )
