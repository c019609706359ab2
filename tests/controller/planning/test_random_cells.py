"""Plans for random parts and cells: how many points they save, how near to the bound, and whether they hold.

Limits are drawn so that the pattern (the fewest equal k x k grid per face that meets them) needs 75 to 300
points and independent noise is at least 80 % of the variance. `make campaign` runs 200 such cells.
"""

from collections.abc import Iterable
from itertools import count

import numpy as np
import pytest

from controller.verify.executor import open_executor
from estimation.design import CRITERIA
from tests.controller.planning.campaign_cells import Outcome, campaign_cell

CHUNK = 20  # seeds that are tried together


def outcomes(wanted: int) -> list[Outcome]:
    """The first `wanted` seeds from 1 that give a cell of the wanted kind."""
    found: list[Outcome] = []
    with open_executor() as executor:
        for first in count(1, CHUNK):
            for outcome in executor.map(campaign_cell, range(first, first + CHUNK)):
                if outcome is not None and len(found) < wanted:
                    found.append(outcome)
                    print(outcome, flush=True)
            if len(found) == wanted:
                return found
    return found


def report(found: Iterable[Outcome]) -> None:
    found = list(found)
    ratio = np.array([outcome.planned / outcome.pattern for outcome in found])
    print(f"{len(found)} cells, seeds up to {found[-1].seed}")
    print(
        f"planned / pattern: median {np.median(ratio):.2f}, {ratio.min():.2f} to {ratio.max():.2f}; "
        f"pattern {min(o.pattern for o in found)} to {max(o.pattern for o in found)} points"
    )
    print(
        f"noise variance of their points: median {np.median([o.quieter for o in found]):.2f} of the pattern's"
    )
    for name in CRITERIA:
        values = np.array([outcome.efficiency[name] for outcome in found])
        print(f"{name}: bound / reached, median {np.median(values):.3f}, least {values.min():.3f}")
    achieved = np.array([outcome.achieved for outcome in found])
    low, high = np.percentile(achieved, [2.5, 97.5])
    print(
        f"achieved / predicted: median {np.median(achieved):.3f}, 95 % in {low:.2f} to {high:.2f}, "
        f"{np.mean((achieved >= 0.8) & (achieved <= 1.25)):.1%} in 0.8 to 1.25, "
        f"refused replicas {sum(outcome.refused for outcome in found)}"
    )
    print(f"poses that an independent check refuses: {sum(len(outcome.wrong) for outcome in found)}")


def judge(found: list[Outcome]) -> None:
    report(found)
    assert np.median([outcome.planned / outcome.pattern for outcome in found]) <= 0.65
    assert min(outcome.efficiency["D"] for outcome in found) >= 0.95
    achieved = np.array([outcome.achieved for outcome in found])
    assert 0.9 <= np.median(achieved) <= 1.1
    assert np.mean((achieved >= 0.8) & (achieved <= 1.25)) >= 0.95
    assert not any(outcome.wrong for outcome in found)


def test_plans_of_two_random_cells() -> None:
    found = [campaign_cell(seed, count=60) for seed in (2, 3)]
    judge([outcome for outcome in found if outcome is not None])


@pytest.mark.campaign
def test_plans_of_two_hundred_random_cells() -> None:
    judge(outcomes(200))
