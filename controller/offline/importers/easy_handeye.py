"""Samples of easy_handeye2, as its button Save Samples writes them (name.samples).

    samples:
    - robot:    {translation: {x, y, z}, rotation: {x, y, z, w}}
      tracking: {translation: {x, y, z}, rotation: {x, y, z, w}}

`tracking` is tracking_base_T_tracking_marker: the sensor, and the object that it sees. `robot` is
robot_base_T_robot_effector where the sensor is on the arm; where it stands beside, the program stores the
inverse, robot_effector_T_robot_base. Metres. `parameters` says which of the two it is (calibration_type), but
the program leaves it empty in files of samples.
Source: easy_handeye2, handeye_sampler.py and its test data; checked against the calibrations beside these.
"""

from typing import Any

from controller.offline.importers.given import Given, pair_set
from controller.offline.importers.names import Mounting
from controller.offline.importers.yaml_tree import Tree, pose_of
from estimation.tasks.closed_forms import inverse
from estimation.transform import FloatArray

_TYPES = {"eye_in_hand": Mounting.EYE_IN_HAND, "eye_on_base": Mounting.EYE_TO_HAND}
_RESULTS = ("transform", "transformation")  # of easy_handeye2 and of easy_handeye


def recognises(root: Tree) -> bool:
    """Samples, or a calibration."""
    return root.has("samples") or any(root.has("parameters", key) for key in _RESULTS)


def read(root: Tree, given: Given) -> dict[str, Any]:
    """The data set. Raises BadFile with the line, BadInput for what the file does not say."""
    if any(root.has(key) for key in _RESULTS):
        raise root.refusal(
            "a calibration that easy_handeye has found, without its samples",
            "Give the file of samples (.samples of easy_handeye2)",
        )
    samples = root["samples"].rows()
    mounting = given.mounting_in(*_said(root))
    arm = [_transform(sample["robot"]) for sample in samples]
    if mounting is Mounting.EYE_TO_HAND:
        arm = [inverse(pose) for pose in arm]
    seen = [_transform(sample["tracking"]) for sample in samples]
    return pair_set(root.file, mounting, arm, seen, given)


def _said(root: Tree) -> tuple[Tree, Mounting | None]:
    """What the file says of the mounting, and where."""
    if not root.has("parameters") or not root["parameters"].has("calibration_type"):
        return root, None
    place = root["parameters"]["calibration_type"]
    word = place.text()
    if word and word not in _TYPES:
        raise place.refusal(f"{word!r} is neither of {', '.join(_TYPES)}", "Mend it")
    return place, _TYPES.get(word)


def _transform(place: Tree) -> FloatArray:
    return pose_of(place["translation"], place["rotation"])
