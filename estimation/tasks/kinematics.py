"""Kinematic parameters of an arm from whatever a task measures, alone or together with the mount.

What only another choice of frames would change is held (`arm_gauge.py`); what else the data leave open is
refused, or comes from its prior.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from estimation.belief import Belief, Value
from estimation.errors import EstimationError
from estimation.gauge import Gauge
from estimation.kinematics import PARAMETER_NAMES, ArmModel
from estimation.model import values_of
from estimation.observability import Direction, rank_report, spectrum_of
from estimation.tasks import checks
from estimation.tasks.arm_gauge import arm_gauges
from estimation.tasks.chain import SensorChain
from estimation.tasks.findings import Cause, Finding
from estimation.tasks.motion import COMPLIANCE, KINEMATICS, Joints
from estimation.tasks.sensing import SensorTask
from estimation.tasks.solve import Result, solve

_SMALLEST_MOTION_RAD: Final = np.radians(20.0)


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
            lambda: list(self.measured.motion.check()),
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
        try:
            return checks.count(len(self.model()), int(self.rough().flat.sum()))
        except EstimationError as error:  # nothing fits the nominal arm
            return [Finding(Cause.NO_SOLUTION, error.problem, error.remedy)]

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
        return arm_gauges(self.measured, self._every, self._nominal)

    @property
    def _nominal(self) -> Mapping[str, Value]:
        """The start that fits best while the arm is nominal."""
        model, known = self.measured.model(), values_of(self.measured.rough())
        costs = [np.sum(model.rows({**known, **each}).residual_m ** 2) for each in self._nominal_starts]
        return self._nominal_starts[int(np.argmin(costs))]

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

    def explanations(self) -> Iterable[tuple[Finding, "KinematicTask"]]:
        """Mistakes with motion, units and labels."""
        return ((finding, replace(self, measured=other)) for finding, other in self.measured.explanations())

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
class Calibrated(Result):
    """What calibrating an arm found; block "kinematics" has deviations from the nominal arm.

    Attributes
    ----------
    gauges : freedoms that such measurements leave open, with the parameter that is held for each.
    prior_only : directions of which the data say next to nothing, so that only their prior holds them.
    arm : the nominal arm with the deviations that were found; None when refused.
    """

    gauges: tuple[Gauge, ...] = ()
    prior_only: tuple[Direction, ...] = ()
    arm: ArmModel | None = None

    @property
    def notes(self) -> tuple[str, ...]:
        held = (f"{gauge.words}: held at its nominal value." for gauge in self.gauges)
        return (*Result.notes.__get__(self), *held, *_only_from_priors(self.prior_only))


def _only_from_priors(directions: Sequence[Direction]) -> list[str]:
    """One sentence for all: single parameters by name, sums of many by their number."""
    single = [each.components[0][0].rpartition(".")[2] for each in directions if len(each.components) == 1]
    sums = len(directions) - len(single)
    named = [*single, *([f"{sums} combination{'s' * (sums > 1)} of others"] if sums else [])]
    return [f"Known from priors only: {', '.join(named)}."] if named else []


def calibrate(problem: KinematicTask, explain: bool = True) -> Calibrated:
    """Estimate; never raises for bad data, which come back refused with their cause."""
    result = solve(problem, explain)
    found: dict[str, Any] = {field.name: getattr(result, field.name) for field in fields(Result)}
    if result.estimate is None:
        return Calibrated(**found)
    arm, belief = problem.motion.arm, result.belief
    held: tuple[Direction, ...] = ()
    if KINEMATICS in belief:
        arm = arm.with_deviation(belief.vector(KINEMATICS))
        if not problem.belief().block(KINEMATICS).flat:
            held = _held_by_prior(problem, result)
    return Calibrated(**found, gauges=problem.gauges, prior_only=held, arm=arm)


def _held_by_prior(problem: KinematicTask, result: Result) -> tuple[Direction, ...]:
    rows, used = problem.model().rows(result.values), ~result.rejected
    dense, variance = rows.dense(result.belief)[used], rows.noise_variance[used]
    belief = problem.belief()
    spectrum = spectrum_of(belief, dense, variance, belief.columns([KINEMATICS]))
    return rank_report(belief, result.belief, spectrum).held_by_prior


def _std_of(motion: Joints) -> dict[tuple[int, str], float]:
    std = np.asarray(motion.kinematics_std, dtype=np.float64)
    return dict(zip(motion.arm.free, np.broadcast_to(std, (len(motion.arm.free),)).tolist(), strict=True))


def _flat(belief: Belief, name: str) -> bool:
    """Whether a block has no prior at all."""
    block = belief.block(name)
    return len(block.flat) == len(block.freedoms) > 0
