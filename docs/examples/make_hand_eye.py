"""Writes hand-eye.json: a point laser on an arm, at a plate, with known truth and a seed.

    python docs/examples/make_hand_eye.py

An arm of six joints (its Denavit-Hartenberg table is in the file) points a laser at a plate from 40 poses.
The joints are read with 0.002 deg of noise and the ranges with 0.03 mm. Everything here is plain geometry;
nothing of the estimator is used. LASER_MM below is the truth that the estimate should find.
"""

import json
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

SEED = 11
MOST_DRAWS = 100_000
JOINT_NOISE_DEG, RANGE_NOISE_MM = 0.002, 0.03
LASER_MM = np.eye(4)  # flange_T_laser; the beam is the z axis of the laser
LASER_MM[:3, :3] = Rotation.from_euler("xyz", [4.0, -7.0, 0.0], degrees=True).as_matrix()
LASER_MM[:3, 3] = [62.0, -18.0, 45.0]
PLATE_MM = np.eye(4)  # base_T_plane; the plate is z = 0
PLATE_MM[:3, :3] = Rotation.from_euler("xyz", [2.0, -3.0, 0.0], degrees=True).as_matrix()
PLATE_MM[:3, 3] = [640.0, 0.0, 440.0]
DH = (  # theta / deg, d / mm, a / mm, alpha / deg
    (0.0, 400.0, 25.0, -90.0),
    (-90.0, 0.0, 455.0, 0.0),
    (0.0, 0.0, 35.0, -90.0),
    (0.0, 420.0, 0.0, 90.0),
    (0.0, 0.0, 0.0, -90.0),
    (0.0, 80.0, 0.0, 0.0),
)
MIDDLE_DEG = np.array([0.0, 20.0, -5.0, 0.0, 75.0, 0.0])
SPREAD_DEG = np.array([15.0, 8.0, 8.0, 40.0, 25.0, 120.0])


def flange(joints_deg):
    """base_T_flange, mm."""
    pose = np.eye(4)
    for (theta, d, a, alpha), q in zip(DH, joints_deg, strict=True):
        link = np.eye(4)
        link[:3, :3] = Rotation.from_euler("ZX", [theta + q, alpha], degrees=True).as_matrix()
        turn = np.radians(theta + q)
        link[:3, 3] = [a * np.cos(turn), a * np.sin(turn), d]
        pose = pose @ link
    return pose


def measured(rng):
    """Joints (deg) and range (mm) as the devices say them, or None where the beam misses the plate."""
    joints = MIDDLE_DEG + SPREAD_DEG * rng.uniform(-1.0, 1.0, 6)
    laser = np.linalg.inv(PLATE_MM) @ flange(joints) @ LASER_MM  # in the plate
    range_mm = -laser[2, 3] / laser[2, 2]
    spot = laser[:2, 3] + range_mm * laser[:2, 2]
    if laser[2, 2] > -np.cos(np.radians(40.0)) or not 60.0 < range_mm < 260.0 or np.abs(spot).max() > 200.0:
        return None
    return joints + rng.normal(size=6) * JOINT_NOISE_DEG, range_mm + rng.normal() * RANGE_NOISE_MM


def dataset(count=40):
    """The data set; poses that miss the plate are drawn again."""
    rng = np.random.default_rng(SEED)
    drawn = (measured(rng) for _ in range(MOST_DRAWS))
    taken = list(islice((one for one in drawn if one is not None), count))
    if len(taken) < count:
        raise SystemExit(f"{len(taken)} of {MOST_DRAWS} poses meet the plate: move PLATE_MM or MIDDLE_DEG")
    return {
        "truecell_dataset": 1,
        "task": "point-laser-plane",
        "about": f"Simulated by make_hand_eye.py, seed {SEED}",
        "units": {"length": "mm", "angle": "deg"},
        "motion": {
            "kind": "joints",
            "arm": [
                {"theta": f"{theta:g} deg", "d": f"{d:g} mm", "a": f"{a:g} mm", "alpha": f"{alpha:g} deg"}
                for theta, d, a, alpha in DH
            ],
            "noise": f"{JOINT_NOISE_DEG} deg",
            "angles": [np.round(joints, 4).tolist() for joints, _ in taken],
        },
        "readings": [round(range_mm, 3) for _, range_mm in taken],
        "noise": f"{RANGE_NOISE_MM} mm",
    }


def text(content):
    """JSON with one row of numbers a line."""
    written = json.dumps(content, indent=2)
    for row in [*content["motion"]["angles"], *content["motion"]["arm"], content["readings"]]:
        for depth in (2, 6):
            spread = json.dumps(row, indent=2).replace("\n", "\n" + " " * depth)
            written = written.replace(spread, json.dumps(row))
    return written + "\n"


if __name__ == "__main__":
    Path(__file__).with_name("hand-eye.json").write_text(text(dataset()), encoding="utf-8")
