"""Data sets that calibrate the arm itself: those of any sensor, and what of the arm is to be found."""

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated, Final

import numpy as np
from pydantic import Field

from controller.cellfile.mistakes import nearest
from controller.offline.dataset_parts import Joints, Part, Point, Units, Wrong, unequal
from controller.offline.dataset_tasks import SENSOR_DATASETS, SensorDataset, not_unit
from controller.quantities import Mass
from estimation.kinematics import PARAMETER_NAMES
from estimation.loads import GravityLoad
from estimation.tasks import motion
from estimation.tasks.kinematics import Calibrated, KinematicTask, calibrate
from estimation.tasks.sensing import SensorTask

_PARAMETER: Final = re.compile(rf"({'|'.join(PARAMETER_NAMES)})([1-9][0-9]*)")
LoadMass = Annotated[Mass, Field(ge=0, le=1000)]


class LinkMass(Part):
    """Mass of a link."""

    mass_kg: LoadMass
    """What it weighs."""
    at: Point
    """Its centre of mass, in the frame at the end of the link."""


class Gravity(Part):
    """Masses that make joints yield."""

    payload_kg: LoadMass
    """Mass on the flange."""
    payload_at: Point = (0.0, 0.0, 0.0)
    """Its centre, in the frame of the flange."""
    links: tuple[LinkMass, ...] = ()
    """Mass of each link; left out, the payload alone counts."""
    up: Point = (0.0, 0.0, 1.0)
    """Against gravity, in the frame of the base, of length 1."""

    def load(self, units: Units) -> GravityLoad:
        """In SI."""
        mass = np.array([link.mass_kg for link in self.links]) if self.links else None
        centre = units.lengths([link.at for link in self.links]) if self.links else None
        return GravityLoad(self.payload_kg, units.lengths(self.payload_at), mass, centre, np.array(self.up))


class KinematicDataset(SensorDataset):
    """What the data sets of all sensors have, when the arm is to be calibrated."""

    identify: tuple[str, ...] | None = None
    """Parameters without a `_u` that are to be found, such as theta2; all that the arm has by default."""
    gravity: Gravity | None = None
    """With it, how each joint yields to the torque of gravity is found as well."""

    def measured(self) -> SensorTask:
        measured = super().measured()
        if self.gravity is None or not isinstance(measured.motion, motion.Joints):
            return measured
        return replace(measured, motion=replace(measured.motion, load=self.gravity.load(self.units)))

    def problem(self) -> KinematicTask:
        chosen = None if self.identify is None else tuple(map(_parameter, self.identify))
        return KinematicTask(measured=self.measured(), identify=chosen)

    def solved(self) -> Calibrated:
        return calibrate(self.problem())

    def wrong(self) -> Iterator[Wrong]:
        yield from super().wrong()
        if not isinstance(self.motion, Joints):
            yield (
                ("motion", "kind"),
                "poses say nothing of single joints",
                'write "joints", with arm and angles',
            )
            return
        known = [f"{name}{joint + 1}" for joint in range(len(self.motion.arm)) for name in PARAMETER_NAMES]
        for place, name in enumerate(self.identify or ()):
            if name not in known:
                yield ("identify", place), "not a parameter of the arm", nearest(name, known)
        if self.gravity is not None:
            yield from not_unit(("gravity", "up"), self.gravity.up)
            if self.gravity.links:
                yield from unequal(
                    ("gravity", "links"), len(self.gravity.links), len(self.motion.arm), "joint"
                )


def _parameter(label: str) -> tuple[int, str]:
    match = _PARAMETER.fullmatch(label)
    if match is None:
        raise ValueError(f"{label!r} is no parameter")  # wrong() has refused it
    return int(match[2]) - 1, match[1]


def _with_arm(form: type[SensorDataset]) -> type[KinematicDataset]:
    class WithArm(KinematicDataset, form):  # type: ignore[misc, valid-type]
        """The readings of a sensor, and the arm."""

    return WithArm


KINEMATIC_DATASETS: Final[dict[str, type[KinematicDataset]]] = {
    f"kinematics-{task}": _with_arm(form) for task, form in SENSOR_DATASETS.items()
}
