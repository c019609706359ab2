"""Joint-and-range samples a second of CPU time: drivers, protocols and simulators in the deterministic cell.

.venv/bin/python -m benchmarks.sample_rate
"""

import time
from pathlib import Path

import numpy as np

from controller.acquisition import Acquisition
from controller.cellfile import load_cell
from controller.devices import make_devices
from controller.planning.steps import Step
from simulators.virtual import SimulatedCell

CELL = Path(__file__).parents[1] / "cells" / "bench-block"
SAMPLES = 2000
MEASUREMENTS = 300


class Bench:
    """The cell at rest over its plate, connected."""

    def __init__(self) -> None:
        self.cell, self.world = load_cell(CELL), SimulatedCell(CELL, seed=1)
        self.devices = make_devices(self.cell, self.world.ports, self.world.clock, keep_alive_thread=False)
        for device in self.devices.all():
            device.connect()

    def samples_per_s(self, count: int = SAMPLES) -> float:
        """One reading of six joints and one window of the laser each, all fresh."""
        robot, laser = self.devices.robot, self.devices.laser
        begun_s = time.process_time()
        for _ in range(count):
            laser.begin_window()
            robot.read_joints(1)
            laser.end_window(1)
        return count / (time.process_time() - begun_s)

    def measurements_per_s(self, count: int = MEASUREMENTS) -> float:
        """As a job takes them: settled, several readings of the joints, mean and scatter of the ranges."""
        acquisition = Acquisition(self.cell, self.cell.robot.arm_model(), self.devices, self.world.clock)
        here = self.devices.robot.read_joints(1).joints_rad[0]
        step = Step("here", "laser", "plate", "", tuple(np.asarray(here).tolist()))
        begun_s = time.process_time()
        for _ in range(count):
            acquisition._measure_range(step)
        return count / (time.process_time() - begun_s)


def main() -> None:
    """Print both."""
    bench = Bench()
    bench.samples_per_s(200)  # compiled and cached now
    print(f"joint-and-range samples: {bench.samples_per_s():.0f} per second of CPU")
    print(f"measurements of a job, without the moves: {bench.measurements_per_s():.0f} per second of CPU")


if __name__ == "__main__":
    main()
