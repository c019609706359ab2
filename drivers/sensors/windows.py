"""Windows of readings: the values of a sensor, when each arrived, and whether the sensor is alive."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.clock import Clock
from estimation.errors import DeviceError
from estimation.transform import FloatArray

FROZEN_RUN: Final = 20  # identical values in a row: p < 5e-4 where the noise is 0.5 steps or more
FROZEN_NOISE_STEPS: Final = 0.5

Values = NDArray[Any]


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Values (n, ...) in order, and the receive time (n,) of each."""

    values: Values
    time_s: FloatArray


def poll(
    clock: Clock, ask: Callable[[], tuple[float, float]], *, since_s: float, minimum: int, period_s: float
) -> Window:
    """`minimum` values that a sensor measured after `since_s`, each in another period of its own.

    `ask` gives a value and when it was received.
    """
    values, times = list[float](), list[float]()
    for _ in range(max(minimum, 1)):
        clock.sleep(since_s + period_s - clock.now_s())
        since_s = clock.now_s()
        value, received_s = ask()
        values.append(value)
        times.append(received_s)
    return Window(np.array(values), np.array(times))


def can_freeze(noise_m: float, step_m: float) -> bool:
    """Whether equal values in a row are a sign of a frozen sensor: its noise must be visible."""
    return noise_m >= FROZEN_NOISE_STEPS * step_m


def refuse_frozen(distance_m: FloatArray) -> None:
    """Raises DeviceError if FROZEN_RUN consecutive distances are identical."""
    changes = np.flatnonzero(np.diff(distance_m)) + 1
    edges = np.concatenate(([0], changes, [distance_m.size]))
    runs = np.diff(edges)
    if distance_m.size and runs.max() >= FROZEN_RUN:
        frozen_m = float(distance_m[edges[int(runs.argmax())]])
        raise DeviceError(
            f"Laser frozen at {frozen_m * 1e3:.3f} mm: {int(runs.max())} identical values in a row",
            "Restart the sensor, then repeat the reference check",
        )
