"""What RTDE tells of a robot, against mathematics of another hand."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from simulators.robots.ur_fields import Moment, UrState

angles = st.floats(-3.1, 3.1)


@given(angles, angles, angles)
def test_the_rotation_vector_of_a_pose_turns_as_the_pose_does(x: float, y: float, z: float) -> None:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [x, y, z]).as_matrix()
    moment = Moment(0.0, np.zeros(6), np.zeros(6), lambda: [0.0] * 6, pose, UrState())
    turned = Rotation.from_rotvec(moment.pose[3:]).as_matrix()
    np.testing.assert_allclose(turned, pose[:3, :3], atol=1e-9)
