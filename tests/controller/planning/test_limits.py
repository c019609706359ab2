"""Limits below what is possible are refused before anything moves, and limits that a plan reaches are not.

`make campaign` asks about 100 cells of each kind.
"""

from pathlib import Path

import numpy as np
import pytest

from controller.cellfile import Cell, load_cell
from controller.cellfile.job import LocalizePhase
from controller.knowledge import first_belief, with_part, with_plate
from controller.planning import plan_coarse_localize, plan_hand_eye, plan_localize
from controller.planning.candidates import part_candidates
from controller.planning.estimated import corner_points, margin_m
from controller.planning.feasibility import DRAWS, feasibility, limit_mistakes
from controller.planning.workspace import Workspace, rows_of
from estimation.belief import Belief
from estimation.design import DesignProblem, lower_bound
from estimation.statistics import coverage_factor
from tests.controller.planning.planned import belief_of
from tests.controller.planning.random_cells import write_cell

MOST = 40


def localize_of(cell: Cell) -> LocalizePhase:
    return next(spec for spec in cell.job.phases if isinstance(spec, LocalizePhase))


def before_localize(cell: Cell) -> Belief:
    """What hand-eye and coarse points are planned to leave."""
    arm, prior = cell.robot.arm_model(), with_plate(first_belief(cell), cell)
    known = belief_of(plan_hand_eye(cell, prior, arm, 160, 0)).without(["plate"])
    return belief_of(plan_coarse_localize(cell, with_part(known, cell), arm, localize_of(cell), 0))


def bound_mm(cell: Cell, belief: Belief) -> float:
    """No choice of all measurements that localize may take has a smaller U."""
    workspace = Workspace(cell, cell.robot.arm_model(), belief)
    pool = part_candidates(workspace, localize_of(cell).faces, 0, DRAWS, margin_m(workspace))
    rows, corners = rows_of(workspace, pool), corner_points(cell, belief)[0]
    problem = DesignProblem(belief.covariance, rows.dense(belief), rows.noise_variance, corners.jacobian)
    return 1e3 * coverage_factor(3) * float(np.sqrt(lower_bound(problem, MOST).value))


def refused(folder: Path, seed: int, limit_mm: float) -> bool:
    cell = load_cell(write_cell(folder, seed, limit_mm, MOST, MOST, quiet=False))
    return any("limit" in mistake.key for mistake in limit_mistakes(cell))


def judge(tmp_path: Path, wanted: int) -> None:
    seed, impossible, possible = 100, 0, 0
    for _ in range(wanted):
        seed += 1
        folder = tmp_path / str(seed)
        folder.mkdir()
        cell = load_cell(write_cell(folder, seed, 10.0, MOST, MOST, quiet=False))
        belief = before_localize(cell)
        spec, arm = localize_of(cell), cell.robot.arm_model()
        reached_mm = 1e3 * plan_localize(cell, belief, arm, spec, 0).curve_U_m[-1]
        bound = bound_mm(cell, belief)
        assert bound <= 1e3 * feasibility(cell)[-1].best.U_m * 1.02
        impossible += refused(folder, seed, 0.95 * bound)
        possible += refused(folder, seed, 1.10 * reached_mm)
        print(f"seed {seed}: bound {bound:.4f} mm, reached {reached_mm:.4f} mm", flush=True)
    print(f"refused: {impossible} of {wanted} at 0.95 of the bound, {possible} at 1.10 of what is reached")
    assert (impossible, possible) == (wanted, 0)


def test_limits_of_a_few_cells(tmp_path: Path) -> None:
    judge(tmp_path, 1)


@pytest.mark.campaign
def test_limits_of_a_hundred_cells(tmp_path: Path) -> None:
    judge(tmp_path, 100)
