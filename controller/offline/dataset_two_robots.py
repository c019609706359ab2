"""The data set of two robots: two whole data sets, in which each has measured the same object."""

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field

from controller.offline.dataset_pairs import PosePairsDataset
from controller.offline.dataset_parts import Dataset, Wrong
from controller.offline.dataset_tasks import Camera, PointLaserOnPlanes, TouchOnPlanes
from estimation.tasks.pairs import PosePairs
from estimation.tasks.solve import Result
from estimation.tasks.two_robots import TwoRobots, join


class ByLaser(PointLaserOnPlanes):
    """Faces of a part by a point laser."""

    task: Literal["point-laser-planes"]


class ByTouch(TouchOnPlanes):
    """Faces of a part by a stylus."""

    task: Literal["touch-planes"]


class ByCamera(Camera):
    """Markers by a camera."""

    task: Literal["camera-hand-eye"]


class ByPoses(PosePairsDataset):
    """Poses of an object."""

    task: Literal["pose-pairs"]

    def measured(self) -> PosePairs:
        """The problem of this robot alone."""
        return PosePairs(motion=self.motion.motion(self.units), **self.reported())


Half = Annotated[ByLaser | ByTouch | ByCamera | ByPoses, Field(discriminator="task")]


class TwoRobotsDataset(Dataset):
    """The measurements of either robot."""

    first: Half
    """Data set of the first robot: its base becomes base1."""
    second: Half
    """Data set of the second robot: its base becomes base2."""
    same_sensor: bool = False
    """One sensor was carried from one robot to the other: its scale, offset or ball are one unknown."""

    def wrong(self) -> Iterator[Wrong]:
        yield from super().wrong()
        for name, half in (("first", self.first), ("second", self.second)):
            for path, problem, remedy in half.wrong():
                yield (name, *path), problem, remedy

    def problem(self) -> TwoRobots:
        """The problem for `estimation.tasks.two_robots.join`, in SI."""
        first, second = self.first.measured(), self.second.measured()
        return TwoRobots(first=first, second=second, same_sensor=self.same_sensor)

    def solved(self) -> Result:
        return join(self.problem())
