"""Writes pose-pairs.json, its like for other tasks, and camera.samples from known truth and a seed.

    python docs/examples/make_pairs.py

A camera sees the pose of a board at 15 poses of the arm: on the flange, while the board stands; and beside
the arm, which carries the board. In the third file a tracker on the flange reports how it moved from each
pose to the next. In two-robots.json two arms, each with a camera, see the same board. camera.samples has the
pairs of pose-pairs.json as easy_handeye2 saves its samples. An arm reports its poses
with 0.02 mm and 0.002 deg of noise, a sensor with 0.05 mm and 0.01 deg. Everything here is plain geometry;
nothing of the estimator is used. SENSOR_MM and OBJECT_MM are the truth, OTHER_BASE_MM that of the two arms.
"""

import json
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

SEED, POSES = 5, 15
ARM_NOISE, SENSOR_NOISE = (0.02, 0.002), (0.05, 0.01)  # mm, deg


def pose(xyz_mm, rpy_deg):
    """4 x 4, mm."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_euler("xyz", rpy_deg, degrees=True).as_matrix(), xyz_mm
    return matrix


SENSOR_MM = {  # flange_T_sensor on the arm, base_T_sensor beside it
    "pose-pairs": pose([35.0, -60.0, 80.0], [3.0, -5.0, 90.0]),
    "pose-pairs-beside": pose([1200.0, 150.0, 600.0], [-90.0, 10.0, 85.0]),
    "move-pairs": pose([20.0, 45.0, 30.0], [-4.0, 6.0, 30.0]),
}
OBJECT_MM = {  # base_T_object of the board that stands, flange_T_object of the one that is carried
    "pose-pairs": pose([620.0, -80.0, 50.0], [1.0, 2.0, -20.0]),
    "pose-pairs-beside": pose([5.0, 10.0, 120.0], [0.0, 3.0, 45.0]),
}


OTHER_BASE_MM = pose([1500.0, -300.0, 20.0], [0.5, -1.0, 170.0])  # base1_T_base2
OTHER_SENSOR_MM = pose([-20.0, 55.0, 95.0], [-6.0, 4.0, -80.0])  # flange_T_sensor of the second arm


def noisy(rng, matrix, noise):
    """A pose as a device says it."""
    shift, turn = rng.normal(size=3) * noise[0], rng.normal(size=3) * noise[1]
    return matrix @ pose(shift, turn)


def views(rng):
    """object_T_sensor, looking down at the board from 250 to 400 mm."""
    for _ in range(POSES):
        tilt = rng.uniform(-30.0, 30.0, 2)
        turned = pose([0.0, 0.0, 0.0], [180.0 + tilt[0], tilt[1], rng.uniform(-60.0, 60.0)])
        aim = np.append(rng.uniform(-40.0, 40.0, 2), 0.0)
        turned[:3, 3] = aim - rng.uniform(250.0, 400.0) * turned[:3, 2]
        yield turned


def matrices(poses):
    return [np.column_stack([np.round(m[:, :3], 8), np.round(m[:, 3], 4)]).tolist() for m in poses]


def written(noise):
    return {"position": f"{noise[0]} mm", "rotation": f"{noise[1]} deg"}


def dataset(task):
    """The data set of a task."""
    rng = np.random.default_rng(SEED)
    if task == "two-robots":
        place = OBJECT_MM["pose-pairs"]
        return {
            **head(task),
            "first": pairs(rng, "pose-pairs", SENSOR_MM["pose-pairs"], place),
            "second": pairs(rng, "pose-pairs", OTHER_SENSOR_MM, np.linalg.inv(OTHER_BASE_MM) @ place),
        }
    return pairs(rng, task, SENSOR_MM[task], OBJECT_MM.get(task, OBJECT_MM["pose-pairs"]))


def head(task):
    return {"truecell_dataset": 1, "task": task, "about": f"Simulated by make_pairs.py, seed {SEED}"}


def pairs(rng, task, sensor, place):
    """What one arm and its sensor report."""
    seen = list(views(rng))
    if task == "pose-pairs-beside":
        flange = [sensor @ np.linalg.inv(view) @ np.linalg.inv(place) for view in seen]
    else:
        flange = [place @ view @ np.linalg.inv(sensor) for view in seen]
    content = {
        **head(task),
        "units": {"length": "mm", "angle": "deg"},
        "motion": {
            "kind": "poses",
            "target": "base",
            "source": "flange",
            "noise": written(ARM_NOISE),
            "matrices": matrices(noisy(rng, one, ARM_NOISE) for one in flange),
        },
    }
    if task == "move-pairs":
        moves = [np.linalg.inv(one) @ other for one, other in pairwise(seen)]
        content["moves"] = {
            "target": "first",
            "source": "second",
            "noise": written(SENSOR_NOISE),
            "first": list(range(POSES - 1)),
            "second": list(range(1, POSES)),
            "matrices": matrices(noisy(rng, move, SENSOR_NOISE) for move in moves),
        }
    else:
        content["seen"] = {
            "target": "sensor",
            "source": "object",
            "noise": written(SENSOR_NOISE),
            "matrices": matrices(noisy(rng, np.linalg.inv(view), SENSOR_NOISE) for view in seen),
        }
    return content


def samples(content):
    """Pose pairs as easy_handeye2 saves its samples: metres and quaternions."""
    lines = ["parameters:", "  name: ''", "  calibration_type: ''", "samples:"]
    pairs = zip(content["motion"]["matrices"], content["seen"]["matrices"], strict=True)
    for pair in pairs:
        for name, matrix in zip(("- robot", "  tracking"), map(np.array, pair), strict=True):
            quaternion = Rotation.from_matrix(matrix[:3, :3]).as_quat()
            origin = matrix[:3, 3] * 1e-3
            lines += [f"{name}:", "    translation:"]
            lines += [f"      {axis}: {number:.7f}" for axis, number in zip("xyz", origin, strict=True)]
            lines.append("    rotation:")
            lines += [f"      {axis}: {number:.9f}" for axis, number in zip("xyzw", quaternion, strict=True)]
    return "\n".join(lines) + "\n"


def text(content):
    """JSON with one row of numbers a line."""
    return re.sub(r"\[\s+([^\[\]{}]*?)\s+\]", _one_line, json.dumps(content, indent=1)) + "\n"


def _one_line(match):
    return "[" + re.sub(r"\s+", " ", match[1]) + "]"


if __name__ == "__main__":
    for name in (*SENSOR_MM, "two-robots"):
        Path(__file__).with_name(f"{name}.json").write_text(text(dataset(name)), encoding="utf-8")
    Path(__file__).with_name("camera.samples").write_text(samples(dataset("pose-pairs")), encoding="utf-8")
