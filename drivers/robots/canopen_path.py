"""Interpolated position mode (7): the joints follow a path that is given point by point, one for each SYNC.

A drive goes to its set-point (60C1h:01) within the interpolation period (60C2h), which is that of SYNC. RPDO2
carries the set-points while the mode lasts; it carries target and speed again afterwards.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final

import numpy as np

from drivers.clock import Clock
from drivers.links.interfaces import CanLink
from drivers.robots import canopen_arm_codec as codec
from drivers.robots.canopen_arm_setup import ArmConfig, ArmSetup
from drivers.robots.canopen_arm_units import JointUnits
from drivers.robots.canopen_master import CanopenMaster, Sample
from estimation.errors import DeviceError, DeviceTimeout
from estimation.transform import FloatArray

START_TIMEOUT_S: Final = 0.5
ARRIVAL_SYNCS: Final = 25  # after the last point


class PathFollower:
    """Leads all joints along one path. `command` sends a controlword, `sample` waits for the next SYNC."""

    def __init__(
        self,
        link: CanLink,
        clock: Clock,
        config: ArmConfig,
        master: CanopenMaster,
        setup: ArmSetup,
        units: JointUnits,
        command: Callable[[int], None],
        sample: Callable[[], Sample],
    ) -> None:
        self._link, self._clock, self._config = link, clock, config
        self._master, self._setup, self._units = master, setup, units
        self._command, self._sample = command, sample

    def plan(self, path_rad: FloatArray, here: Sequence[int]) -> list[list[int]]:
        """The set-points in counts. Raises DeviceError if a step is too long for a SYNC period.

        `path_rad` (n, joints) begins within the in-position window of where the arm stands, `here`.
        """
        points = [self._units.counts(point) for point in np.atleast_2d(path_rad)]
        period_s = self._config.sync_period_s
        longest = np.array(self._config.speed_limit_rad_s) * self._config.counts_per_rad * period_s
        steps = np.abs(np.diff(np.array([list(here), *points]), axis=0))
        steps[0] = np.maximum(steps[0] - self._units.apart, 0)
        if (steps > longest).any():
            number, joint = np.argwhere(steps > longest)[0]
            counts = np.array([steps[number, joint], longest[joint]])
            degrees = np.degrees(counts / self._config.counts_per_rad)
            raise DeviceError(
                f"Point {number + 1} of the path moves joint {joint + 1} by {degrees[0]:.3f} deg in one SYNC "
                f"period of {period_s * 1e3:g} ms, at its speed limit it moves {degrees[1]:.3f} deg",
                "Begin where the arm stands, and put the points closer together",
            )
        return points

    def follow(self, points: Sequence[Sequence[int]]) -> None:
        """Start at rest and enabled; return at the last point."""
        with self._interpolating(), self._master.foreground():
            self._activate()
            for point in points:
                self._send(point)
                self._sample()
            for _ in range(ARRIVAL_SYNCS):
                sample = self._sample()
                off = [abs(now - wanted) for now, wanted in zip(sample.counts, points[-1], strict=True)]
                if max(off) <= self._units.window:
                    break
            else:
                raise self._units.not_at_target(sample.counts, list(points[-1]))
            self._command(codec.ENABLE)  # bit 4 off: set-points count no more
            self._sample()

    def _activate(self) -> None:
        """Set-points where the arm stands, before bit 4 lets them count."""
        sample = self._sample()
        self._send(sample.counts)
        self._sample()
        self._command(codec.ENABLE | codec.ENABLE_INTERPOLATION)
        deadline_s = self._clock.now_s() + START_TIMEOUT_S
        while not (sample := self._sample()).all_set & codec.INTERPOLATION_ACTIVE:
            if self._clock.now_s() > deadline_s:
                silent = [i for i, w in enumerate(sample.statuswords) if not w & codec.INTERPOLATION_ACTIVE]
                raise DeviceTimeout(
                    f"{self._master.name(silent)} does not interpolate within {START_TIMEOUT_S:g} s",
                    "Reset; if it recurs, check that the drive supports mode 7",
                )

    def _send(self, point: Sequence[int]) -> None:
        for node, counts in zip(self._config.node_ids, point, strict=True):
            self._link.send(codec.RPDO[1] + node, codec.RPDO2_PATH.pack(counts))

    @contextmanager
    def _interpolating(self) -> Iterator[None]:
        """The drives in mode 7, and back in profile position whatever happens."""
        with self._master.foreground():
            self._setup.change_mode(codec.INTERPOLATED_MODE, codec.RPDO2_PATH)
        try:
            yield
        finally:
            with self._master.foreground():
                self._setup.change_mode(codec.PROFILE_POSITION_MODE, codec.RPDO2)
