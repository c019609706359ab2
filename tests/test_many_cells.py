"""A hundred cells, each a whole job with wires, drivers and gates in virtual time: is what is stated true?"""

import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
import pytest

from controller.packml import State
from controller.truth_table import Row, compare
from tests.support.deterministic import DeterministicCell
from tests.support.honesty import Honesty, laser_error, nees, part_error

SEEDS = range(1, 101)
FEWEST_RELEASED = 96
INSIDE = (89, 99)


@dataclass(frozen=True)
class Outcome:
    """What one honest cell came to."""

    seed: int
    state: State
    released: bool
    rows: tuple[Row, ...]
    hand_eye_nees: float
    part_nees: float
    message: str


def run_cell(seed: int) -> Outcome:
    """One whole job."""
    cell = DeterministicCell(seed)
    state = cell.run()
    results = cell.results()
    table = compare(cell.cell, list(results.values()), cell.truth.to_json())
    found = [np.nan, np.nan]
    if "hand-eye" in results:
        belief = cell.belief("hand-eye")
        found[0] = nees(laser_error(belief, cell.truth), belief.block_covariance("laser"))
    if "localize" in results:
        belief = cell.belief("localize")
        found[1] = nees(part_error(belief, cell.truth), belief.block_covariance("part"))
    outcome = Outcome(seed, state, cell.released, table.rows, *found, cell.engine.status()["message"])
    cell.close()
    return outcome


@pytest.fixture(scope="module")
def outcomes() -> list[Outcome]:
    context = multiprocessing.get_context("forkserver")
    workers = len(os.sched_getaffinity(0)) // int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    with ProcessPoolExecutor(max(1, workers), mp_context=context) as pool:
        return list(pool.map(run_cell, SEEDS, chunksize=5))


@pytest.mark.timeout(1200)
def test_honest_cells_are_released_and_none_wrongly(
    outcomes: list[Outcome], record_property: Callable[[str, object], None]
) -> None:
    refused = [outcome for outcome in outcomes if not outcome.released]
    record_property("whole jobs", f"{len(outcomes) - len(refused)} of {len(outcomes)} released OK")
    for outcome in refused:
        record_property(f"whole jobs, seed {outcome.seed}", f"{outcome.state}: {outcome.message}")
    for outcome in outcomes[:10]:
        for row in outcome.rows:
            flag = "inside" if row.inside else "OUTSIDE"
            print(
                f"seed {outcome.seed}: {row.quantity}: {row.error_mm:.3f} of U {row.stated_mm:.3f} mm, {flag}"
            )
    assert not [(o.seed, row) for o in outcomes for row in o.rows if row.wrongly_released]
    assert len(outcomes) - len(refused) >= FEWEST_RELEASED


@pytest.mark.timeout(1200)
@pytest.mark.parametrize("which", ["hand_eye_nees", "part_nees"])
def test_the_95_percent_region_holds_the_truth(
    outcomes: list[Outcome], which: str, record_property: Callable[[str, object], None]
) -> None:
    values = np.array([getattr(outcome, which) for outcome in outcomes])
    honesty = Honesty(5 if which == "hand_eye_nees" else 6, values[np.isfinite(values)])
    low, high = honesty.band(0.99)
    record_property(f"whole jobs, {which}", str(honesty))
    assert INSIDE[0] <= honesty.inside <= INSIDE[1]
    assert low <= honesty.mean_over_dimension <= high
