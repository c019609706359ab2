"""One measurement after the other: the next best, no more than needed, made good when missed.

The samples are those of a cell that is as the belief says, with noise.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from controller.cellfile import Cell
from controller.cellfile.job import HandEyePhase as HandEyeSpec
from controller.cellfile.job import LocalizePhase as LocalizeSpec
from controller.knowledge import first_belief, joint_variance, observations
from controller.phases.base import Finding, PhaseContext, PhaseKind
from controller.phases.findings import by_phase
from controller.phases.hand_eye import HandEyePhase
from controller.phases.localize import LocalizePhase
from controller.phases.one_by_one import GIVE_UP
from controller.planning import Prospect, plan_hand_eye
from controller.planning.online import ADDED_NOTE
from controller.planning.plan import MARGIN
from controller.planning.steps import Step
from controller.samples import Sample
from estimation.belief import Belief
from tests.controller.planning.planned import SEED, Planned, belief_of

READINGS, JOINT_READINGS = 100, 3
Missed = Callable[[Step, int], bool]


def sample_of(cell: Cell, step: Step, seen: bool = True) -> Sample:
    """Noise as declared; it follows from the number of the step, so that it is always the same."""
    random = np.random.default_rng(int(step.id))
    laser_std_m = np.hypot(cell.laser.noise_m, cell.laser.reading_noise_m / np.sqrt(READINGS))
    joints_rad = random.normal(step.joints_rad, np.sqrt(joint_variance(cell, JOINT_READINGS)))
    return Sample(
        step=step.id,
        kind=step.kind,
        object=step.object,
        feature=step.feature,
        joints_rad=tuple(joints_rad.tolist()),
        joint_scatter_rad=(0.0,) * 6,
        joint_readings=JOINT_READINGS,
        reading_m=random.normal(step.expected_m, laser_std_m),
        reading_scatter_m=0.0,
        readings=READINGS,
        quality="good" if seen else "bad",
        why="" if seen else "nothing in range",
        source_time_s=0.0,
        utc_s=0.0,
    )


def numbered(steps: Sequence[Step]) -> list[Step]:
    return [replace(step, id=f"{i:03d}") for i, step in enumerate(steps)]


def walk(
    kind: PhaseKind, context: PhaseContext[Any], missed: Missed = lambda step, place: False
) -> tuple[list[Step], list[Sample], Finding]:
    """As the job walks through a phase."""
    steps = numbered(kind.plan(context))
    while True:
        samples = [sample_of(context.cell, step, not missed(step, place)) for place, step in enumerate(steps)]
        further = kind.more(context, steps, samples)
        if not further:
            finding = kind.evaluate(context, steps, samples)
            if not finding.verdict.passed and finding.verdict.curable:
                further = kind.extend(context, steps, samples, finding)
            if not further:
                return steps, samples, finding
        assert len(further) == 1 or steps[-1].note == "coarse"
        steps = numbered([*steps, *further])


def U_of(finding: Finding) -> float:
    return max(float(point["U_m"]) for point in finding.estimate["gated"])


@pytest.fixture(scope="module")
def exact(cell: Cell) -> Cell:
    """The example cell without tests of chance: one that is just as believed has too small residuals."""
    return cell.model_copy(update={"job": cell.job.model_copy(update={"false_alarms": 1e-15})})


@pytest.fixture(scope="module")
def context(exact: Cell, planned: Planned) -> PhaseContext[LocalizeSpec]:
    """Localization of the example cell with six points planned, and a limit that needs a few more."""
    spec = next(phase for phase in exact.job.phases if isinstance(phase, LocalizeSpec))
    spec = spec.model_copy(update={"measurements": 6, "limit_m": 0.24e-3})
    known = belief_of(planned.plans["hand-eye"]).without(["plate"])
    return PhaseContext(exact, spec, planned.arm, known, seed=SEED)


@pytest.fixture(scope="module")
def walked(context: PhaseContext[LocalizeSpec]) -> tuple[list[Step], list[Sample], Finding]:
    return walk(LocalizePhase(), context)


def test_no_more_is_measured_than_the_limit_with_its_margin_needs(
    context: PhaseContext[LocalizeSpec], walked: tuple[list[Step], list[Sample], Finding]
) -> None:
    steps, samples, finding = walked
    added = [step for step in steps if step.note == ADDED_NOTE]
    assert finding.verdict.passed, finding.verdict.message
    assert 3 <= len(added) < 24  # than the thirty of the example
    assert U_of(finding) <= context.spec.limit_m * (1.0 - MARGIN) * 1.01
    before = LocalizePhase().evaluate(context, steps[:-1], samples[:-1])
    assert U_of(before) > context.spec.limit_m * (1.0 - MARGIN) * 0.99
    assert len({step.joints_rad for step in steps}) == len(steps)


def test_the_same_samples_give_the_same_next_step_whoever_asks(
    context: PhaseContext[LocalizeSpec], walked: tuple[list[Step], list[Sample], Finding]
) -> None:
    steps, samples, _ = walked
    for place in (len(steps) - 1, len(steps) - 2):
        assert steps[place - 1].note == ADDED_NOTE
        (again,) = LocalizePhase().more(context, steps[:place], samples[:place])
        assert replace(again, id=steps[place].id) == steps[place]


def test_what_a_missed_point_should_have_told_is_made_good_elsewhere(
    context: PhaseContext[LocalizeSpec], walked: tuple[list[Step], list[Sample], Finding]
) -> None:
    first = next(place for place, step in enumerate(walked[0]) if step.note == ADDED_NOTE)
    steps, _, finding = walk(LocalizePhase(), context, lambda step, place: place in (first, first + 1))
    assert finding.verdict.passed and U_of(finding) <= context.spec.limit_m
    assert len(walked[0]) < len(steps) <= len(walked[0]) + 6


def test_nothing_is_tried_where_a_point_was_missed(
    context: PhaseContext[LocalizeSpec], walked: tuple[list[Step], list[Sample], Finding]
) -> None:
    steps, samples, _ = walked
    belief = LocalizePhase().known(context, samples[:10])
    prospect = Prospect.of_part(context.cell, belief, context.arm, context.spec, SEED + 10)
    best = prospect.next_step([], steps[:10], [])
    assert best is not None
    beside = tuple(np.add(best.object_p_m, [0.002, 0.002, 0.002]).tolist())
    other = prospect.next_step([], steps[:10], [replace(best, object_p_m=beside)])
    assert other is not None
    assert np.linalg.norm(np.subtract(other.object_p_m, beside)) > 0.006


def test_points_that_all_miss_end_the_phase_before_its_budget_does(
    context: PhaseContext[LocalizeSpec],
) -> None:
    steps, _, finding = walk(LocalizePhase(), context, lambda step, place: step.note == ADDED_NOTE)
    assert sum(step.note == ADDED_NOTE for step in steps) == GIVE_UP
    assert not finding.verdict.passed


def test_each_step_is_among_the_best_that_could_be_taken(
    context: PhaseContext[LocalizeSpec], walked: tuple[list[Step], list[Sample], Finding]
) -> None:
    steps, samples, _ = walked
    belief = LocalizePhase().known(context, samples[:10])
    prospect = Prospect.of_part(context.cell, belief, context.arm, context.spec, SEED + 10)
    step = prospect.next_step([], steps[:10], [])
    assert step is not None
    random = np.random.default_rng(0)
    others = [prospect.pool.take([int(row)]) for row in random.choice(len(prospect.pool), 100, replace=False)]
    trials = [
        replace(
            step,
            joints_rad=tuple(other.joints_rad[0].tolist()),
            expected_m=float(other.reading_m[0]),
            feature=other.features[int(other.feature_index[0])].name,
        )
        for other in others
    ]
    U_m = [prospect.U_m(observations(context.cell, [sample_of(context.cell, trial)])) for trial in trials]
    chosen = prospect.U_m(observations(context.cell, [sample_of(context.cell, step)]))
    assert np.mean(np.array(U_m) < chosen) <= 0.1


def test_it_says_what_forbids_the_limit_before_more_robot_time_is_spent(
    context: PhaseContext[LocalizeSpec],
) -> None:
    spec = context.spec.model_copy(update={"limit_m": 0.16e-3})
    steps, _, finding = walk(LocalizePhase(), replace(context, spec=spec))
    assert not any(step.note == ADDED_NOTE for step in steps)
    assert not finding.verdict.passed and not finding.verdict.curable
    said = re.fullmatch(
        r"cannot be met: the best 54 further measurements would reach (0\.\d\d) mm, limit 0\.16 mm; "
        r"kinematics contributes (\d\d)% of the variance",
        finding.verdict.message,
    )
    assert said and float(said[1]) > 0.16 and int(said[2]) > 30
    assert finding.verdict.remedy.startswith("Reduce kinematics, or raise the limit to 0.")


def test_all_noise_of_a_phase_counts_as_one_contribution() -> None:
    shares = {"kinematics": 0.19, "hand-eye range noise": 0.5, "hand-eye joint noise": 0.31}
    assert by_phase(shares) == ("hand-eye", pytest.approx(0.81))
    assert by_phase({"laser scale": 0.6, "part form": 0.4}) == ("laser scale", 0.6)


def test_a_hand_eye_goes_on_in_the_same_way(exact: Cell, planned: Planned) -> None:
    spec = next(phase for phase in exact.job.phases if isinstance(phase, HandEyeSpec))
    spec = spec.model_copy(update={"measurements": 9, "limit_m": 0.40e-3})
    context = PhaseContext(exact, spec, planned.arm, first_belief(exact), seed=SEED)
    steps, _, finding = walk(HandEyePhase(), context)
    assert finding.verdict.passed, finding.verdict.message
    assert 15 < len(steps) < 40  # of the eighty of the example
    best: Belief = belief_of(plan_hand_eye(exact, planned.plate_prior, planned.arm, len(steps), SEED))
    chosen_at_once = max(float(p["U_m"]) for p in HandEyePhase.gated(context, best))
    assert U_of(finding) < 1.15 * chosen_at_once  # one by one is hardly worse than all at once


def test_one_wrong_reading_moves_neither_the_estimate_nor_what_is_planned_with(
    exact: Cell, planned: Planned
) -> None:
    """The tool that must stay clear of everything is where the laser is believed to be."""
    spec = next(phase for phase in exact.job.phases if isinstance(phase, HandEyeSpec))
    context = PhaseContext(exact, spec, planned.arm, first_belief(exact), seed=SEED)
    steps = numbered(HandEyePhase().plan(context))[:40]
    samples = [sample_of(exact, step) for step in steps]
    samples[7] = replace(samples[7], reading_m=samples[7].reading_m + 0.010)
    nominal_m = exact.laser.mount.transform().origin_m
    known = HandEyePhase().known(context, samples)
    assert np.linalg.norm(known.transform("laser").origin_m - nominal_m) < 1e-3
