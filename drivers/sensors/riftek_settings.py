"""What the drivers of a RIFTEK head have in common: settings, identity check, and readings from codes."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.capabilities import Identity, RangeReadings
from drivers.sensors import riftek_codec as codec
from drivers.sensors.windows import can_freeze, refuse_frozen
from estimation.errors import IdentityMismatch
from estimation.transform import FloatArray

BITS_PER_BYTE: Final = 11  # 8E1
FRAMING: Final = "8E1"


@dataclass(frozen=True, slots=True)
class RiftekConfig:
    """Settings of one head. Distances are from its base surface: base distance plus result."""

    base_m: float  # distance of the start of the range
    range_m: float
    serial_number: str = ""  # compared if given; base distance and range always
    address: int = 1
    baud: int = 9600
    rate_hz: float = 200.0  # results per second
    averages: int = 1  # samples in one result
    noise_m: float = 0.0  # of one result; 0 switches the search for a frozen value off
    no_target_codes: tuple[int, ...] = (0,)  # not in the manual: what a head sends when it sees nothing
    first_register: int = 1  # address on the wire of the manual's register 1, which the manual does not say
    worst_answer_s: float = 0.1  # nor how long an answer may take
    silence_s: float = 0.25  # of a stream, after which the line counts as dead
    stale_s: float = 0.02  # results may lie so long in the converter
    echo: bool = False  # two-wire RS-485: what is sent comes back

    @property
    def period_us(self) -> int:
        """Sampling period as the head takes it."""
        return round(1e6 / self.rate_hz)

    @property
    def result_s(self) -> float:
        """A result read so long after an instant was measured after it."""
        return (self.averages + 1) * self.period_us * 1e-6


def compare(config: RiftekConfig, head: codec.Head) -> Identity:
    """Another head, or another range, voids the calibration. Raises IdentityMismatch."""
    told = (
        ("serial number", str(head.serial_number), config.serial_number or str(head.serial_number)),
        ("base distance", f"{head.base_mm} mm", f"{config.base_m * 1e3:g} mm"),
        ("range", f"{head.range_mm} mm", f"{config.range_m * 1e3:g} mm"),
    )
    for what, answer, expected in told:
        if answer != expected:
            raise IdentityMismatch(
                f"Laser: its {what} is {answer}, the cell file says {expected}",
                "Connect the sensor that was calibrated, or correct the cell file and calibrate again",
            )
    settings = (
        ("base_mm", str(head.base_mm)),
        ("range_mm", str(head.range_mm)),
        ("rate_hz", f"{config.rate_hz:g}"),
        ("averages", str(config.averages)),
    )
    return Identity(f"RIFTEK type {head.device_type}", str(head.serial_number), str(head.firmware), settings)


def readings(config: RiftekConfig, codes: codec.CodeArray, time_s: FloatArray) -> RangeReadings:
    """Distances of results (n,). Raises DeviceError if the sensor is frozen."""
    seen = ~np.isin(codes, config.no_target_codes)
    inside = codes <= codec.FULL_RANGE
    good = seen & inside
    kinds = tuple[str, ...]()
    if not seen.all():
        kinds += ("no target",)
    if not inside.all():
        kinds += ("beyond the measuring range",)
    distance_m = config.base_m + codec.distances(codes[good], config.range_m)
    if can_freeze(config.noise_m / math.sqrt(config.averages), codec.resolution(config.range_m)):
        refuse_frozen(distance_m)
    return RangeReadings(time_s[good], distance_m, int(codes.size - np.count_nonzero(good)), kinds)
