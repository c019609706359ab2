"""Arms that the estimation tests share, written out from their data sheets."""

import numpy as np
import pytest
from hypothesis import settings

from estimation.kinematics import ArmModel

# The same examples on every run, and no limit on the time of one: a busy machine is no defect.
settings.register_profile("steady", derandomize=True, deadline=None)
settings.load_profile("steady")

FREE = (
    (0, "a"),
    (0, "alpha"),
    (1, "theta"),
    (1, "a"),
    (1, "alpha"),
    (1, "beta"),
    *((joint, name) for joint in (2, 3, 4) for name in ("theta", "d", "a", "alpha")),
)


@pytest.fixture(scope="session")
def prbt() -> ArmModel:
    """Pilz PRBT with its 18 identifiable parameters free."""
    limits_rad = np.radians([170.0, 145.0, 135.0, 170.0, 170.0, 179.0])
    return ArmModel.from_dh(
        theta=np.radians([180, 90, 90, 180, 0, 0]),
        d=[0.2604, 0.0, 0.0, 0.307, 0.0, 0.084],
        a=[0.0, 0.350, 0.0, 0.0, 0.0, 0.0],
        alpha=np.radians([90, 180, 90, 90, -90, 0]),
        lower_rad=-limits_rad,
        upper_rad=limits_rad,
        free=FREE,
    )


@pytest.fixture(scope="session")
def irb1400() -> ArmModel:
    """ABB IRB 1400 of the thesis, in metres: axis 1 and axis 2 are 150 mm apart."""
    return ArmModel.from_dh(
        theta=np.radians([0, -90, 0, 0, 0, 180]),
        d=[0.475, 0.0, 0.0, 0.720, 0.0, 0.085],
        a=[0.150, 0.600, 0.120, 0.0, 0.0, 0.0],
        alpha=np.radians([-90, 0, -90, 90, -90, 0]),
    )
