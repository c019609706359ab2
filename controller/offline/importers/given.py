"""What files of other programs do not say, and the user must: the mounting, the noise of arm and sensor."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import radians
from typing import Any, Final

from controller import quantities
from controller.offline.importers.names import Mounting
from controller.offline.importers.yaml_tree import Tree
from controller.offline.refusal import BadInput
from estimation.transform import FloatArray

_LARGEST: Final = {quantities.LENGTH.name: (0.1, "100 mm"), quantities.ANGLE.name: (radians(20.0), "20 deg")}
_POSE: Final = (quantities.LENGTH, quantities.ANGLE)


@dataclass(frozen=True, slots=True)
class Given:
    """Options of the command; None where they were left out."""

    mounting: Mounting | None = None
    arm_noise: str | None = None
    sensor_noise: str | None = None

    def mounting_in(self, place: Tree, said: Mounting | None) -> Mounting:
        """The mounting; `said` is what the file says. Raises BadInput where nobody does, or both differ."""
        if said is None and self.mounting is None:
            raise BadInput(
                f"{place.file} does not say where the sensor is",
                "Write --mounting eye-in-hand (sensor on the arm) or eye-to-hand (beside it)",
            )
        if said is not None and self.mounting not in (None, said):
            raise place.refusal(f"this says {said}, --mounting says {self.mounting}", "Mend one of them")
        return said or self.mounting or Mounting.EYE_IN_HAND

    def arm_std(self, file: str) -> dict[str, str]:
        """Standard deviation of poses of the arm, as in a data set."""
        position, rotation = _quantities("--arm-noise", self.arm_noise, file, "the poses of the arm", _POSE)
        return {"position": position, "rotation": rotation}

    def sensor_std(self, file: str) -> dict[str, str]:
        """Standard deviation of poses that the sensor reports, as in a data set."""
        given = _quantities("--sensor-noise", self.sensor_noise, file, "the poses that the sensor saw", _POSE)
        return {"position": given[0], "rotation": given[1]}

    def point_std(self, file: str) -> list[str]:
        """Standard deviation of points that the sensor reports, along its x, y and z."""
        count = 3 if self.sensor_noise is not None and "," in self.sensor_noise else 1
        wanted = (quantities.LENGTH,) * count
        given = _quantities(
            "--sensor-noise", self.sensor_noise, file, "the points that the sensor saw", wanted
        )
        return given * (3 // count)


def _quantities(
    option: str, text: str | None, file: str, what: str, wanted: Sequence[quantities.Dimension]
) -> list[str]:
    """The parts of an option. Raises BadInput: missing, of another kind, negative, too large."""
    example = ", ".join("0.05 mm" if each is quantities.LENGTH else "0.01 deg" for each in wanted)
    remedy = f'Write {option} "{example}", standard deviations along and about each axis'
    if text is None:
        raise BadInput(f"{file} does not say how well {what} are known", remedy)
    parts = [part.strip() for part in text.split(",")]
    if len(parts) != len(wanted):
        raise BadInput(f'{option} "{text}": {len(parts)} values, must be {len(wanted)}', remedy)
    for part, dimension in zip(parts, wanted, strict=True):
        try:
            value = quantities.parse(part, dimension)
        except quantities.QuantityError as error:
            raise BadInput(f"{option}: {error.problem}", error.remedy) from error
        largest, shown = _LARGEST[dimension.name]
        if not 0.0 <= value <= largest or (value == 0.0 and option == "--sensor-noise"):
            raise BadInput(f"{option}: {part} is out of bounds, at most {shown} and not negative", remedy)
    return parts


def pair_set(
    file: str, mounting: Mounting, arm: Sequence[FloatArray], seen: Sequence[FloatArray], given: Given
) -> dict[str, Any]:
    """The data set of poses base_T_flange and sensor_T_object, metres."""
    return {
        "truecell_dataset": 1,
        "task": "pose-pairs" if mounting is Mounting.EYE_IN_HAND else "pose-pairs-beside",
        "about": f"From {file}",
        "units": {"length": "m", "angle": "rad"},
        "motion": motion(arm, given.arm_std(file)),
        "seen": {
            "target": "sensor",
            "source": "object",
            "noise": given.sensor_std(file),
            "matrices": [pose.tolist() for pose in seen],
        },
    }


def motion(arm: Sequence[FloatArray], noise: dict[str, str]) -> dict[str, Any]:
    """Poses base_T_flange as in a data set."""
    return {
        "kind": "poses",
        "target": "base",
        "source": "flange",
        "noise": noise,
        "matrices": [pose.tolist() for pose in arm],
    }
