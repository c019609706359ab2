"""Candidates where few can be had: a face that hardly any beam reaches, choices that are often hindered."""

import numpy as np
import pytest

from controller.cellfile import load_cell
from controller.knowledge import first_belief, with_part
from controller.planning.candidates import PART_DRAWS, part_candidates
from controller.planning.estimated import choose, corner_points, margin_m
from controller.planning.workspace import Candidates, Workspace
from estimation.errors import Unreachable
from tests.controller.planning.random_cells import FACES, write_cell

RARE = 3  # place of the face "left", of which one beam in a thousand is clear and in range


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    cell = load_cell(write_cell(tmp_path_factory.mktemp("cell"), seed=115))
    return Workspace(cell, cell.robot.arm_model(), with_part(first_belief(cell), cell))


@pytest.fixture(scope="module")
def pool(workspace: Workspace) -> Candidates:
    return part_candidates(workspace, FACES, 0, PART_DRAWS, margin_m(workspace))


def test_a_face_that_few_beams_reach_is_tried_harder(workspace: Workspace, pool: Candidates) -> None:
    counts = np.bincount(pool.feature_index, minlength=len(FACES))
    assert counts[RARE] >= 3
    assert counts[RARE] < 200 <= min(np.delete(counts, RARE))
    again = part_candidates(workspace, FACES, 0, PART_DRAWS, margin_m(workspace))
    np.testing.assert_array_equal(again.joints_rad, pool.joints_rad)


def test_choices_that_are_hindered_again_and_again_are_replaced(
    workspace: Workspace, pool: Candidates
) -> None:
    gates = corner_points(workspace.cell, workspace.belief)[0].jacobian
    best, _ = choose(workspace, pool, gates, 20)
    edge = float(np.median(np.linalg.norm(best.object_p_m, axis=1)))

    def beyond(chosen: Candidates) -> np.ndarray:
        return np.asarray(np.linalg.norm(chosen.object_p_m, axis=1) > edge)

    chosen, _ = choose(workspace, pool, gates, 20, beyond)
    assert len(chosen) == 20 and not beyond(chosen).any()
    with pytest.raises(Unreachable, match="20 measurements of the part"):
        choose(workspace, pool, gates, 20, lambda all_of_them: np.ones(len(all_of_them), dtype=np.bool_))
