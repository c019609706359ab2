"""Samples of other programs: the truth is found from them, and nothing is guessed."""

import json
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from controller.console.exit_codes import ExitCode
from controller.offline.importers.given import Given
from controller.offline.importers.names import Mounting, Program
from controller.offline.importers.registry import imported
from controller.offline.refusal import BadFile
from tests.controller.offline.answers import EXAMPLES, Run, inside
from tests.estimation.tasks.cells import (
    CAMERA_STD_M,
    POSE_STD,
    Cell,
    FloatArray,
    camera_eye_to_hand,
    camera_hand_eye,
)
from tests.estimation.tasks.pair_cells import SENSOR_STD, pose_pairs, pose_pairs_beside

ARM_NOISE = f"{POSE_STD[0]} m, {POSE_STD[1]} rad"
SENSOR_NOISE = f"{SENSOR_STD[0]} m, {SENSOR_STD[1]} rad"
NOISE = ("--arm-noise", ARM_NOISE, "--sensor-noise", SENSOR_NOISE)
IN_HAND, TO_HAND = ("--mounting", "eye-in-hand"), ("--mounting", "eye-to-hand")
GIVEN = Given(Mounting.EYE_IN_HAND, ARM_NOISE, SENSOR_NOISE)


def message(pose: FloatArray) -> dict[str, Any]:
    """A geometry_msgs/Transform as ROS writes it."""
    rotation = dict(zip("xyzw", Rotation.from_matrix(pose[:3, :3]).as_quat().tolist(), strict=True))
    return {"translation": dict(zip("xyz", pose[:3, 3].tolist(), strict=True)), "rotation": rotation}


def easy_handeye(cell: Cell, beside: bool = False, said: str = "") -> str:
    """As easy_handeye2 saves samples: a sensor that stands has the poses of the robot inverted."""
    problem = cell.problem
    arm = problem.motion.base_T_flange
    samples = [
        {"robot": message(np.linalg.inv(a) if beside else a), "tracking": message(b)}
        for a, b in zip(arm, problem.sensor_T_object, strict=True)
    ]
    parameters = {"name": "", "calibration_type": said, "robot_base_frame": ""}
    return yaml.dump({"parameters": parameters, "samples": samples}, sort_keys=False)


def moveit(cell: Cell) -> str:
    """As the emitter of yaml-cpp writes samples of MoveIt Calibration."""
    lines = []
    for a, b in zip(cell.problem.motion.base_T_flange, cell.problem.sensor_T_object, strict=True):
        for key, matrix in (("- effector_wrt_world", a), ("  object_wrt_sensor", b)):
            lines += [f"{key}:", *(f"    - {number:.17g}" for number in matrix.ravel())]
    return "\n".join(lines)


def robot_cal_tools(cell: Cell, beside: bool = False) -> str:
    """As yaml-cpp writes an ExtrinsicHandEyeProblem3D3D."""
    problem = cell.problem
    observations = []
    for i, pose in enumerate(problem.motion.base_T_flange):
        rows = np.flatnonzero(problem.pose_index == i)
        pairs = [
            {
                "in_image": xyz(problem.points_m[row]),
                "in_target": xyz(problem.markers_m[problem.marker_index[row]]),
            }
            for row in rows
        ]
        mounts = [isometry(np.eye(4)), isometry(pose)]
        observations.append(
            {
                "correspondences": pairs,
                "to_camera_mount": mounts[not beside],
                "to_target_mount": mounts[beside],
            }
        )
    return yaml.dump({"camera_mount_to_camera_guess": isometry(np.eye(4)), "observations": observations})


def xyz(point: FloatArray) -> dict[str, float]:
    return dict(zip("xyz", point.tolist(), strict=True))


def isometry(pose: FloatArray) -> dict[str, float]:
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    return xyz(pose[:3, 3]) | dict(zip(("qx", "qy", "qz", "qw"), quaternion, strict=True))


def drawn(make: Callable[..., Cell]) -> Cell:
    return make(np.random.default_rng(31))


CASES: dict[str, tuple[Callable[..., Cell], Callable[[Cell], str], tuple[str, ...]]] = {
    "easy-handeye, in hand": (pose_pairs, easy_handeye, (*IN_HAND, *NOISE)),
    "easy-handeye, in hand as it says": (pose_pairs, lambda c: easy_handeye(c, said="eye_in_hand"), NOISE),
    "easy-handeye, beside": (pose_pairs_beside, lambda c: easy_handeye(c, True), (*TO_HAND, *NOISE)),
    "moveit, in hand": (pose_pairs, moveit, (*IN_HAND, *NOISE)),
    "moveit, beside": (pose_pairs_beside, moveit, (*TO_HAND, *NOISE)),
    "robot_cal_tools, in hand": (camera_hand_eye, robot_cal_tools, NOISE[:2]),
    "robot_cal_tools, beside": (camera_eye_to_hand, lambda c: robot_cal_tools(c, True), NOISE[:2]),
}


@pytest.mark.parametrize("name", CASES)
def test_the_truth_is_found_from_samples_known_by_their_content(name: str, run: Run, tmp_path: Path) -> None:
    make, as_text, options = CASES[name]
    cell, path = drawn(make), tmp_path / "samples.yaml"
    path.write_text(as_text(cell))
    if "camera" in make.__name__:
        options = (*options, "--sensor-noise", ", ".join(f"{std} m" for std in CAMERA_STD_M))
    code, out, err = run(path, *options, "--json", "--write", tmp_path / "set.json")
    assert code == ExitCode.OK, out + err
    answer = json.loads(out)
    assert answer["task"] == cell.problem.task
    for block, truth in cell.truth.items():
        truth_mm = truth.copy()
        truth_mm[:3, 3] *= 1e3
        assert inside(answer, block, truth_mm)
    # The data set that was written is the same one.
    assert run(tmp_path / "set.json", "--json")[1] == out


@pytest.mark.parametrize("beside", [False, True])
def test_the_wrong_mounting_is_not_taken(beside: bool, run: Run, tmp_path: Path) -> None:
    cell = drawn(pose_pairs_beside if beside else pose_pairs)
    (tmp_path / "s.yaml").write_text(moveit(cell))
    code, out, _ = run(tmp_path / "s.yaml", *(IN_HAND if beside else TO_HAND), *NOISE, "--json")
    assert code == ExitCode.NOT_DECIDABLE
    assert json.loads(out)["status"] == "refused"


def matrix(*changes: tuple[int, object]) -> str:
    """A sample of MoveIt, its second matrix changed at places from 0."""
    numbers: list[object] = [*np.eye(4).ravel().astype(int).tolist()]
    for place, value in changes:
        numbers[place] = value
    return f"{ARM}  object_wrt_sensor: [{', '.join(map(str, numbers))}]\n"


ARM = "- effector_wrt_world: [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]\n"
SEEN = "s.yaml:2: [1].object_wrt_sensor"
EASY = "samples:\n- robot:\n    translation: {x: 1, y: 2, z: 3}\n    rotation: {x: 0, y: 0, z: 0, w: 1}\n"
SAID = "parameters:\n  calibration_type: "
COMMA = 's.yaml:3: samples[1].robot.translation.x: "1,5" is not a finite number. Write decimal points'
MOUNTING = "parameters.calibration_type"
BAD: dict[str, tuple[str, str]] = {
    "empty": ("", "s.yaml: the file is empty"),
    "comment only": ("# nothing\n", "s.yaml: the file is empty"),
    "no yaml": ("a: [1,\nb: 2\n", "not YAML"),
    "two documents": ("a: 1\n---\nb: 2\n", "s.yaml:2: not YAML"),
    "something else": ("cameras: []\n", "s.yaml:1: not recognised as a file of easy-handeye"),
    "no samples": ("samples: []\n", "s.yaml:1: samples: not a list with something in it"),
    "3 numbers": (f"{ARM}  object_wrt_sensor: [1, 0, 0]\n", f"{SEEN}: 3 numbers, a matrix has 16"),
    "a word": (matrix((3, "x")), f'{SEEN}[4]: "x" is not a finite number'),
    "nan": (matrix((3, ".nan")), f'{SEEN}[4]: ".nan" is not a finite number'),
    "overflow": (matrix((3, "1e999")), '"1e999" is not a finite number'),
    "decimal comma": (matrix((3, "'0,5'")), f'{SEEN}[4]: "0,5" is not a finite number. Write decimal'),
    "column by column": (matrix((12, 0.1)), f"{SEEN}: The last row of a matrix"),
    "skewed": (matrix((1, 0.1)), "R^T R differs from the identity by 0.1"),
    "left-handed": (matrix((10, -1)), "left-handed"),
    "millimetres": (matrix((3, 250)), f"{SEEN}[4]: 250 m, limit 20 m: these files are in metres"),
    "no sensor": (ARM, "s.yaml:1: [1]: the key 'object_wrt_sensor' is missing"),
    "key twice": (EASY + "  robot: 1\n", "s.yaml:5: the key 'robot' stands twice"),
    "no tracking": (EASY, "s.yaml:2: samples[1]: the key 'tracking' is missing"),
    "quaternion": (
        EASY.replace("w: 1", "w: 2"),
        "s.yaml:4: samples[1].robot.rotation: a quaternion of length 2",
    ),
    "decimal comma in a map": (EASY.replace("x: 1", "x: '1,5'"), COMMA),
    "another mounting": (f"{SAID}eye_on_base\n{EASY}", f"s.yaml:2: {MOUNTING}: this says eye-to-hand"),
    "no such mounting": (f"{SAID}both\n{EASY}", f"s.yaml:2: {MOUNTING}: 'both' is neither of eye_in_hand"),
    "a calibration": ("parameters: {}\ntransform: {}\n", "a calibration that easy_handeye has found"),
    "joint states": ("joint_names: [a]\njoint_values: [[0]]\n", "joint states, without what the sensor saw"),
    "images": ("- pose: a.yaml\n  image: a.png\n", "s.yaml:1: [1]: poses and names of images"),
    "pixels": ("observations: []\nintr: {fx: 1}\n", "s.yaml:2: intr: a problem with points in pixels"),
    "joints": ("'1':\n  camera_joints: []\n  target_joints: [1]\n", "no observations of a hand-eye problem"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_file_with_a_mistake_is_refused_with_its_line(name: str, run: Run, tmp_path: Path) -> None:
    text, sentence = BAD[name]
    (tmp_path / "s.yaml").write_text(text)
    code, out, err = run(tmp_path / "s.yaml", *IN_HAND, *NOISE)
    assert (code, out) == (ExitCode.BAD_INPUT, "")
    assert sentence in err
    assert err.count("\n") == 1


def test_mounts_that_both_move_or_never_are_refused(tmp_path: Path) -> None:
    text = robot_cal_tools(drawn(camera_hand_eye))
    still = yaml.safe_load(text)
    for each in still["observations"]:
        each["to_camera_mount"] = isometry(np.eye(4))
    both = yaml.safe_load(text)
    both["observations"][3]["to_target_mount"]["x"] = 0.5
    flat = yaml.safe_load(text)
    del flat["observations"][2]["correspondences"][1]["in_image"]["z"]
    for content, words in (
        (still, "neither camera nor target moves"),
        (both, r"s\.yaml:\d+: observations\[4\]: both to_camera_mount and"),
        (flat, r"s\.yaml:\d+: observations\[3\]\.correspondences\[2\]\.in_image: a point of an image"),
    ):
        (tmp_path / "s.yaml").write_text(yaml.dump(content))
        with pytest.raises(BadFile, match=words):
            imported(tmp_path / "s.yaml", None, GIVEN)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ((), "s.yaml does not say where the sensor is. Write --mounting"),
        (IN_HAND, 's.yaml does not say how well the poses of the arm are known. Write --arm-noise "0.05 mm'),
        ((*IN_HAND, *NOISE[:2]), "how well the poses that the sensor saw are known. Write --sensor-noise"),
        ((*IN_HAND, "--arm-noise", "1 mm"), '--arm-noise "1 mm": 1 values, must be 2'),
        ((*IN_HAND, "--arm-noise", "0.1, 0.1 deg"), '--arm-noise: "0.1": unit missing'),
        ((*IN_HAND, "--arm-noise", "1 deg, 1 mm"), "--arm-noise: "),
        ((*IN_HAND, "--arm-noise", "1 m, 1 deg"), "--arm-noise: 1 m is out of bounds, at most 100 mm"),
        ((*IN_HAND, *NOISE[:2], "--sensor-noise", "0 mm, 1 deg"), "--sensor-noise: 0 mm is out of bounds"),
        (("--from", "easy-handeye", *IN_HAND, *NOISE), "s.yaml:1: not a table of keys and values"),
        (("--csv", "x.csv"), "--csv goes with a data set"),
        ((*IN_HAND, *NOISE, "--write", "no/set.json"), "--write: no/set.json cannot be written"),
    ],
)
def test_what_the_file_does_not_say_must_be_given(
    options: tuple[str, ...], sentence: str, run: Run, tmp_path: Path
) -> None:
    (tmp_path / "s.yaml").write_text(moveit(drawn(pose_pairs)))
    code, _, err = run(tmp_path / "s.yaml", *options)
    assert code == ExitCode.BAD_INPUT
    assert sentence in err


def test_the_example_is_that_of_its_generator_and_says_the_same_as_its_data_set(run: Run) -> None:
    generator = runpy.run_path(str(EXAMPLES / "make_pairs.py"))
    samples = EXAMPLES / "camera.samples"
    assert samples.read_text() == generator["samples"](generator["dataset"]("pose-pairs"))
    noise = ("--arm-noise", "0.02 mm, 0.002 deg", "--sensor-noise", "0.05 mm, 0.01 deg")
    code, out, _ = run(samples, *IN_HAND, *noise, "--json")
    assert code == ExitCode.OK
    other = json.loads(run(EXAMPLES / "pose-pairs.json", "--json")[1])
    found = json.loads(out)
    for name in ("sensor", "object"):
        matrices = [np.array(each["parameters"][name]["matrix_mm"]) for each in (found, other)]
        assert matrices[0] == pytest.approx(matrices[1], abs=1e-3)


@pytest.mark.parametrize("name", ["no.samples", "no.json"])
def test_a_file_that_is_not_there_is_named(name: str, run: Run) -> None:
    code, _, err = run(name)
    assert code == ExitCode.BAD_INPUT
    assert err.startswith(f"{name}: there is no such file.")


def test_options_of_samples_do_not_go_with_a_data_set(run: Run, tmp_path: Path) -> None:
    (tmp_path / "set.json").write_text("{}")
    code, _, err = run(tmp_path / "set.json", *IN_HAND)
    assert code == ExitCode.BAD_INPUT
    assert "go with samples of another program" in err
    assert set(Program) == {"easy-handeye", "moveit", "robot-cal-tools"}
