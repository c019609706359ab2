"""Start test: mounts and objects within 0.5 m at any rotation, nothing known of them, 500 draws a task."""

import numpy as np
import pytest

from estimation.tasks.solve import solve
from tests.estimation.tasks.cells import CELLS
from tests.estimation.tasks.pair_cells import PAIR_CELLS
from tests.estimation.tasks.test_tasks import normalised_error
from tests.estimation.tasks.two_robot_cells import TWO_ROBOT_CELLS

TASKS = {**CELLS, **PAIR_CELLS, **TWO_ROBOT_CELLS}
DRAWS = 500


@pytest.mark.campaign
@pytest.mark.parametrize("name", TASKS)
def test_start_test_of_every_task(name: str) -> None:
    """99 % end where the truth is within the covariance; the rest give no value."""
    right = silent = 0
    for seed in range(DRAWS):
        cell = TASKS[name](np.random.default_rng([7, seed]))
        result = solve(cell.problem)
        if result.estimate is None:
            continue
        error, freedoms = normalised_error(result, cell.truth)
        near = error < freedoms + 8.0 * np.sqrt(2.0 * freedoms)  # another minimum is hundreds of sigmas off
        right, silent = right + near, silent + (not near)
    print(f"{name}: {right} of {DRAWS} right, {silent} wrong without saying so")
    assert right >= 0.99 * DRAWS
    assert silent == 0
