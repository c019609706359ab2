"""A cell directory and its parsed world, shared by the tests of the simulators."""

from pathlib import Path

import pytest

from simulators.truth import Truth, draw_truth
from simulators.world_file import WorldFile, read_world_file

CELL = Path(__file__).parents[2] / "cells" / "bench-block"


@pytest.fixture(scope="session")
def cell_dir() -> Path:
    return CELL


@pytest.fixture(scope="session")
def world_file() -> WorldFile:
    return read_world_file(CELL)


@pytest.fixture(scope="session")
def nominal(world_file: WorldFile) -> Truth:
    return draw_truth(world_file, seed=1, error_factor=0.0)
