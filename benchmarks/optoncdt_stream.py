"""The optoNCDT's fastest stream over a pseudo-terminal: values lost, and what reading them costs.

    python -m benchmarks.optoncdt_stream [seconds]

The simulated sensor, in a process of its own, sees a target that runs through its range again and again, so
that a value tells its number. It leaves out the time in which its own process could not run; the duration
is therefore that of the values, not of the clock.
"""

import os
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.simulated import simulated_device
from drivers.clock import RealClock
from drivers.links.serial_port import SerialLink
from drivers.sensors.optoncdt import LaserConfig, OptoncdtLaser
from estimation.transform import FloatArray

RATE_HZ: Final = 8000.0
RAMP_S: Final = 2.0  # 16,000 values through the range: four steps of the resolution apart
RANGE_M: Final = 0.1
SILENCE_S: Final = 5.0  # on a busy computer the simulator may stand still: what is late is not lost
SETTINGS: Final = {"range_start_mm": 50.0, "range_mm": RANGE_M * 1e3, "clock_drift": 0.0, "period_s": RAMP_S}


@dataclass(frozen=True, slots=True)
class Stream:
    """What one run saw. `cpu_share` is of one core, of all threads of the reading process."""

    values: int
    lost: int
    bad_frames: int
    clock_s: float
    cpu_share: float

    def __str__(self) -> str:
        return (
            f"{self.values} values ({self.values / RATE_HZ:.1f} s of stream) in {self.clock_s:.1f} s, "
            f"lost {self.lost}, bad frames {self.bad_frames}, CPU {self.cpu_share:.1%} of a core; "
            f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
        )


def missing(distance_m: FloatArray) -> int:
    """How many values are missing among consecutive ones (n,) of the rising target."""
    ramp_values = RAMP_S * RATE_HZ
    number = np.rint((np.diff(distance_m) / RANGE_M) % 1.0 * ramp_values)
    return int(np.sum((number - 1) % ramp_values))


def stream(duration_s: float) -> Stream:
    """Read so many seconds of stream, a second at a time and without a gap."""
    with tempfile.TemporaryDirectory() as folder:
        port = Path(folder) / "laser"
        with simulated_device("optoncdt-1420", port, SETTINGS):
            return _read(port, round(duration_s))


def _read(port: Path, seconds: int) -> Stream:
    config = LaserConfig(
        range_m=RANGE_M,
        range_start_m=0.05,
        rate_hz=RATE_HZ,
        noise_m=1e-5,
        silence_s=SILENCE_S,
    )
    laser = OptoncdtLaser(SerialLink(str(port), config.baud), config, RealClock())
    laser.connect()
    try:
        laser.begin_window()
        values, lost, last = 0, 0, np.empty(0)
        clock_s, cpu_s = time.monotonic(), time.process_time()
        while values < seconds * RATE_HZ:
            readings = laser.end_window(int(RATE_HZ))
            # The very start of the range is a value that the driver rejects: missing, but not lost.
            lost += missing(np.concatenate((last, readings.distance_m))) - readings.rejected
            values += readings.distance_m.size + readings.rejected
            last = readings.distance_m[-1:]
        clock_s, cpu_s = time.monotonic() - clock_s, time.process_time() - cpu_s
        return Stream(values, lost, laser.health().bad_frames, clock_s, cpu_s / clock_s)
    finally:
        laser.close()


if __name__ == "__main__":
    print(stream(float(sys.argv[1]) if len(sys.argv) > 1 else 60.0))
