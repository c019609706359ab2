"""One seed is one job, and how much faster than real time it runs; the figure is shown after the tests."""

import os
import time
from collections.abc import Callable
from dataclasses import asdict

import pytest

from benchmarks.sample_rate import Bench
from controller.packml import State
from tests.support.deterministic import DeterministicCell

pytestmark = pytest.mark.wire  # not on a port, but alone on the computer: its time is told


def whole_job() -> tuple[list[object], str]:
    """Everything that the store holds of the job of seed 1, and how fast it ran."""
    cell, cpu_s = DeterministicCell(seed=1), time.process_time()
    assert cell.run() is State.COMPLETED
    cpu_s = time.process_time() - cpu_s
    run, store = cell.store.runs(1)[0], cell.store
    records = [run, *store.plans(run.id), *store.samples(run.id), *store.results(run.id), *store.events()]
    simulated_s = cell.world.clock.now_s()
    cell.close()
    speed = (
        f"simulated {simulated_s:.0f} s / wall {cell.wall_s:.1f} s = {simulated_s / cell.wall_s:.0f}; "
        f"/ CPU {cpu_s:.1f} s = {simulated_s / cpu_s:.0f}; load {os.getloadavg()[0]:.1f}"
    )
    return [asdict(record) for record in records], speed


def test_one_seed_is_one_job(record_property: Callable[[str, object], None]) -> None:
    """Asserts no time: other work on the computer must not fail a test. `conftest.py` prints the property.

    The second run is told: the first also loads the compiled parts of the libraries.
    """
    first, _ = whole_job()
    second, speed = whole_job()
    assert first == second
    record_property("deterministic cell", speed)


def test_a_thousand_joint_and_range_samples_a_second() -> None:
    """Of CPU time, which other work on the computer does not take; four times as many are usual."""
    bench = Bench()
    bench.samples_per_s(200)  # the compiled parts are loaded now
    assert bench.samples_per_s(1000) > 1000
