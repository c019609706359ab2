"""Random cells in which a sensor reports poses of an object, or its own moves."""

import numpy as np

from estimation.tasks.motion import Poses
from estimation.tasks.pairs import MovePairs, PosePairs, PosePairsBeside
from tests.estimation.tasks.cells import DEG, MM, POSE_STD, Cell, FloatArray, anywhere, reported, turns
from tests.estimation.twin import pose
from tests.estimation.twin_poses import aimed

SENSOR_STD = (0.05 * MM, 0.01 * DEG)


def views(rng: np.random.Generator, count: int, spin_deg: float = 50.0) -> FloatArray:
    """object_T_sensor (count, 4, 4), that differ by 115 deg at most."""
    up = np.tile([0.0, 0.0, 1.0], (count, 1))
    centre = rng.uniform(-0.05, 0.05, (count, 3))
    tilt, azimuth, _ = turns(rng, count, 30.0)
    spin = rng.uniform(-spin_deg, spin_deg, count) * DEG - azimuth
    return aimed(centre, up, rng.uniform(0.3, 0.5, count), tilt, azimuth, spin)


def noisy(rng: np.random.Generator, poses: FloatArray) -> FloatArray:
    """Poses as the sensor reports them."""
    return poses @ pose(rng.normal(size=(len(poses), 6)) * np.repeat(SENSOR_STD, 3))


def pose_pairs(rng: np.random.Generator, count: int = 15) -> Cell:
    mount, holder, seen = anywhere(rng), anywhere(rng), views(rng, count)
    flange = holder @ seen @ np.linalg.inv(mount)
    problem = PosePairs(
        motion=Poses(reported(rng, flange), *POSE_STD),
        sensor_T_object=noisy(rng, np.linalg.inv(seen)),
        std_m=SENSOR_STD[0],
        std_rad=SENSOR_STD[1],
    )
    return Cell(problem, {"sensor": mount, "object": holder})


def pose_pairs_beside(rng: np.random.Generator, count: int = 15) -> Cell:
    base_T_sensor, flange_T_object, seen = anywhere(rng), anywhere(rng), views(rng, count)
    flange = base_T_sensor @ np.linalg.inv(seen) @ np.linalg.inv(flange_T_object)
    problem = PosePairsBeside(
        motion=Poses(reported(rng, flange), *POSE_STD),
        sensor_T_object=noisy(rng, np.linalg.inv(seen)),
        std_m=SENSOR_STD[0],
        std_rad=SENSOR_STD[1],
    )
    return Cell(problem, {"sensor": base_T_sensor, "object": flange_T_object})


def move_pairs(rng: np.random.Generator, count: int = 15) -> Cell:
    mount, seen = anywhere(rng), views(rng, count)
    flange = anywhere(rng) @ seen @ np.linalg.inv(mount)
    first, second = np.arange(count - 1), np.arange(1, count)
    problem = MovePairs(
        motion=Poses(reported(rng, flange), *POSE_STD),
        first=first,
        second=second,
        first_T_second=noisy(rng, np.linalg.inv(seen[first]) @ seen[second]),
        std_m=SENSOR_STD[0],
        std_rad=SENSOR_STD[1],
    )
    return Cell(problem, {"sensor": mount})


PAIR_CELLS = {"pose-pairs": pose_pairs, "pose-pairs-beside": pose_pairs_beside, "move-pairs": move_pairs}
