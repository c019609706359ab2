"""How much faster than real time one whole job runs in the deterministic cell; shown after the tests."""

from collections.abc import Callable

from controller.packml import State
from tests.support.deterministic import DeterministicCell


def test_a_whole_job_runs_and_shows_its_speed(record_property: Callable[[str, object], None]) -> None:
    """Asserts no time: other work on the computer must not fail a test. `conftest.py` prints the property."""
    cell = DeterministicCell(seed=1)
    assert cell.run() is State.COMPLETED
    simulated_s = cell.world.clock.now_s()
    cell.close()
    speed = f"simulated {simulated_s:.0f} s / wall {cell.wall_s:.1f} s = {simulated_s / cell.wall_s:.0f}"
    record_property("deterministic cell", speed)
