"""Limits below what is possible are refused before anything moves, and limits that a plan reaches are not.

`make campaign` asks about 100 cells of each kind.
"""

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from controller.cellfile import Cell, load_cell
from controller.cellfile.job import LocalizePhase
from controller.knowledge import first_belief, with_part, with_plate
from controller.planning import plan_coarse_localize, plan_hand_eye, plan_localize
from controller.planning.candidates import part_candidates
from controller.planning.estimated import COARSE_COUNT, corner_points
from controller.planning.feasibility import PART_DRAWS, feasibility, limit_mistakes
from controller.planning.workspace import Candidates, Workspace, rows_of
from controller.verify.executor import open_executor
from estimation.belief import Belief
from estimation.design import DesignProblem, lower_bound
from estimation.statistics import coverage_factor
from tests.controller.planning.planned import belief_of
from tests.controller.planning.random_cells import write_cell

MOST = 40


def localize_of(cell: Cell) -> LocalizePhase:
    return next(spec for spec in cell.job.phases if isinstance(spec, LocalizePhase))


def before_localize(cell: Cell) -> Belief:
    """What the hand-eye is planned to leave, and the part as it was clamped by hand."""
    arm, prior = cell.robot.arm_model(), with_plate(first_belief(cell), cell)
    return with_part(belief_of(plan_hand_eye(cell, prior, arm, 160, 0)).without(["plate"]), cell)


def searched(cell: Cell, belief: Belief) -> Belief:
    """What the coarse points are planned to leave."""
    return belief_of(plan_coarse_localize(cell, belief, cell.robot.arm_model(), localize_of(cell), 0))


def bound_mm(cell: Cell, belief: Belief, known: Belief) -> float:
    """No choice of coarse points and of all measurements that localize may take has a smaller U.

    A bound holds for the beams that it is given: those that the check draws, which may have lucky ones among
    them, and many more; all as near to edges and ends of the range as a part that is `known` lets them be.
    """
    workspace, faces = Workspace(cell, cell.robot.arm_model(), known), localize_of(cell).faces
    pool = Candidates.joined(
        [part_candidates(workspace, faces, 0, draws) for draws in (PART_DRAWS, 4 * PART_DRAWS)]
    )
    rows, corners = rows_of(workspace, pool), corner_points(cell, belief)[0]
    problem = DesignProblem(belief.covariance, rows.dense(belief), rows.noise_variance, corners.jacobian)
    bound = lower_bound(problem, MOST + COARSE_COUNT)
    return 1e3 * coverage_factor(3) * float(np.sqrt(bound.value))


def refused(folder: Path, seed: int, limit_mm: float) -> bool:
    cell = load_cell(write_cell(folder, seed, limit_mm, MOST, MOST, quiet=False))
    return any("limit" in mistake.key for mistake in limit_mistakes(cell))


@dataclass(frozen=True)
class Case:
    seed: int
    bound_mm: float  # no choice of all measurements, coarse ones among them, has a smaller U
    best_mm: float  # what the check before motion takes for the best
    reached_mm: float  # by a plan with all measurements
    refused_below: bool  # a limit of 0.95 of the bound
    refused_above: bool  # a limit of 1.10 times what is reached


def case_of(seed: int) -> Case:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cell = load_cell(write_cell(folder, seed, 10.0, MOST, MOST, quiet=False))
        belief = before_localize(cell)
        plan = plan_localize(cell, searched(cell, belief), cell.robot.arm_model(), localize_of(cell), 0)
        reached_mm = 1e3 * max(point.U_m for point in plan.gated)
        bound = bound_mm(cell, belief, belief_of(plan))
        return Case(
            seed,
            bound,
            1e3 * feasibility(cell)[-1].best.U_m,
            reached_mm,
            refused(folder, seed, 0.95 * bound),
            refused(folder, seed, 1.10 * reached_mm),
        )


def judge(cases: Iterable[Case]) -> None:
    count = below = above = 0
    for case in cases:
        print(case, flush=True)
        assert case.bound_mm <= case.best_mm * 1.02
        count += 1
        below += case.refused_below
        above += case.refused_above
    print(f"refused: {below} of {count} at 0.95 of the bound, {above} at 1.10 of what is reached")
    assert (below, above) == (count, 0)


def test_limits_of_one_cell() -> None:
    judge([case_of(101)])


@pytest.mark.campaign
def test_limits_of_a_hundred_cells() -> None:
    with open_executor() as executor:
        judge(executor.map(case_of, range(101, 201)))
