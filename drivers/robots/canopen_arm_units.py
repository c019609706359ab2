"""Between radians and the drives' counts: targets, limits, and the joints at an instant."""

import math
from collections.abc import Sequence

import numpy as np

from drivers.capabilities import Contact
from drivers.robots.canopen_arm_setup import ArmConfig
from drivers.robots.canopen_master import Sample
from drivers.robots.joint_limits import within_limits
from drivers.robots.motion_profile import synchronize
from estimation.errors import DeviceError
from estimation.transform import FloatArray


class JointUnits:
    """Units and limits of one arm.

    `window` is the in-position window in counts; two readings of one place may differ by `apart`, because
    each has its noise.
    """

    def __init__(self, config: ArmConfig) -> None:
        self._counts_per_rad = config.counts_per_rad
        self._lower, self._upper = np.array(config.lower_rad), np.array(config.upper_rad)
        self._acceleration_limit = np.array(config.acceleration_limit_rad_s2)
        self.window = max(1, round(config.in_position_rad * config.counts_per_rad))
        self.apart = math.ceil(math.sqrt(2.0) * self.window)

    def counts(self, target_rad: FloatArray) -> list[int]:
        """A target (joints,) in counts. Raises DeviceError outside the joint limits."""
        target = within_limits(target_rad, self._lower, self._upper)
        return [round(float(angle) * self._counts_per_rad) for angle in target]

    def move(
        self, present: Sequence[int], target: Sequence[int], speed_limit_rad_s: FloatArray
    ) -> tuple[list[int], list[int], float]:
        """A synchronized move: velocity and acceleration of each joint in counts, and the duration in s."""
        # Where a joint stands is known to its reading noise only: one that seems to be there already may
        # have some counts to go, and must not be told to crawl them.
        counts = np.maximum(np.abs(np.array(target) - np.array(present)), self.window)
        move = synchronize(counts / self._counts_per_rad, speed_limit_rad_s, self._acceleration_limit)
        # Rounded up: a joint that moves a few counts only must not arrive late.
        velocity = [max(1, math.ceil(v * self._counts_per_rad)) for v in move.velocity]
        acceleration = [max(1, math.ceil(a * self._counts_per_rad)) for a in move.acceleration]
        return velocity, acceleration, move.duration_s

    def contact_at(self, time_s: float, samples: Sequence[Sample], late_s: float) -> Contact:
        """The joints on the line between the samples before and after an instant, `late_s` as late at most.

        The variance of their mean is (1 - p)^2 + p^2 of one reading, p being the share of the later sample.
        """
        after = next((i for i, s in enumerate(samples) if s.time_s >= time_s), len(samples) - 1)
        late, early = samples[after], samples[max(after - 1, 0)]
        span_s = late.time_s - early.time_s
        part = min(max((time_s - early.time_s) / span_s, 0.0), 1.0) if span_s > 0.0 else 1.0
        counts = (1.0 - part) * np.array(early.counts) + part * np.array(late.counts)
        readings = 1.0 / ((1.0 - part) ** 2 + part**2)
        return Contact(np.asarray(counts / self._counts_per_rad, dtype=np.float64), readings, late_s)

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
