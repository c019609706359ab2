"""Data sets of pairs: poses of the arm, and what the sensor reports: poses of an object, or its own moves."""

from collections.abc import Iterator
from math import radians
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import Field

from controller.offline.dataset_parts import (
    Index,
    Matrix,
    MotionDataset,
    Noise,
    Part,
    PoseStd,
    Wrong,
    beyond,
    unequal,
)
from controller.quantities import Angle
from estimation.tasks.pairs import PairTask
from estimation.tasks.registry import PAIR_TASKS


class PoseNoise(PoseStd):
    """Standard deviation of what the sensor reports, independent of the others: along and about each axis."""

    position_m: Noise
    """Along each axis."""
    rotation_rad: Angle = Field(gt=0, le=radians(20))
    """About each axis."""


class Seen(Part):
    """Poses of the object as the sensor reports them."""

    target: Literal["sensor"]
    """Frame that the matrices map to."""
    source: Literal["object"]
    """Frame that the matrices map from."""
    matrices: Annotated[tuple[Matrix, ...], Field(min_length=1)]
    """Matrices sensor_T_object, 4 x 4, one for each pose of the arm."""
    noise: PoseNoise


class Moves(Part):
    """Moves of the sensor as it reports them, from one pose of the arm to another."""

    target: Literal["first"]
    """Frame that the matrices map to: the sensor before."""
    source: Literal["second"]
    """Frame that the matrices map from: the sensor after."""
    first: Annotated[tuple[Index, ...], Field(min_length=1)]
    """The pose before each move, counted from 0."""
    second: tuple[Index, ...]
    """The pose after each move, counted from 0."""
    matrices: tuple[Matrix, ...]
    """Matrices first_T_second, 4 x 4."""
    noise: PoseNoise


class PairDataset(MotionDataset):
    """Pairs of what the arm and what the sensor reports."""

    def reported(self) -> dict[str, Any]:
        """What the sensor reports, as arguments of the problem."""
        raise NotImplementedError

    def problem(self) -> PairTask:
        return PAIR_TASKS[self.task](motion=self.motion.motion(self.units), **self.reported())


class PosePairsDataset(PairDataset):
    """A sensor sees the pose of an object at each pose of the arm."""

    seen: Seen

    def wrong(self) -> Iterator[Wrong]:
        yield from super().wrong()
        yield from unequal(("seen", "matrices"), len(self.seen.matrices), len(self.motion), "pose")

    def reported(self) -> dict[str, Any]:
        return {
            "sensor_T_object": self.units.matrices(self.seen.matrices),
            "std_m": self.seen.noise.position_m,
            "std_rad": self.seen.noise.rotation_rad,
        }


class MovePairsDataset(PairDataset):
    """A sensor reports how it moved from one pose of the arm to another."""

    moves: Moves

    def wrong(self) -> Iterator[Wrong]:
        yield from super().wrong()
        count = len(self.moves.first)
        for key in ("second", "matrices"):
            yield from unequal(("moves", key), len(getattr(self.moves, key)), count, "move")
        for key in ("first", "second"):
            yield from beyond(("moves", key), getattr(self.moves, key), len(self.motion), "poses")

    def reported(self) -> dict[str, Any]:
        return {
            "first": np.array(self.moves.first, dtype=np.intp),
            "second": np.array(self.moves.second, dtype=np.intp),
            "first_T_second": self.units.matrices(self.moves.matrices),
            "std_m": self.moves.noise.position_m,
            "std_rad": self.moves.noise.rotation_rad,
        }


PAIR_DATASETS: Final[dict[str, type[PairDataset]]] = {
    "pose-pairs": PosePairsDataset,
    "pose-pairs-beside": PosePairsDataset,
    "move-pairs": MovePairsDataset,
}
