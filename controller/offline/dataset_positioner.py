"""Data sets of a two-axis positioner: its angles, and points of an object on its table."""

from collections.abc import Iterator
from math import radians
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import Field

from controller.offline.dataset_parts import (
    Dataset,
    Index,
    Noise,
    Part,
    Point,
    Std,
    Units,
    Wrong,
    beyond,
    unequal,
)
from controller.offline.dataset_tasks import FacesOfPart, MarkersOfObject, Radius, not_unit
from controller.quantities import Angle
from estimation.tasks.camera import beam_covariance
from estimation.tasks.positioner import PositionerTask
from estimation.tasks.positioner_result import Positioned, calibrate_axes
from estimation.tasks.registry import POSITIONER_TASKS
from estimation.tasks.turning import Turning


class Turns(Part):
    """Angles of the positioner."""

    kind: Literal["positioner"]
    angles: Annotated[tuple[tuple[float, float], ...], Field(min_length=1)]
    """Of axis 1, which stands, and of axis 2, which it carries; one row for each pose of the table."""
    noise_rad: Angle = Field(ge=0, le=radians(3))
    """Standard deviation of each angle, independent of the others."""

    def motion(self, units: Units) -> Turning:
        """In SI."""
        return Turning(units.angles(self.angles), self.noise_rad)


class PositionerDataset(Dataset):
    """Points in a frame that stands: the base of a robot, or a tracker."""

    units: Units
    motion: Turns
    points: Annotated[tuple[Point, ...], Field(min_length=1)]
    """Points of the object, all in one frame that stands."""
    pose: tuple[Index, ...]
    """The pose of the table of each point, counted from 0."""
    noise_m: Noise
    """Standard deviation of a point in every direction."""
    angle_noise_rad: Angle = Field(default=0.0, ge=0, le=0.01)
    """Standard deviation of the direction of a beam from the origin, for points of a tracker."""
    up: Point = (0.0, 0.0, 1.0)
    """Against gravity in the frame of the points, of length 1."""

    def problem(self) -> PositionerTask:
        """In SI."""
        return POSITIONER_TASKS[self.task](**self.arguments())

    def solved(self) -> Positioned:
        return calibrate_axes(self.problem())

    def arguments(self) -> dict[str, Any]:
        """Of the problem."""
        points = self.units.lengths(self.points)
        return {
            "motion": self.motion.motion(self.units),
            "points_m": points,
            "pose_index": np.array(self.pose, dtype=np.intp),
            "covariance": beam_covariance(points, self.noise_m, self.angle_noise_rad),
            "up": np.array(self.up),
        }

    def wrong(self) -> Iterator[Wrong]:
        yield from super().wrong()
        yield from unequal(("pose",), len(self.pose), len(self.points), "point")
        yield from beyond(("pose",), self.pose, len(self.motion.angles), "poses")
        yield from not_unit(("up",), self.up)


class _Points(MarkersOfObject, PositionerDataset):
    def arguments(self) -> dict[str, Any]:
        return {**super().arguments(), **self.of_markers()}

    def wrong(self) -> Iterator[Wrong]:
        yield from super().wrong()
        yield from self.wrong_markers(len(self.points))


class _Touched(PositionerDataset):
    ball_radius_m: Radius | None = None
    """Radius of the ball whose centres the points are; left out for points on the surface itself."""
    ball_radius_u_m: Std = 0.0
    """Standard uncertainty of it, pre-travel included."""

    def wrong(self) -> Iterator[Wrong]:
        yield from super().wrong()
        if self.ball_radius_u_m and self.ball_radius_m is None:
            yield ("ball_radius_u",), "there is no ball_radius", "write ball_radius, or leave both out"

    def arguments(self) -> dict[str, Any]:
        ball = {"ball_radius_m": self.ball_radius_m or 0.0, "ball_std_m": self.ball_radius_u_m}
        return {**super().arguments(), **ball}


class _OnSphere(_Touched):
    radius_m: Radius
    """Radius of the sphere."""
    radius_u_m: Std = 0.0
    """Standard uncertainty of its certificate."""

    def arguments(self) -> dict[str, Any]:
        return {**super().arguments(), "radius_m": self.radius_m, "radius_std_m": self.radius_u_m}


class _OnPlanes(FacesOfPart, _Touched):
    def arguments(self) -> dict[str, Any]:
        return {**super().arguments(), **self.of_faces()}

    def wrong(self) -> Iterator[Wrong]:
        yield from super().wrong()
        yield from self.wrong_faces(len(self.points), "point")


POSITIONER_DATASETS: Final[dict[str, type[PositionerDataset]]] = {
    "positioner": _Points,
    "positioner-sphere": _OnSphere,
    "positioner-planes": _OnPlanes,
}
