"""A cell directory and its parsed world, shared by the tests of the simulators."""

from pathlib import Path

import numpy as np
import pytest

from simulators.robots.canopen_arm import SimulatedArm
from simulators.world.truth import Truth, draw_truth, stream
from simulators.world.world_file import WorldFile, read_world_file
from tests.simulators.can_master import Master

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


@pytest.fixture
def arm(world_file: WorldFile) -> SimulatedArm:
    return SimulatedArm(world_file.arm, stream(1, "test"), np.zeros(6))


@pytest.fixture
def master(arm: SimulatedArm) -> Master:
    return Master(arm)
