"""What OpenCV answers to pairs of poses: `python -m tests.estimation.tasks.opencv` writes it down.

It needs a release whose Python module has calibrateHandEye, which that of 5.0.0 has not.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tests.estimation.tasks.layout import DEG, FloatArray
from tests.estimation.tasks.pair_cells import pose_pairs

RECORDED = Path(__file__).parents[1] / "data" / "opencv_hand_eye.json"


def comparable(seed: int) -> tuple[FloatArray, FloatArray]:
    """base_T_flange and sensor_T_object (6, 4, 4) of which any two differ by 20 to 110 deg.

    By less, OpenCV leaves a pair out of its Tsai-Lenz; by more than 120 deg, it turns signs of quaternions.
    """
    rng = np.random.default_rng(seed)
    while True:
        problem = pose_pairs(rng, 6).problem
        rotation = Rotation.from_matrix(problem.sensor_T_object[:, :3, :3])
        first, second = np.triu_indices(6, 1)
        turn = (rotation[first].inv() * rotation[second]).magnitude()
        if turn.min() > 20 * DEG and turn.max() < 110 * DEG:
            return problem.motion.base_T_flange, problem.sensor_T_object


def answers(cv2: Any, flange: FloatArray, seen: FloatArray) -> dict[str, list[FloatArray]]:
    """X of A X = X B by name, X and Y of A X = Y B, of base_T_flange and sensor_T_object (k, 4, 4)."""

    def split(poses: FloatArray) -> tuple[FloatArray, FloatArray]:
        return poses[:, :3, :3], poses[:, :3, 3]

    def joined(rotation: FloatArray, origin: FloatArray) -> FloatArray:
        return np.block([[rotation, origin.reshape(3, 1)], [np.eye(4)[3:]]])

    found = {}
    for name, method in (
        ("tsai-lenz", cv2.CALIB_HAND_EYE_TSAI),
        ("park-martin", cv2.CALIB_HAND_EYE_PARK),
        ("daniilidis", cv2.CALIB_HAND_EYE_DANIILIDIS),
    ):
        found[name] = [joined(*cv2.calibrateHandEye(*split(flange), *split(seen), method=method))]
    # OpenCV has sensor_T_world and gripper_T_base, and answers base_T_world and gripper_T_sensor inverted.
    answer = cv2.calibrateRobotWorldHandEye(
        *split(seen), *split(np.linalg.inv(flange)), method=cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH
    )
    found["shah"] = [np.linalg.inv(joined(*answer[2:])), np.linalg.inv(joined(*answer[:2]))]
    return found


if __name__ == "__main__":
    import cv2

    poses = comparable(4)
    recorded = {
        "opencv": cv2.__version__,
        "base_T_flange": poses[0].tolist(),
        "sensor_T_object": poses[1].tolist(),
        "answers": {name: [each.tolist() for each in found] for name, found in answers(cv2, *poses).items()},
    }
    RECORDED.write_text(json.dumps(recorded) + "\n")
