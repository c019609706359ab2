"""Writes kinematics-tracker.json: an arm that is not as its table says, followed by a laser tracker.

    python docs/examples/make_kinematics.py

A reflector sits on the flange, and a tracker that stands some metres away measures it at 50 poses. The joints
are read with 0.002 deg of noise, points with 0.01 mm and, across the beam, 0.0001 deg. The file holds the
nominal Denavit-Hartenberg table; ERRORS is by how much the arm deviates from it, which the estimate should
find. Everything here is plain geometry; nothing of the estimator is used.
"""

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

SEED, POSES = 7, 50
JOINT_NOISE_DEG, POINT_NOISE_MM, BEAM_NOISE_DEG = 0.002, 0.01, 0.0001
DH = {  # theta / deg, d / mm, a / mm, alpha / deg, beta / deg
    "theta": (0.0, -90.0, 0.0, 0.0, 0.0, 0.0),
    "d": (400.0, 0.0, 0.0, 420.0, 0.0, 80.0),
    "a": (25.0, 455.0, 35.0, 0.0, 0.0, 0.0),
    "alpha": (-90.0, 0.0, -90.0, 90.0, -90.0, 0.0),
    "beta": (0.0,) * 6,
}
ERRORS = {  # deg and mm; what a reflector and a tracker cannot tell is left out
    "a1": 0.42, "alpha1": 0.031, "theta2": -0.12, "a2": -0.35, "alpha2": 0.018, "beta2": -0.025,
    "theta3": 0.21, "d3": 0.28, "a3": 0.16, "alpha3": -0.04, "theta4": -0.09, "d4": 0.51, "a4": -0.12,
    "alpha4": 0.022, "theta5": 0.15, "d5": -0.08, "a5": 0.1, "alpha5": -0.017,
}  # fmt: skip
REFLECTOR_MM = np.array([55.0, -30.0, 45.0])  # on the flange
TRACKER_MM = np.eye(4)  # base_T_tracker
TRACKER_MM[:3, :3] = Rotation.from_euler("xyz", [1.0, -2.0, 140.0], degrees=True).as_matrix()
TRACKER_MM[:3, 3] = [2400.0, -900.0, 350.0]
SPREAD_DEG = np.array([150.0, 60.0, 60.0, 160.0, 100.0, 170.0])


def flange(table, joints_deg):
    """base_T_flange, mm: links Rz(theta + q) Tz(d) Tx(a) Rx(alpha) Ry(beta)."""
    pose = np.eye(4)
    for joint, q in enumerate(joints_deg):
        theta, d, a, alpha, beta = (table[name][joint] for name in ("theta", "d", "a", "alpha", "beta"))
        link = np.eye(4)
        link[:3, :3] = Rotation.from_euler("ZXY", [theta + q, alpha, beta], degrees=True).as_matrix()
        turn = np.radians(theta + q)
        link[:3, 3] = [a * np.cos(turn), a * np.sin(turn), d]
        pose = pose @ link
    return pose


def true_table():
    """The table with its errors."""
    table = {name: list(values) for name, values in DH.items()}
    for label, error in ERRORS.items():
        table[label[:-1]][int(label[-1]) - 1] += error
    return table


def measured(rng, joints_deg):
    """The reflector as the tracker says it, mm."""
    point = flange(true_table(), joints_deg + rng.normal(size=6) * JOINT_NOISE_DEG) @ [*REFLECTOR_MM, 1.0]
    seen = (np.linalg.inv(TRACKER_MM) @ point)[:3]
    turn = Rotation.from_rotvec(rng.normal(size=3) * np.radians(BEAM_NOISE_DEG))
    return turn.apply(seen) + rng.normal(size=3) * POINT_NOISE_MM


def dataset():
    """The data set."""
    rng = np.random.default_rng(SEED)
    joints = [SPREAD_DEG * rng.uniform(-1.0, 1.0, 6) for _ in range(POSES)]
    return {
        "truecell_dataset": 1,
        "task": "kinematics-tracker",
        "about": f"Simulated by make_kinematics.py, seed {SEED}",
        "units": {"length": "mm", "angle": "deg"},
        "motion": {
            "kind": "joints",
            "arm": [
                {
                    name: f"{DH[name][i]:g} {'mm' if name in 'da' else 'deg'}"
                    for name in ("theta", "d", "a", "alpha")
                }
                for i in range(6)
            ],
            "noise": f"{JOINT_NOISE_DEG} deg",
            "angles": [np.round(row, 4).tolist() for row in joints],
        },
        "points": [np.round(measured(rng, np.round(row, 4)), 4).tolist() for row in joints],
        "pose": list(range(POSES)),
        "marker": [0] * POSES,
        "noise": f"{POINT_NOISE_MM} mm",
        "angle_noise": f"{BEAM_NOISE_DEG:.4f} deg",
    }


def text(content):
    """JSON with one row of numbers a line."""
    written = json.dumps(content, indent=2)
    rows = [*content["motion"]["angles"], *content["motion"]["arm"], *content["points"]]
    for row in [*rows, content["pose"], content["marker"]]:
        for depth in (2, 4, 6):
            spread = json.dumps(row, indent=2).replace("\n", "\n" + " " * depth)
            written = written.replace(spread, json.dumps(row))
    return written + "\n"


if __name__ == "__main__":
    Path(__file__).with_name("kinematics-tracker.json").write_text(text(dataset()), encoding="utf-8")
