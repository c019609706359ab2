"""Monte Carlo of a cell's own plan: the estimator again and again, on measurements as declared.

Each replica draws every shared error once and the independent noise of every measurement. It shows whether
the linear covariance holds for this geometry and these uncertainties; what the cell file does not declare,
it does not show.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from controller.cellfile import Cell, HandEyePhase, LocalizePhase, load_cell
from controller.knowledge import first_belief, observations, with_part, with_plate
from controller.planning import Step, plan_hand_eye, plan_localize
from controller.planning.estimated import corner_points, hand_eye_points
from controller.planning.workspace import PLANNED_CYCLES
from controller.samples import Sample
from controller.verify.executor import Executor
from estimation.belief import Belief
from estimation.chart import Chart
from estimation.errors import CellError, EstimationError
from estimation.kinematics import ArmModel
from estimation.measurement import Chain, Observations, Points
from estimation.model import Model, values_of
from estimation.proof.coverage import Coverage, normalised_error_squared
from estimation.proof.montecarlo import MonteCarlo, Validation, adaptive, numerical_tolerance, validate_linear
from estimation.solver import update
from estimation.statistics import coverage_factor
from estimation.transform import FloatArray

BLOCK: Final = 200  # replicas; each runs the whole estimator, hence fewer than the guide's 10,000
DIGITS: Final = 1  # significant digits of u that the run shall settle to
_ITEM: Final = 20  # replicas of one work item
_MOST_REPLICAS: Final = 20_000
_READING_STEPS: Final = 3  # secant steps for the reading at which the beam meets the surface


@dataclass(frozen=True, slots=True)
class Quantity:
    """The gated point of a phase that is known worst, along the axis in which it is."""

    phase: str
    point: str
    u_m: float  # predicted, along that axis
    U_m: float  # predicted expanded uncertainty, 3-D, 95 %


@dataclass(frozen=True, slots=True, eq=False)
class Proof:
    """What the replicas say of one quantity."""

    quantity: Quantity
    coverage: Coverage  # of the 3-D region of the point
    monte_carlo: MonteCarlo
    index: int  # of the quantity in the run
    validation: Validation

    @property
    def ratio(self) -> float:
        """Achieved over predicted standard uncertainty: 1 when honest."""
        return self.monte_carlo.summaries[self.index].u / self.quantity.u_m


def prove(
    cell_path: Path,
    executor: Executor,
    seed: int = 1,
    most_replicas: int = _MOST_REPLICAS,
    progress: Callable[[int, float], None] | None = None,
) -> tuple[Proof, ...]:
    """Run replicas of hand-eye and localization until their figures are stable (JCGM 101, clause 7.9.4).

    `progress` is told the replicas so far, and how many tolerances the least settled figure still moves by.
    Raises CellFileError, and CellError for a job with neither phase.
    """
    quantities = _plan(cell_path).quantities
    nees: list[FloatArray] = []
    refused = 0

    def run_block(number: int, trials: int) -> FloatArray:
        nonlocal refused
        first = number * trials
        items = [
            _Item(cell_path, seed, start, min(_ITEM, first + trials - start))
            for start in range(first, first + trials, _ITEM)
        ]
        results = np.concatenate(list(executor.map(_run, items)))  # (trials, q, 2)
        bad = ~np.isfinite(results).all(axis=(1, 2))
        refused += int(bad.sum())
        if bad.all():
            raise CellError(
                "The estimator refused every replica", "Run truecell check and truecell plan first"
            )
        # A refused replica states no number; a repeat of others keeps the blocks of one size.
        results[bad] = np.resize(results[~bad], results[bad].shape)
        nees.append(results[~bad, :, 1])
        return np.asarray(results[:, :, 0])

    run = adaptive(run_block, BLOCK, DIGITS, most_trials=max(most_replicas, 2 * BLOCK), progress=progress)
    every = np.concatenate(nees)
    return tuple(
        Proof(
            quantity,
            Coverage(3, every[:, i], refused),
            run,
            i,
            validate_linear(
                0.0,
                coverage_factor(1) * quantity.u_m,
                run.summaries[i],
                numerical_tolerance(quantity.u_m, DIGITS),
            ),
        )
        for i, quantity in enumerate(quantities)
    )


@dataclass(frozen=True, slots=True)
class _Item:
    """Consecutive replicas; each has a stream of its own, so that no worker's share changes a result."""

    cell: Path
    seed: int
    first: int
    count: int


@dataclass(frozen=True, slots=True, eq=False)
class JudgedPhase:
    """Planned measurements of one phase, and the gated point that is judged."""

    batch: Observations
    extend: Callable[[Belief], Belief]  # adds the blocks of the object to what is known before
    points: Callable[[Belief], Points]
    index: int  # of the judged point
    axis: FloatArray  # (3,), along which it is known worst


@dataclass(frozen=True, slots=True, eq=False)
class JudgedJob:
    """Phases in order, each building on the estimate of the one before."""

    arm: ArmModel
    start: Belief
    phases: tuple[JudgedPhase, ...]
    quantities: tuple[Quantity, ...]


def _run(item: _Item) -> FloatArray:
    """(count, q, 2): error along the worst axis (m) and NEES of each quantity; NaN where refused."""
    return replicas(_plan(item.cell), item.seed, item.first, item.count)


def replicas(job: JudgedJob, seed: int, first: int, count: int) -> FloatArray:
    """(count, q, 2): error along the worst axis (m) and NEES of each judged point; NaN where refused."""
    found = np.full((count, len(job.phases), 2), np.nan)
    for i in range(count):  # each replica is a whole non-linear estimate
        random = np.random.default_rng([seed, first + i])
        try:
            found[i] = _replica(job, random)
        except EstimationError:
            continue
    return found


def _replica(plan: JudgedJob, random: np.random.Generator) -> list[tuple[float, float]]:
    everything = plan.start
    for phase in plan.phases:
        everything = phase.extend(everything)
    chart = Chart(everything, Chain(plan.arm, ()))
    truth = everything.replaced(
        chart.at(random.standard_normal(everything.size))[0], everything.contributions
    )
    belief, results = plan.start, []
    for phase in plan.phases:
        measured = _measured(Chain(plan.arm, [phase.batch]), truth, random)
        belief = update(phase.extend(belief), measured).belief
        known, true = phase.points(belief), phase.points(truth)
        error = known.points_m[phase.index] - true.points_m[phase.index]
        results.append(
            (
                float(phase.axis @ error),
                normalised_error_squared(error, known.covariance(belief)[phase.index]),
            )
        )
    return results


def _measured(chain: Chain, truth: Belief, random: np.random.Generator) -> Model:
    """The planned measurements, as this truth and fresh noise make them."""
    (batch,) = chain.observations
    values = values_of(truth)
    reading, step = batch.reading_m, 1e-4
    for _ in range(_READING_STEPS):
        at = [
            _read(chain, batch.joints_rad, each).rows(values).residual_m for each in (reading, reading + step)
        ]
        reading = reading - at[0] * step / (at[1] - at[0])
    shape = batch.joints_rad.shape
    return _read(
        chain,
        batch.joints_rad + np.sqrt(batch.joint_variance) * random.standard_normal(shape),
        reading + np.sqrt(batch.reading_variance) * random.standard_normal(len(batch)),
    )


def _read(chain: Chain, joints_rad: FloatArray, reading_m: FloatArray) -> Chain:
    """The same measurements with other joints and readings."""
    return Chain(chain.arm, [replace(chain.observations[0], joints_rad=joints_rad, reading_m=reading_m)])


@lru_cache(maxsize=1)
def _plan(cell_path: Path) -> JudgedJob:
    """Plan hand-eye and localization as the job would, everything being where the cell file says."""
    cell = load_cell(cell_path)
    arm, start = cell.robot.arm_model(), first_belief(cell)
    belief, phases, quantities = start, list[JudgedPhase](), list[Quantity]()
    for spec in cell.job.phases:
        if isinstance(spec, HandEyePhase):
            plan = plan_hand_eye(cell, with_plate(belief, cell), arm, spec.measurements, 0)
            ranges = spec.gated_ranges_m
            extend, points = _plate_of(cell), _hand_eye_points(ranges)
        elif isinstance(spec, LocalizePhase):
            # As after the coarse search, whose points are planned like these and would be more of them.
            plan = plan_localize(cell, with_part(belief, cell), arm, spec, 0)
            extend, points = _part_of(cell), _corners(cell)
        else:
            continue
        if plan.belief is None or plan.worst is None:
            continue
        names = [point.name for point in plan.gated]
        index = names.index(plan.worst.name)
        values, axes = np.linalg.eigh(points(plan.belief).covariance(plan.belief)[index])
        phases.append(JudgedPhase(_batch(cell, plan.steps), extend, points, index, axes[:, -1]))
        quantities.append(Quantity(spec.name, plan.worst.name, float(np.sqrt(values[-1])), plan.worst.U_m))
        belief = plan.belief
    if not phases:
        raise CellError("The job has no hand_eye and no localize phase", "Add one; there is nothing to prove")
    return JudgedJob(arm, start, tuple(phases), tuple(quantities))


def _plate_of(cell: Cell) -> Callable[[Belief], Belief]:
    return lambda belief: with_plate(belief, cell)


def _part_of(cell: Cell) -> Callable[[Belief], Belief]:
    return lambda belief: with_part(belief, cell)


def _hand_eye_points(ranges_m: tuple[float, ...]) -> Callable[[Belief], Points]:
    return lambda belief: hand_eye_points(belief, ranges_m)[0]


def _corners(cell: Cell) -> Callable[[Belief], Points]:
    return lambda belief: corner_points(cell, belief)[0]


def _batch(cell: Cell, steps: tuple[Step, ...]) -> Observations:
    """The planned measurements as the estimator takes them."""
    samples = [
        Sample(
            step=step.id,
            kind=step.kind,
            object=step.object,
            feature=step.feature,
            joints_rad=step.joints_rad,
            joint_scatter_rad=(0.0,) * len(step.joints_rad),
            joint_readings=cell.robot.readings,
            reading_m=step.expected_m,
            reading_scatter_m=0.0,
            readings=PLANNED_CYCLES,
            quality="good",
            why="",
            source_time_s=0.0,
            utc_s=0.0,
        )
        for step in steps
    ]
    (batch,) = observations(cell, samples)
    return batch
