"""One seed is one job, and how much faster than real time it runs; the figure is shown after the tests."""

from collections.abc import Callable
from dataclasses import asdict

import pytest

from controller.packml import State
from tests.support.deterministic import DeterministicCell

pytestmark = pytest.mark.wire  # not on a port, but alone on the computer: its time is told


def whole_job() -> tuple[list[object], float, float]:
    """Everything that the store holds of the job of seed 1, its simulated time and its wall time, s."""
    cell = DeterministicCell(seed=1)
    assert cell.run() is State.COMPLETED
    run, store = cell.store.runs(1)[0], cell.store
    records = [run, *store.plans(run.id), *store.samples(run.id), *store.results(run.id), *store.events()]
    simulated_s = cell.world.clock.now_s()
    cell.close()
    return [asdict(record) for record in records], simulated_s, cell.wall_s


def test_one_seed_is_one_job(record_property: Callable[[str, object], None]) -> None:
    """Asserts no time: other work on the computer must not fail a test. `conftest.py` prints the property.

    The second run is told: the first also loads the compiled parts of the libraries.
    """
    first, _, _ = whole_job()
    second, simulated_s, wall_s = whole_job()
    assert first == second
    speed = f"simulated {simulated_s:.0f} s / wall {wall_s:.1f} s = {simulated_s / wall_s:.0f}"
    record_property("deterministic cell", speed)
