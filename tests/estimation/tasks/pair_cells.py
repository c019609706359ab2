"""Random cells in which a sensor reports poses of an object, or its own moves."""

import numpy as np

from estimation.tasks.motion import Poses
from estimation.tasks.pairs import MovePairs, PosePairs, PosePairsBeside
from tests.estimation.tasks.cells import Cell, Make
from tests.estimation.tasks.layout import (
    DEG,
    MM,
    POSE_STD,
    USUAL,
    FloatArray,
    Setting,
    anywhere,
    board_views,
    placed,
    reported,
)
from tests.estimation.twin import pose

SENSOR_STD = (0.05 * MM, 0.01 * DEG)


def views(rng: np.random.Generator, setting: Setting, count: int, spin_deg: float = 50.0) -> FloatArray:
    """object_T_sensor (count, 4, 4), that differ by 115 deg at most."""
    return board_views(rng, setting, count, 30.0, spin_deg)


def noisy(rng: np.random.Generator, poses: FloatArray) -> FloatArray:
    """Poses as the sensor reports them."""
    return poses @ pose(rng.normal(size=(len(poses), 6)) * np.repeat(SENSOR_STD, 3))


def pose_pairs(rng: np.random.Generator, count: int = 15, setting: Setting = USUAL) -> Cell:
    motion, truth, seen, _ = placed(rng, setting, views(rng, setting, count), ("sensor", "object"))
    problem = PosePairs(
        motion=motion,
        sensor_T_object=noisy(rng, np.linalg.inv(seen)),
        std_m=SENSOR_STD[0],
        std_rad=SENSOR_STD[1],
    )
    return Cell(problem, truth)


def pose_pairs_beside(rng: np.random.Generator, count: int = 15, setting: Setting = USUAL) -> Cell:
    base_T_sensor, flange_T_object, seen = anywhere(rng), anywhere(rng), views(rng, setting, count)
    flange = base_T_sensor @ np.linalg.inv(seen) @ np.linalg.inv(flange_T_object)
    problem = PosePairsBeside(
        motion=Poses(reported(rng, flange), *POSE_STD),
        sensor_T_object=noisy(rng, np.linalg.inv(seen)),
        std_m=SENSOR_STD[0],
        std_rad=SENSOR_STD[1],
    )
    return Cell(problem, {"sensor": base_T_sensor, "object": flange_T_object})


def move_pairs(rng: np.random.Generator, count: int = 15, setting: Setting = USUAL) -> Cell:
    motion, truth, seen, _ = placed(rng, setting, views(rng, setting, count), ("sensor", "object"))
    first, second = np.arange(len(seen) - 1), np.arange(1, len(seen))
    problem = MovePairs(
        motion=motion,
        first=first,
        second=second,
        first_T_second=noisy(rng, np.linalg.inv(seen[first]) @ seen[second]),
        std_m=SENSOR_STD[0],
        std_rad=SENSOR_STD[1],
    )
    return Cell(problem, {"sensor": truth["sensor"]})


PAIR_CELLS: dict[str, Make] = {
    "pose-pairs": pose_pairs,
    "pose-pairs-beside": pose_pairs_beside,
    "move-pairs": move_pairs,
}
