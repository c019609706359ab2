"""Between radians and the drives' counts: targets, limits, and the joints at an instant."""

import math
from collections.abc import Sequence

import numpy as np

from drivers.canopen_arm_setup import ArmConfig
from drivers.canopen_master import Sample
from estimation.errors import DeviceError
from estimation.transform import FloatArray


class JointUnits:
    """Units and limits of one arm. `window` is the in-position window in counts."""

    def __init__(self, config: ArmConfig) -> None:
        self._counts_per_rad = config.counts_per_rad
        self._lower, self._upper = np.array(config.lower_rad), np.array(config.upper_rad)
        self.window = max(1, round(config.in_position_rad * config.counts_per_rad))

    def counts(self, target_rad: FloatArray) -> list[int]:
        """A target (joints,) in counts. Raises DeviceError outside the joint limits."""
        target = np.asarray(target_rad, dtype=np.float64)
        if target.shape != self._lower.shape or not np.isfinite(target).all():
            raise DeviceError(
                f"Joint target of shape {target.shape} with values {target}",
                f"Give {len(self._lower)} finite angles",
            )
        outside = np.flatnonzero((target < self._lower) | (target > self._upper))
        if outside.size:
            i = int(outside[0])
            low, value, high = np.degrees((self._lower[i], target[i], self._upper[i]))
            raise DeviceError(
                f"Target of joint {i + 1} is {value:.3f} deg, limits {low:.3f} to {high:.3f} deg",
                "Choose a pose inside the joint limits",
            )
        return [round(float(angle) * self._counts_per_rad) for angle in target]

    def joints_at(self, time_s: float, samples: Sequence[Sample]) -> FloatArray:
        """Joints (joints,) rad, on the line between the samples before and after an instant."""
        after = next((i for i, s in enumerate(samples) if s.time_s >= time_s), len(samples) - 1)
        late, early = samples[after], samples[max(after - 1, 0)]
        span_s = late.time_s - early.time_s
        part = min(max((time_s - early.time_s) / span_s, 0.0), 1.0) if span_s > 0.0 else 1.0
        counts = (1.0 - part) * np.array(early.counts) + part * np.array(late.counts)
        return np.asarray(counts / self._counts_per_rad, dtype=np.float64)

    def not_at_target(self, counts: Sequence[int], target: Sequence[int]) -> DeviceError:
        """The error of a move that ended elsewhere, by its worst joint."""
        degrees = math.degrees(1.0 / self._counts_per_rad)
        errors = [abs(now - wanted) for now, wanted in zip(counts, target, strict=True)]
        worst = max(range(len(errors)), key=errors.__getitem__)
        return DeviceError(
            f"Joint {worst + 1} is at {counts[worst] * degrees:.3f} deg instead of "
            f"{target[worst] * degrees:.3f} deg, window {self.window * degrees:.3f} deg",
            "Check for an obstacle, the payload and the speed, then reset",
        )
