"""The example cell, and what its job plans: made once, because plans depend on nothing else."""

import pytest

from controller.cellfile import Cell, job, load_cell
from controller.knowledge import (
    first_belief,
    with_bar,
    with_inspected,
    with_part,
    with_plate,
    with_probe,
)
from controller.planning import (
    plan_bar_check,
    plan_coarse_localize,
    plan_hand_eye,
    plan_inspect,
    plan_localize,
    plan_noise,
    plan_part_check,
)
from tests.controller.planning.planned import CELL, SEED, Planned, belief_of


@pytest.fixture(scope="session")
def cell() -> Cell:
    return load_cell(CELL)


@pytest.fixture(scope="session")
def planned(cell: Cell) -> Planned:
    arm = cell.robot.arm_model()
    noise, hand_eye, bar, localize, check, inspect = cell.job.phases
    assert isinstance(noise, job.NoisePhase)
    assert isinstance(hand_eye, job.HandEyePhase)
    assert isinstance(bar, job.CheckPhase)
    assert isinstance(localize, job.LocalizePhase)
    assert isinstance(check, job.CheckPhase)
    assert isinstance(inspect, job.InspectPhase)
    prior = with_plate(first_belief(cell), cell)
    plans = {"noise": plan_noise(cell, prior, arm, noise)}
    plans["hand-eye"] = plan_hand_eye(cell, prior, arm, hand_eye.measurements, SEED)
    known = belief_of(plans["hand-eye"])
    plans["bar"] = plan_bar_check(cell, with_bar(known, cell), arm, bar, plans["hand-eye"].steps, SEED)
    part = with_part(known.without(["plate"]), cell)
    plans["coarse"] = plan_coarse_localize(cell, part, arm, localize, SEED)
    plans["localize"] = plan_localize(cell, belief_of(plans["coarse"]), arm, localize, SEED)
    lying = belief_of(plans["localize"])
    used = [*plans["coarse"].steps, *plans["localize"].steps]
    plans["check"] = plan_part_check(cell, lying, arm, check, used, SEED)
    touched = with_inspected(with_probe(lying, cell), cell)
    plans["inspect"] = plan_inspect(cell, touched, arm, inspect, SEED)
    return Planned(cell, arm, prior, part, plans)
