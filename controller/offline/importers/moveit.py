"""Samples of MoveIt Calibration, as its button Save Samples writes them.

    - effector_wrt_world: [16 numbers]
      object_wrt_sensor: [16 numbers]

Each is a homogeneous matrix row by row, metres: base_T_end-effector from tf, and sensor_T_object. Both are so
for a sensor on the arm and beside it; the file does not say which.
Source: moveit_calibration, handeye_control_widget.cpp, takeTransformSamples and saveSamplesBtnClicked.
"""

from typing import Any

import numpy as np

from controller.offline.importers.given import Given, pair_set
from controller.offline.importers.yaml_tree import Tree
from estimation.tasks import checks
from estimation.transform import FloatArray

_ARM, _SEEN = "effector_wrt_world", "object_wrt_sensor"


def recognises(root: Tree) -> bool:
    """Samples, or joint states."""
    if root.is_list():
        return bool(root.node.value) and root.rows()[0].has(_ARM)
    return root.has("joint_names", "joint_values")


def read(root: Tree, given: Given) -> dict[str, Any]:
    """The data set. Raises BadFile with the line, BadInput for what the file does not say."""
    if root.has("joint_names"):
        raise root.refusal("joint states, without what the sensor saw", "Give the file of Save Samples")
    samples = root.rows()
    mounting = given.mounting_in(root, None)
    arm = [_matrix(sample[_ARM]) for sample in samples]
    seen = [_matrix(sample[_SEEN]) for sample in samples]
    return pair_set(root.file, mounting, arm, seen, given)


def _matrix(place: Tree) -> FloatArray:
    numbers = place.rows()
    if len(numbers) != 16:
        raise place.refusal(f"{len(numbers)} numbers, a matrix has 16", "Mend it, or take the sample out")
    origins = (3, 7, 11)
    values = [each.length_m() if i in origins else each.number() for i, each in enumerate(numbers)]
    pose = np.array(values).reshape(4, 4)
    for finding in checks.transforms({"matrix": pose[None]}):
        raise place.refusal(finding.problem.replace("matrix[0]: ", ""), finding.remedy)
    return pose
