"""Six joints over an slcan dongle at the cell's SYNC period: how regularly the readings come.

    python -m benchmarks.slcan_sync [seconds]

The drives are simulated in a process of their own, behind a pseudo-terminal. A gap is the time from one
complete reading of all joints (the SYNC that it answers) to the next one.
"""

import gc
import os
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.simulated import simulated_device
from controller.cellfile import load_cell
from controller.cellfile.robots import CanopenRobot
from controller.demo_cell import BENCH_BLOCK
from controller.robots import make_robot
from drivers.clock import RealClock
from drivers.links.ports import RealPorts
from estimation.transform import FloatArray

BLOCK: Final = 50  # readings asked for at a time


@dataclass(frozen=True, slots=True)
class Regularity:
    """Gaps between readings (n,), s, at the period that was set; what reading cost, of one core."""

    period_s: float
    gaps_s: FloatArray
    bad_frames: int
    cpu_share: float

    def __str__(self) -> str:
        levels = " ".join(f"{q:g} %: {np.percentile(self.gaps_s, q) * 1e3:.1f}" for q in (1, 50, 99, 99.9))
        return (
            f"{len(self.gaps_s) + 1} readings of six joints in {self.gaps_s.sum():.1f} s, SYNC every "
            f"{self.period_s * 1e3:.0f} ms; gaps in ms: {levels}, longest {self.gaps_s.max() * 1e3:.1f}; "
            f"bad frames {self.bad_frames}, CPU {self.cpu_share:.1%} of a core; {os.cpu_count()} cores, load "
            f"{os.getloadavg()[0]:.1f}"
        )


def regularity(duration_s: float) -> Regularity:
    """Read all joints for so long."""
    robot = load_cell(BENCH_BLOCK).robot
    if not isinstance(robot, CanopenRobot):
        raise TypeError(f"The cell has a {robot.driver}")
    with (
        tempfile.TemporaryDirectory() as folder,
        simulated_device("canopen-402", Path(folder, "run/arm"), {}),
    ):
        clock = RealClock()
        arm = make_robot(robot, RealPorts(Path(folder), clock), clock)
        gc.collect()
        gc.freeze()  # as `truecell serve` does
        arm.connect()
        try:
            times_s = list[float]()
            began_s, cpu_s = clock.now_s(), time.process_time()
            while clock.now_s() < began_s + duration_s:
                times_s += arm.read_joints(BLOCK).time_s.tolist()
            cpu_share = (time.process_time() - cpu_s) / (clock.now_s() - began_s)
            return Regularity(robot.sync_period_s, np.diff(times_s), arm.health().bad_frames, cpu_share)
        finally:
            arm.close()


if __name__ == "__main__":
    print(regularity(float(sys.argv[1]) if len(sys.argv) > 1 else 60.0))
