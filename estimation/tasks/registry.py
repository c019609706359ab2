"""Every calibration task by its name."""

from collections.abc import Mapping
from typing import Final

from estimation.tasks import camera, laser, pairs, positioner, probe
from estimation.tasks.pairs import PairTask
from estimation.tasks.positioner import PositionerTask
from estimation.tasks.sensing import SensorTask
from estimation.tasks.solve import Problem
from estimation.tasks.two_robots import TwoRobots

_SENSOR_KINDS: Final[tuple[type[SensorTask], ...]] = (
    laser.PointLaserOnPlane,
    laser.PointLaserOnPlanes,
    laser.PointLaserOnSphere,
    laser.ProfileLaserOnPlane,
    laser.ProfileLaserOnSphere,
    probe.TouchOnSphere,
    probe.TouchOnPlanes,
    camera.CameraHandEye,
    camera.CameraEyeToHand,
    camera.Tracker,
)
_PAIR_KINDS: Final[tuple[type[PairTask], ...]] = (pairs.PosePairs, pairs.PosePairsBeside, pairs.MovePairs)

SENSOR_TASKS: Final[Mapping[str, type[SensorTask]]] = {kind.task: kind for kind in _SENSOR_KINDS}
"""A sensor sees points of an object."""

PAIR_TASKS: Final[Mapping[str, type[PairTask]]] = {kind.task: kind for kind in _PAIR_KINDS}
"""A sensor reports whole poses, or how it moved."""

POSITIONER_TASKS: Final[Mapping[str, type[PositionerTask]]] = {
    kind.task: kind
    for kind in (positioner.PositionerPoints, positioner.PositionerSphere, positioner.PositionerPlanes)
}
"""Points of an object on a table with two axes."""

TASKS: Final[Mapping[str, type[Problem]]] = {
    **SENSOR_TASKS,
    **PAIR_TASKS,
    **POSITIONER_TASKS,
    TwoRobots.task: TwoRobots,
}
"""All of them; the arm is known, or has priors."""

KINEMATIC_TASKS: Final[Mapping[str, type[SensorTask]]] = {
    f"kinematics-{name}": kind for name, kind in SENSOR_TASKS.items()
}
"""What a `KinematicTask` takes its readings from, by the name that it has then."""
