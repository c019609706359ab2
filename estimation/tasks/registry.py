"""Every calibration task by its name."""

from collections.abc import Mapping
from typing import Final

from estimation.tasks import camera, laser, probe
from estimation.tasks.sensing import SensorTask

_KINDS: Final[tuple[type[SensorTask], ...]] = (
    laser.PointLaserOnPlane,
    laser.PointLaserOnPlanes,
    laser.PointLaserOnSphere,
    laser.ProfileLaserOnPlane,
    laser.ProfileLaserOnSphere,
    probe.TouchOnSphere,
    probe.TouchOnPlanes,
    camera.CameraHandEye,
    camera.CameraEyeToHand,
)

TASKS: Final[Mapping[str, type[SensorTask]]] = {kind.task: kind for kind in _KINDS}
