"""Plans for random parts and cells: how many points they save, how near to the bound, and whether they hold.

Limits are drawn so that the pattern (the fewest equal k x k grid per face that meets them) needs 75 to 300
points and independent noise is at least 80 % of the variance. `make campaign` runs 200 such cells.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import trimesh

from controller.cellfile import Cell
from controller.knowledge import first_belief, with_part
from controller.planning.candidates import occluded, part_candidates
from controller.planning.estimated import corner_points, margin_m
from controller.planning.plan import accessible, gated_predictions, laser_steps
from controller.planning.workspace import Candidates, Workspace, observations_of, rows_of
from estimation.design import CRITERIA, DesignProblem, choose, fewest, lower_bound
from estimation.design.baselines import pattern
from estimation.measurement import Chain
from estimation.solver import predicted_belief
from tests.controller.planning.independent import Standing
from tests.controller.planning.random_cells import FACES, random_cell

DRAWS = 6000
LEAST_ON_A_FACE = 64  # a face with fewer candidates is out of reach, for the plan and for the pattern


@dataclass(frozen=True)
class Outcome:
    seed: int
    pattern: int
    planned: int
    efficiency: dict[str, float]  # of at least 24 points, by criterion: bound over value, as variances
    wrong: list[str]  # what the independent check found


def candidates_of(cell: Cell, seed: int) -> tuple[Workspace, Candidates]:
    workspace = Workspace(cell, cell.robot.arm_model(), with_part(first_belief(cell), cell))
    pool = part_candidates(workspace, FACES, seed, DRAWS, margin_m(workspace))
    counts = np.bincount(pool.feature_index, minlength=len(FACES))
    pool = pool.take(counts[pool.feature_index] >= LEAST_ON_A_FACE)
    pool = pool.take(~occluded(workspace, pool))
    return workspace, pool.take(accessible(workspace, pool))


def problem_of(workspace: Workspace, pool: Candidates) -> DesignProblem:
    rows = rows_of(workspace, pool)
    corners = corner_points(workspace.cell, workspace.belief)[0]
    return DesignProblem(
        workspace.belief.covariance, rows.dense(workspace.belief), rows.noise_variance, corners.jacobian
    )


def value_of(problem: DesignProblem, chosen: np.ndarray) -> float:
    return CRITERIA["worst"].value(problem.judged(problem.white_covariance(chosen=chosen)))


def noise_share(workspace: Workspace, chosen: Candidates) -> float:
    """Share of independent noise in the variance at the worst corner."""
    predicted = predicted_belief(
        workspace.belief, Chain(workspace.arm, [observations_of(workspace, chosen)]), "localize"
    )
    points, names = corner_points(workspace.cell, workspace.belief)
    worst = max(gated_predictions(predicted, points, names), key=lambda point: point.U_m)
    return sum(share for source, share in worst.shares.items() if source.endswith("noise"))


def efficiencies(problem: DesignProblem, count: int) -> dict[str, float]:
    """D of the pose of the part, A and the worst axis of its corners, E of the whole state."""
    found = {}
    for name, criterion in CRITERIA.items():
        judged = problem
        if name in ("D", "E"):
            judged = DesignProblem(problem.covariance, problem.rows, problem.variance)
        reached = choose(judged, count, criterion).value
        found[name] = criterion.efficiency(lower_bound(judged, count, criterion).value, reached)
    return found


def campaign_cell(folder: Path, seed: int) -> Outcome | None:
    """One cell, or None where none of the wanted kind comes from this seed."""
    cell = random_cell(folder, seed)
    workspace, pool = candidates_of(cell, seed)
    faces = len(np.unique(pool.feature_index))
    if faces < 3:
        return None
    problem = problem_of(workspace, pool)
    random = np.random.default_rng([seed, 6])
    sides = [side for side in range(2, 9) if 75 <= faces * side**2 <= 300]
    side = int(random.choice(sides))
    values = {}
    for each in (side - 1, side):
        values[each] = value_of(problem, pattern(pool.object_p_m, pool.feature_index, each))
    if values[side] >= values[side - 1]:
        return None
    target = values[side] + random.uniform(0.0, 1.0) * (values[side - 1] - values[side])
    grid = pattern(pool.object_p_m, pool.feature_index, side)
    if noise_share(workspace, pool.take(grid)) < 0.8:
        return None
    selection = fewest(problem, target)
    assert selection.value <= target
    chosen = pool.take(selection.chosen)
    standing = Standing(cell, _mesh(folder), workspace.pose("part"))
    normals = np.array([chosen.features[int(i)].axis for i in chosen.feature_index])
    wrong = standing.seen(chosen.joints_rad, normals, chosen.object_p_m)
    for step in laser_steps(workspace, chosen):
        for posture in (step.joints_rad, *step.via, *step.access):
            wrong += standing.collisions(np.array(posture))
    count = max(24, len(selection))
    return Outcome(seed, len(grid), len(selection), efficiencies(problem, count), wrong)


def _mesh(folder: Path) -> trimesh.Trimesh:
    mesh = trimesh.load_mesh(folder / "part.stl")
    return trimesh.Trimesh(mesh.vertices * 1e-3, mesh.faces)


def outcomes(tmp_path: Path, wanted: int) -> list[Outcome]:
    found: list[Outcome] = []
    seed = 0
    while len(found) < wanted:
        seed += 1
        folder = tmp_path / str(seed)
        folder.mkdir()
        outcome = campaign_cell(folder, seed)
        if outcome is not None:
            found.append(outcome)
            print(seed, outcome.pattern, outcome.planned, outcome.efficiency, outcome.wrong, flush=True)
    ratio = np.array([outcome.planned / outcome.pattern for outcome in found])
    print(
        f"{len(found)} cells of {seed} seeds; planned / pattern: "
        f"median {np.median(ratio):.2f}, worst {ratio.max():.2f}"
    )
    for name in CRITERIA:
        values = np.array([outcome.efficiency[name] for outcome in found])
        print(f"{name}: bound / reached, median {np.median(values):.3f}, least {values.min():.3f}")
    print(f"poses that an independent check refuses: {sum(len(outcome.wrong) for outcome in found)}")
    return found


def judge(found: list[Outcome]) -> None:
    assert np.median([outcome.planned / outcome.pattern for outcome in found]) <= 0.65
    assert min(outcome.efficiency["D"] for outcome in found) >= 0.95
    assert not any(outcome.wrong for outcome in found)


def test_plans_of_a_few_random_cells(tmp_path: Path) -> None:
    judge(outcomes(tmp_path, 3))


@pytest.mark.campaign
def test_plans_of_two_hundred_random_cells(tmp_path: Path) -> None:
    judge(outcomes(tmp_path, 200))
