"""Hand-eye problems of robot_cal_tools with points in space (ExtrinsicHandEyeProblem3D3D), as YAML.

    observations:
    - correspondences:
      - {in_image: {x, y, z}, in_target: {x, y, z}}
      to_camera_mount: {x, y, z, qx, qy, qz, qw}
      to_target_mount: {x, y, z, qx, qy, qz, qw}
    camera_mount_to_camera_guess: ...
    target_mount_to_target_guess: ...

`in_image` is a point in the camera, `in_target` the same point in the target, `to_camera_mount` where the
mount of the camera is in the common base (base_T_camera_mount), `to_target_mount` likewise; metres. One mount
moves with the arm, the other is the base itself. The guesses are not needed. Pixels (problems with `intr`,
lists of poses and images) are not read.
Source: robot_cal_tools, serialization/problems.h, types.h, eigen.h and extrinsic_hand_eye_utest.cpp.
"""

from typing import Any, Final

import numpy as np

from controller.offline.importers.given import Given, motion
from controller.offline.importers.names import Mounting
from controller.offline.importers.yaml_tree import Tree, point_of, pose_of
from estimation.transform import FloatArray

_QUATERNION: Final = ("qx", "qy", "qz", "qw")
_SAME: Final = 1e-9
_PIXELS: Final = "Find the target in the images first; then give points in space, or poses (docs/datasets.md)"


def recognises(root: Tree) -> bool:
    """Problems, also those that are not read."""
    if root.is_list():
        return bool(root.node.value) and root.rows()[0].has("pose", "image")
    if root.has("observations"):
        return True
    return bool(root.table()) and next(iter(root.table().values())).has("camera_joints", "target_joints")


def read(root: Tree, given: Given) -> dict[str, Any]:
    """The data set. Raises BadFile with the line, BadInput for what the file does not say."""
    if root.is_list():
        raise root.rows()[0].refusal("poses and names of images: images are not read", _PIXELS)
    if root.has("intr"):
        raise root["intr"].refusal("a problem with points in pixels: images are not read", _PIXELS)
    if not root.has("observations"):
        raise root.refusal("no observations of a hand-eye problem", "Give an ExtrinsicHandEyeProblem3D3D")
    observations = root["observations"].rows()
    camera = [_pose(each["to_camera_mount"]) for each in observations]
    target = [_pose(each["to_target_mount"]) for each in observations]
    mounting = given.mounting_in(root, _mounting(observations, camera, target))
    seen = [pair for each in observations for pair in each["correspondences"].rows()]
    poses = [i for i, each in enumerate(observations) for _ in each["correspondences"].rows()]
    markers: dict[tuple[float, ...], int] = {}
    which = [markers.setdefault(tuple(point_of(pair["in_target"])), len(markers)) for pair in seen]
    in_hand = mounting is Mounting.EYE_IN_HAND
    return {
        "truecell_dataset": 1,
        "task": "camera-hand-eye" if in_hand else "camera-eye-to-hand",
        "about": f"From {root.file}",
        "units": {"length": "m", "angle": "rad"},
        "motion": motion(camera if in_hand else target, given.arm_std(root.file)),
        "points": [_camera_point(pair["in_image"]) for pair in seen],
        "pose": poses,
        "marker": which,
        "markers": [list(marker) for marker in markers],
        "noise": given.point_std(root.file),
    }


def _mounting(observations: list[Tree], camera: list[FloatArray], target: list[FloatArray]) -> Mounting:
    """Which of the two mounts is the base; the other one moves."""
    moves = [
        next((i for i, pose in enumerate(poses) if np.abs(pose - np.eye(4)).max() > _SAME), None)
        for poses in (camera, target)
    ]
    match moves:
        case [None, None]:
            raise observations[0].refusal("neither camera nor target moves", "Give the poses of the arm")
        case [_, None]:
            return Mounting.EYE_IN_HAND
        case [None, _]:
            return Mounting.EYE_TO_HAND
        case _:
            row = max(place for place in moves if place is not None)
            raise observations[row].refusal(
                "both to_camera_mount and to_target_mount differ from the identity",
                "Give the poses of the arm in the frame that the other one is mounted on",
            )


def _pose(place: Tree) -> FloatArray:
    return pose_of(place, place, _QUATERNION)


def _camera_point(place: Tree) -> list[float]:
    if not place.has("z"):
        raise place.refusal("a point of an image, without z: images are not read", _PIXELS)
    return point_of(place)
