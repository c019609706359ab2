"""Writes positioner.json: a tilt-and-turn table, three reflectors on it and a tracker, with known truth.

    python docs/examples/make_positioner.py

The table tilts about axis 1 and turns about axis 2, which the first carries. A tracker measures three
reflectors on the table at 15 poses; where they sit on it is not known. Angles are read with 0.001 deg of
noise, points with 0.01 mm. Everything here is plain geometry; nothing of the estimator is used. AXIS_1 and
AXIS_2 are the truth, each a point in mm and a direction, where both angles are zero.
"""

import json
import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

SEED, POSES = 3, 15
ANGLE_NOISE_DEG, POINT_NOISE_MM = 0.001, 0.01
AXIS_1 = np.array([900.0, 0.0, 450.0]), np.array([0.0, 1.0, 0.0])
AXIS_2 = (
    np.array([905.0, 20.0, 500.0]),
    Rotation.from_euler("xy", [0.05, 0.4], degrees=True).apply([0.0, 0.0, 1.0]),
)
REFLECTORS_MM = np.array([[1100.0, 30.0, 530.0], [850.0, 190.0, 560.0], [790.0, -120.0, 525.0]])


def turned(points, axis, angle_deg):
    """Points turned about an axis."""
    point, direction = axis
    return point + Rotation.from_rotvec(np.radians(angle_deg) * direction).apply(points - point)


def dataset():
    """The data set."""
    rng = np.random.default_rng(SEED)
    angles = np.column_stack([rng.uniform(-70.0, 70.0, POSES), rng.uniform(-170.0, 170.0, POSES)])
    points = [turned(turned(REFLECTORS_MM, AXIS_2, turn), AXIS_1, tilt) for tilt, turn in angles]
    seen = np.concatenate(points) + rng.normal(size=(3 * POSES, 3)) * POINT_NOISE_MM
    return {
        "truecell_dataset": 1,
        "task": "positioner",
        "about": f"Simulated by make_positioner.py, seed {SEED}",
        "units": {"length": "mm", "angle": "deg"},
        "motion": {
            "kind": "positioner",
            "noise": f"{ANGLE_NOISE_DEG} deg",
            "angles": np.round(angles + rng.normal(size=angles.shape) * ANGLE_NOISE_DEG, 4).tolist(),
        },
        "points": np.round(seen, 4).tolist(),
        "pose": np.repeat(np.arange(POSES), 3).tolist(),
        "marker": np.tile([0, 1, 2], POSES).tolist(),
        "noise": f"{POINT_NOISE_MM} mm",
    }


def text(content):
    """JSON with one row of numbers a line."""
    return re.sub(r"\[\s+([^\[\]{}]*?)\s+\]", _one_line, json.dumps(content, indent=1)) + "\n"


def _one_line(match):
    return "[" + re.sub(r"\s+", " ", match[1]) + "]"


if __name__ == "__main__":
    Path(__file__).with_name("positioner.json").write_text(text(dataset()), encoding="utf-8")
