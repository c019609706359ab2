"""The data set of a localization: points on named features of an object."""

from collections.abc import Iterator
from math import pi
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from controller.cellfile.tables import Name
from controller.offline.dataset_parts import (
    Dataset,
    Matrix,
    Noise,
    Part,
    Point,
    PoseStd,
    Std,
    Units,
    Wrong,
    unequal,
)
from controller.offline.dataset_tasks import Radius, not_unit, unknown_names
from controller.quantities import Angle
from estimation.localization.points import SharedError, hand_eye_error
from estimation.localization.task import Localization, localize
from estimation.surfaces import Feature
from estimation.tasks.solve import Result


class FeaturePart(Part):
    """One surface of the object, in the frame of the object."""

    name: Name
    kind: Literal["plane", "sphere", "cylinder", "cone", "torus"]
    point: Point
    """On the plane; centre of sphere or torus; on the axis of the cylinder; apex of the cone."""
    axis: Point = (0.0, 0.0, 1.0)
    """Normal out of the material, or axis (of a cone from the apex into it); of length 1."""
    radius_m: Radius | None = None
    """Of sphere, cylinder, or the tube of a torus."""
    major_radius_m: Radius | None = None
    """Of the circle in the middle of the tube of a torus."""
    half_angle_rad: Annotated[Angle, Field(gt=0, lt=pi / 2)] | None = None
    """Of a cone."""
    outward: bool = True
    """False where the material is around the surface, as around a bore."""
    form_u_m: Std = 0.0
    """Standard deviation by which the surface lies off as a whole."""

    def feature(self, units: Units) -> Feature:
        """In SI."""
        return Feature(
            self.name,
            self.kind,
            tuple(units.lengths(self.point).tolist()),
            self.axis,
            self.radius_m or 0.0,
            self.outward,
            half_angle_rad=self.half_angle_rad or 0.0,
            major_radius_m=self.major_radius_m or 0.0,
        )

    def sizes(self) -> Iterator[tuple[str, bool, bool]]:
        """Key, whether this kind has it, and whether it was given."""
        yield "radius", self.kind in ("sphere", "cylinder", "torus"), self.radius_m is not None
        yield "major_radius", self.kind == "torus", self.major_radius_m is not None
        yield "half_angle", self.kind == "cone", self.half_angle_rad is not None


class HandEye(Part):
    """The error of the mount of the sensor, which all points share."""

    std: PoseStd
    """Standard deviation along and about the axes of the sensor."""
    target: Literal["base"]
    """Frame that the matrices map to."""
    source: Literal["sensor"]
    """Frame that the matrices map from."""
    matrices: Annotated[tuple[Matrix, ...], Field(min_length=1)]
    """Where the sensor was at each point, 4 x 4."""


class LocalizationDataset(Dataset):
    """Points that were measured on an object."""

    units: Units
    frame: Literal["base"]
    """Frame of the points."""
    points: Annotated[tuple[Point, ...], Field(min_length=1)]
    """Points on the object."""
    noise_m: Noise
    """Standard deviation of each coordinate of a point."""
    features: Annotated[tuple[FeaturePart, ...], Field(min_length=1)]
    """Surfaces of the object."""
    feature: tuple[str, ...]
    """Name of the feature of each point."""
    toward_sensor: tuple[Point, ...] | None = None
    """Directions from the points to where they were seen from, in the base; planes alone need them."""
    hand_eye: HandEye | None = None

    def wrong(self) -> Iterator[Wrong]:
        yield from super().wrong()
        names, count = [each.name for each in self.features], len(self.points)
        yield from unequal(("feature",), len(self.feature), count, "point")
        yield from unknown_names(("feature",), self.feature, names)
        if self.toward_sensor is not None:
            yield from unequal(("toward_sensor",), len(self.toward_sensor), count, "point")
        if self.hand_eye is not None:
            yield from unequal(("hand_eye", "matrices"), len(self.hand_eye.matrices), count, "point")
        for place, each in enumerate(self.features):
            yield from not_unit(("features", place, "axis"), each.axis)
            for key, has, given in each.sizes():
                if has != given:
                    problem = f"a {each.kind} has {'a' if has else 'no'} {key.replace('_', ' ')}"
                    yield ("features", place, key), problem, "add it" if has else "remove it"

    def problem(self) -> Localization:
        """The problem for `estimation.localization.task.localize`, in SI."""
        names = [each.name for each in self.features]
        return Localization(
            base_p=self.units.lengths(self.points),
            covariance=self.noise_m**2 * np.eye(3),
            surface=tuple(each.feature(self.units) for each in self.features),
            index=np.array([names.index(name) for name in self.feature], dtype=np.intp),
            shared=() if self.hand_eye is None else (self._shared(self.hand_eye),),
            form_std_m={each.name: each.form_u_m for each in self.features if each.form_u_m},
            toward_sensor=None if self.toward_sensor is None else np.array(self.toward_sensor),
        )

    def solved(self) -> Result:
        return localize(self.problem())

    def _shared(self, hand_eye: HandEye) -> SharedError:
        base_T_sensor = self.units.matrices(hand_eye.matrices)
        from_sensor = self.units.lengths(self.points) - base_T_sensor[:, :3, 3]
        sensor_p = np.einsum("mji,mj->mi", base_T_sensor[:, :3, :3], from_sensor)
        std = np.repeat([hand_eye.std.position_m, hand_eye.std.rotation_rad], 3)
        return hand_eye_error("hand-eye", np.diag(std**2), base_T_sensor[:, :3, :3], sensor_p)
