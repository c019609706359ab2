"""One random cell of the planning campaign: points of the pattern, points of ours, and whether ours holds."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from controller.cellfile import Cell
from controller.knowledge import first_belief, with_part
from controller.planning.candidates import occluded, part_candidates
from controller.planning.estimated import corner_points, margin_m
from controller.planning.plan import accessible, gated_predictions, laser_steps
from controller.planning.workspace import Candidates, Workspace, observations_of, rows_of
from controller.verify.replicas import JudgedJob, JudgedPhase, replicas
from estimation.design import CRITERIA, DesignProblem, choose, fewest, lower_bound
from estimation.design.baselines import pattern
from estimation.measurement import Chain
from estimation.solver import predicted_belief
from tests.controller.planning.independent import Standing
from tests.controller.planning.random_cells import FACES, random_cell

DRAWS = 6000
LEAST_ON_A_FACE = 64  # a face with fewer candidates is out of reach, for the plan and for the pattern
POINTS = (75, 300)  # that the pattern needs
NOISE_SHARE = 0.8  # least share of independent noise in the variance
REPLICAS = 200
BETWEEN = np.linspace(0.0, 1.0, 5)[1:-1]  # where paths are checked between their postures


@dataclass(frozen=True)
class Outcome:
    seed: int
    limit_mm: float  # U at the worst corner
    pattern: int
    planned: int
    noise_share: float
    quieter: float  # mean noise variance of the planned points over that of the pattern: what their tilt does
    efficiency: dict[str, float]  # of at least 24 points, by criterion: bound over value, as variances
    achieved: float  # standard deviation of the true error over the predicted one
    refused: int  # replicas without an estimate
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


def achieved(workspace: Workspace, chosen: Candidates, seed: int, count: int) -> tuple[float, int]:
    """Achieved over predicted standard deviation at the worst corner, along its worst axis; and refusals."""
    cell, batch = workspace.cell, observations_of(workspace, chosen)
    predicted = predicted_belief(workspace.belief, Chain(workspace.arm, [batch]), "localize")
    covariance = corner_points(cell, predicted)[0].covariance(predicted)
    values, axes = np.linalg.eigh(covariance)
    worst = int(np.argmax(values[:, -1]))
    phase = JudgedPhase(
        batch,
        lambda belief: with_part(belief, cell),
        lambda belief: corner_points(cell, belief)[0],
        worst,
        axes[worst, :, -1],
    )
    job = JudgedJob(workspace.arm, first_belief(cell), (phase,), ())
    error_m = replicas(job, seed, 0, count)[:, 0, 0]
    known = np.isfinite(error_m)
    return float(np.std(error_m[known]) / np.sqrt(values[worst, -1])), int((~known).sum())


def wrong_poses(standing: Standing, workspace: Workspace, chosen: Candidates) -> list[str]:
    """What rays and collisions find of a plan: each pose, each posture on the way, and between them."""
    normals = np.array([chosen.features[int(i)].axis for i in chosen.feature_index])
    wrong = standing.seen(chosen.joints_rad, normals, chosen.object_p_m)
    here: np.ndarray | None = None
    for step in laser_steps(workspace, chosen):
        for posture in (*step.via, step.joints_rad):
            there = np.array(posture)
            wrong += standing.collisions(there)
            for share in BETWEEN if here is not None else ():
                wrong += [
                    f"on the way: {what}" for what in standing.collisions(here + share * (there - here))
                ]
            here = there
    return wrong


def campaign_cell(seed: int, count: int = REPLICAS) -> Outcome | None:
    """The cell of a seed, tried with `count` replicas, or None where it is not of the wanted kind."""
    with tempfile.TemporaryDirectory() as name:
        return _campaign_cell(Path(name), seed, count)


def _campaign_cell(folder: Path, seed: int, count: int) -> Outcome | None:
    cell = random_cell(folder, seed)
    workspace, pool = candidates_of(cell, seed)
    faces = len(np.unique(pool.feature_index))
    if faces < 3:
        return None
    problem = problem_of(workspace, pool)
    random = np.random.default_rng([seed, 6])
    side = int(random.choice([side for side in range(2, 11) if POINTS[0] <= faces * side**2 <= POINTS[1]]))
    grids = [pattern(pool.object_p_m, pool.feature_index, each) for each in range(1, side + 1)]
    values = [value_of(problem, grid) for grid in grids]
    if values[-1] >= min(values[:-1]):
        return None  # no limit needs just this grid
    target = values[-1] + random.uniform(0.0, 1.0) * (min(values[:-1]) - values[-1])
    share = noise_share(workspace, pool.take(grids[-1]))
    if share < NOISE_SHARE:
        return None
    selection = fewest(problem, target)
    assert selection.value <= target
    chosen = pool.take(selection.chosen)
    mesh = trimesh.load_mesh(folder / "part.stl")
    standing = Standing(cell, trimesh.Trimesh(mesh.vertices * 1e-3, mesh.faces), workspace.pose("part"))
    ratio, refused = achieved(workspace, chosen, seed, count)
    return Outcome(
        seed,
        2.795e3 * float(np.sqrt(target)),
        len(grids[-1]),
        len(selection),
        share,
        float(problem.variance[selection.chosen].mean() / problem.variance[grids[-1]].mean()),
        efficiencies(problem, max(24, len(selection))),
        ratio,
        refused,
        wrong_poses(standing, workspace, chosen),
    )
