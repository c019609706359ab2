"""One measurement as it is stored: what was read, from whom, when, and how good it is."""

from dataclasses import asdict, dataclass
from typing import Any

from drivers.capabilities import Quality


@dataclass(frozen=True, slots=True)
class Sample:
    """Joints and sensor read together at one standstill, or joints at one contact. SI units."""

    step: str  # id of the step in the plan
    kind: str  # "laser", "touch" or "reference"
    object: str  # "plate", "bar", "sphere", "part"
    feature: str  # of that object
    joints_rad: tuple[float, ...]  # mean over the readings
    joint_scatter_rad: tuple[float, ...]  # standard deviation of one reading, each joint
    joint_readings: float  # averaged; of a touch, as noisy as so many
    reading_m: float  # laser: mean distance; touch: 0; nan is never stored, see quality
    reading_scatter_m: float  # laser: of one cycle; touch: way of the ball between the polls that saw it
    readings: int
    quality: str
    why: str  # why the quality is not good, in words
    source_time_s: float  # middle of the window, on the daemon's monotonic clock
    utc_s: float  # receive time, for the record

    @property
    def good(self) -> bool:
        """Only good samples enter an estimate."""
        return self.quality == Quality.GOOD.value

    def to_dict(self) -> dict[str, Any]:
        """For the store."""
        return asdict(self)

    @staticmethod
    def from_dict(data: dict[str, Any]) -> "Sample":
        """Inverse of `to_dict`, also after JSON made tuples lists."""
        listed: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in data.items()
        }
        return Sample(**listed)
