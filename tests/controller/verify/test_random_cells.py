"""Random cells: honest estimates hold the truth, dishonest ones are found out, refusals are counted."""

import json
from typing import Any

import numpy as np
import pytest

from controller.verify.executor import open_executor
from controller.verify.random_cells import TASKS, cover, estimate_cell
from estimation.proof.coverage import Coverage
from simulators.world.random_cells import draw_cell

CELLS = 60


@pytest.fixture(scope="module")
def drawn() -> list[dict[str, Any]]:
    return [json.loads(json.dumps(draw_cell(seed))) for seed in range(CELLS)]


def nees_of(cells: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    found = [estimate_cell(cell) for cell in cells]
    return {task: np.array([each[task] for each in found], dtype=float) for task in TASKS}


def test_the_number_of_workers_changes_no_figure(drawn: list[dict[str, Any]]) -> None:
    here = nees_of(drawn)
    seen: list[int] = []
    with open_executor(workers=2) as executor:
        covered = cover(executor, 0, CELLS, seen.append)
    assert seen == [20, 40, 60]
    for task in TASKS:
        np.testing.assert_array_equal(covered[task].nees, here[task])
        assert covered[task].verdict == "honest"


def test_errors_larger_than_declared_are_found_out(drawn: list[dict[str, Any]]) -> None:
    """The estimator believes the declared scatter of the range, which is a quarter of the real one."""
    cells = [
        {
            **cell,
            "declared": {
                **cell["declared"],
                "range_std": 0.1 * cell["declared"]["range_std"],
                "joint_std": 0.1 * cell["declared"]["joint_std"],
            },
        }
        for cell in drawn[:30]
    ]
    claimed = Coverage(5, nees_of(cells)["hand-eye"])
    assert claimed.verdict == "claims too much"


def test_a_cell_that_cannot_be_estimated_is_refused_not_scored(drawn: list[dict[str, Any]]) -> None:
    plate = drawn[0]["plate"]
    broken = {
        **drawn[0],
        "plate": {
            key: [np.nan] * len(plate["readings"]) if key == "readings" else value
            for key, value in plate.items()
        },
    }
    assert estimate_cell(broken) == dict.fromkeys(TASKS)
