"""Random cells for coverage campaigns: geometry, declared uncertainties, measurements, and the hidden truth.

    python -m simulators.world.random_cells --first 0 --count 10

prints one JSON object a line. Everything is drawn from the seed; `docs/evidence.md` lists the distributions.
Kinematics and rays are written here once more, so that a mistake of the estimator cannot hide in them.
"""

import argparse
import json
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimation.transform import FloatArray, exp_pose

DEG: Final = np.pi / 180
# theta, d, a, alpha, beta of a six-axis arm with spherical wrist, for lengths of scale 1; m, rad
ARM: Final = np.array(
    [
        [180 * DEG, 0.26, 0.0, 90 * DEG, 0.0],
        [90 * DEG, 0.0, 0.35, 180 * DEG, 0.0],
        [90 * DEG, 0.0, 0.0, 90 * DEG, 0.0],
        [180 * DEG, 0.307, 0.0, 90 * DEG, 0.0],
        [0.0, 0.0, 0.0, -90 * DEG, 0.0],
        [0.0, 0.084, 0.0, 0.0, 0.0],
    ]
)
PARAMETERS: Final = ("theta", "d", "a", "alpha", "beta")
# What remains after the gauge: joint 1 defines the base, the last link belongs to the tool, d2 duplicates d3.
FREE: Final = tuple(
    (joint, name)
    for joint, names in enumerate(
        (
            ("a", "alpha"),
            ("theta", "a", "alpha", "beta"),
            ("theta", "d", "a", "alpha"),
            ("theta", "d", "a", "alpha"),
            ("theta", "d", "a", "alpha"),
        )
    )
    for name in names
)
LIMITS_RAD: Final = np.array([170, 145, 135, 170, 170, 179]) * DEG
RANGES_M: Final = (0.06, 0.11)
MOST_TILT_RAD: Final = 28 * DEG
BAR_TILT_RAD: Final = 45 * DEG
FACES: Final = {"top": (2, 1), "front": (1, -1), "back": (1, 1), "left": (0, -1), "right": (0, 1)}
LEAST_BAR_POINTS: Final = 20
REPEATED: Final = 8  # plate poses that are measured again in the check


def draw_cell(seed: int) -> dict[str, Any]:
    """One cell: what is declared, what was measured, and the truth. Lengths in m, angles in rad.

    An object that this arm cannot measure where it stands is placed again, before any error is drawn.
    """
    random = np.random.default_rng([seed, 20031])
    declared = _declared(random)
    joints = {
        name: _reached(random, declared, name, place)
        for name, place in (("plate", _plate_poses), ("bar", _bar_poses), ("part", _part_poses))
    }
    return {"seed": seed, "declared": declared, **_measured(random, declared, joints)}


def _declared(random: np.random.Generator) -> dict[str, Any]:
    """Geometry and standard uncertainties; the objects are placed later."""
    size = random.uniform(0.8, 1.6)  # of the arm
    angle, length = _log_uniform(random, 0.003, 0.02) * DEG, _log_uniform(random, 0.03e-3, 0.2e-3)
    mount = exp_pose(
        np.concatenate(
            [random.uniform(-0.1, 0.1, 2), random.uniform([0.03], [0.12]), random.uniform(-0.3, 0.3, 3)]
        )
    )
    edges = random.uniform(0.06, 0.2, 3)
    names = [name for name in FACES if name in ("top", "front", "left") or random.random() < 0.6]
    return {
        "size": size,
        "table": (ARM * np.array([1.0, size, size, 1.0, 1.0])).tolist(),
        "free": [f"{name}{joint + 1}" for joint, name in FREE],
        "kinematics_std": [length if name in ("a", "d") else angle for _, name in FREE],
        "joint_std": _log_uniform(random, 0.0005, 0.003) * DEG,
        "range_std": _log_uniform(random, 0.01e-3, 0.06e-3),
        "scale_std": _log_uniform(random, 1e-4, 5e-4),
        "offset_std": _log_uniform(random, 0.01e-3, 0.05e-3),
        "laser": mount.tolist(),
        "laser_std": [random.uniform(0.5e-3, 2e-3), random.uniform(0.2, 0.7) * DEG],
        "plate_std": [random.uniform(1e-3, 5e-3), random.uniform(0.2, 1.0) * DEG],
        "bar_std": [random.uniform(0.2e-3, 1e-3), random.uniform(0.1, 0.3) * DEG],
        "part_std": [random.uniform(1e-3, 5e-3), random.uniform(0.2, 1.0) * DEG],
        "bar_length": random.uniform(0.1, 0.3),
        "bar_length_std": 3e-6,
        "bar_radius": 0.015,
        "bar_radius_std": 1e-6,
        "faces": {name: _face(name, edges) for name in names},
        "edges": edges.tolist(),
        "form_std": random.uniform(0.0, 0.03e-3),
        "plate_count": int(random.integers(40, 121)),
        "part_count": int(random.integers(12, 49)),
    }


def _reached(
    random: np.random.Generator, declared: dict[str, Any], name: str, poses: Any
) -> tuple[FloatArray, NDArray[np.intp]]:
    """Place an object where the arm can measure it; joints (m, 6) and the sphere or face of each."""
    while True:
        declared[name] = _around(random, declared["size"], lying=name == "bar").tolist()
        frames, index, enough, most = poses(random, declared, np.array(declared[name]))
        joints, reached = _inverse(np.array(declared["table"]), frames @ np.linalg.inv(declared["laser"]))
        joints, index = joints[reached][:most], index[reached][:most]
        if len(joints) >= enough and (name == "plate" or len(np.unique(index)) == index.max() + 1):
            return joints, index


def _around(random: np.random.Generator, size: float, lying: bool) -> FloatArray:
    """A place around the arm, for its length scale; a lying bar has its z along the ground."""
    azimuth, radius = random.uniform(-2.5, 2.5), size * random.uniform(0.42, 0.58)
    pose, turn = np.eye(4), random.uniform(-np.pi, np.pi)
    angles = [turn, np.pi / 2] if lying else [turn, 0.0]
    pose[:3, :3] = Rotation.from_euler("ZY", angles).as_matrix()
    pose[:3, 3] = [-radius * np.cos(azimuth), -radius * np.sin(azimuth), random.uniform(0.0, 0.15)]
    return pose


def _face(name: str, edges: FloatArray) -> list[list[float]]:
    """A point in the middle of a face of the block, and its outward normal."""
    axis, sign = FACES[name]
    normal = sign * np.eye(3)[axis]
    return [(edges / 2 + normal * edges / 2).tolist(), normal.tolist()]


Poses = tuple[FloatArray, NDArray[np.intp], int, int]  # laser frames, what each is on, least and most of them


def _plate_poses(random: np.random.Generator, declared: dict[str, Any], plate: FloatArray) -> Poses:
    """Twice as many as are wanted; eight of them for the check."""
    wanted = declared["plate_count"] + REPEATED
    spot = np.column_stack([random.uniform(-0.13, 0.13, (2 * wanted, 2)), np.zeros(2 * wanted)])
    frames = _aimed(random, _moved(plate, spot), np.tile(plate[:3, 2], (2 * wanted, 1)))
    return frames, np.zeros(2 * wanted, dtype=np.intp), wanted, wanted


def _bar_poses(_: np.random.Generator, declared: dict[str, Any], bar: FloatArray) -> Poses:
    frames, sphere = _bar_frames(bar, declared["bar_length"])
    return frames, sphere, LEAST_BAR_POINTS, len(frames)


def _part_poses(random: np.random.Generator, declared: dict[str, Any], part: FloatArray) -> Poses:
    wanted, faces = declared["part_count"], list(declared["faces"].values())
    face = random.integers(0, len(faces), 3 * wanted)
    middle, normal = (np.array([each[j] for each in faces])[face] for j in (0, 1))
    inside = random.uniform(-0.4, 0.4, (*face.shape, 3)) * declared["edges"] * (1.0 - np.abs(normal))
    frames = _aimed(random, _moved(part, middle + inside), normal @ part[:3, :3].T)
    return frames, face, wanted, wanted


def _measured(
    random: np.random.Generator,
    declared: dict[str, Any],
    joints: dict[str, tuple[FloatArray, NDArray[np.intp]]],
) -> dict[str, Any]:
    """The errors of this cell, and what its devices say with them. Half of the cells are bumped."""
    (q_plate, _), (q_bar, sphere), (q_part, face) = (joints[name] for name in ("plate", "bar", "part"))
    table = np.array(declared["table"])
    error = random.standard_normal(len(FREE)) * declared["kinematics_std"]
    for value, (joint, name) in zip(error, FREE, strict=True):
        table[joint, PARAMETERS.index(name)] += value
    shift, turn = declared["laser_std"]
    laser = np.array(declared["laser"]) @ exp_pose(
        random.standard_normal(6) * [shift, shift, shift, turn, turn, 0.0]
    )
    bump = np.zeros(6)
    if random.random() < 0.5:
        bump[:5] = random.uniform(-1, 1, 5) * [1e-3, 1e-3, 1e-3, 0.5 * DEG, 0.5 * DEG]
    scale = random.standard_normal() * declared["scale_std"]
    offset = random.standard_normal() * declared["offset_std"]
    # only what a plane or a bar can show is in error; a part lies off in all six freedoms
    plate = _placed(random, declared, "plate", [0, 0, 1, 1, 1, 0])
    bar = _placed(random, declared, "bar", [1, 1, 1, 1, 1, 0])
    part = _placed(random, declared, "part", [1, 1, 1, 1, 1, 1])
    length = declared["bar_length"] + random.standard_normal() * declared["bar_length_std"]
    radius = declared["bar_radius"] + random.standard_normal() * declared["bar_radius_std"]
    faces = list(declared["faces"].values())
    form = random.standard_normal(len(faces)) * declared["form_std"]

    def says(
        q: FloatArray, mount: FloatArray, distance: Any, index: NDArray[np.intp] | None = None
    ) -> dict[str, Any]:
        beam = _flange(table, q) @ mount
        reading = (distance(beam[:, :3, 3], beam[:, :3, 2]) - offset) / (1.0 + scale)
        reading = reading + declared["range_std"] * random.standard_normal(len(q))
        noisy = q + declared["joint_std"] * random.standard_normal(q.shape)
        seen = np.isfinite(reading)  # a beam may miss a sphere
        answer = {"joints": noisy[seen].tolist(), "readings": reading[seen].tolist()}
        return answer if index is None else {**answer, "index": index[seen].tolist()}

    def to_plate(origin: FloatArray, beam: FloatArray) -> FloatArray:
        return _to_plane(origin, beam, plate[:3, 3], plate[:3, 2])

    def to_bar(origin: FloatArray, beam: FloatArray) -> FloatArray:
        return _to_sphere(origin, beam, _moved(bar, sphere[:, None] * np.array([0.0, 0.0, length])), radius)

    point, normal = (np.array([each[j] for each in faces])[face] for j in (0, 1))
    point = point + form[face, None] * normal

    def to_part(origin: FloatArray, beam: FloatArray) -> FloatArray:
        return _to_plane(origin, beam, _moved(part, point), normal @ part[:3, :3].T)

    bumped = laser @ exp_pose(bump)
    return {
        "plate": says(q_plate[:-REPEATED], laser, to_plate),
        "plate_again": says(q_plate[-REPEATED:], bumped, to_plate),
        "bar": says(q_bar, bumped, to_bar, sphere),
        "part": says(q_part, laser, to_part, face),
        "truth": {
            "laser": laser.tolist(),
            "bump": bump[:5].tolist(),
            "plate": plate.tolist(),
            "part": part.tolist(),
        },
    }


def _placed(random: np.random.Generator, declared: dict[str, Any], name: str, free: list[int]) -> FloatArray:
    shift, turn = declared[f"{name}_std"]
    xi = random.standard_normal(6) * [shift, shift, shift, turn, turn, turn] * free
    return np.asarray(np.array(declared[name]) @ exp_pose(xi))


def _to_plane(origin: FloatArray, beam: FloatArray, point: FloatArray, normal: FloatArray) -> FloatArray:
    normal = np.broadcast_to(normal, origin.shape)
    return np.asarray(np.sum((point - origin) * normal, axis=1) / np.sum(beam * normal, axis=1))


def _to_sphere(origin: FloatArray, beam: FloatArray, centre: FloatArray, radius_m: float) -> FloatArray:
    along = np.sum((centre - origin) * beam, axis=1)
    depth2 = radius_m**2 - np.sum((centre - origin) ** 2, axis=1) + along**2
    return np.asarray(along - np.sqrt(np.where(depth2 > 0.0, depth2, np.nan)))


def _bar_frames(bar: FloatArray, length_m: float) -> tuple[FloatArray, NDArray[np.intp]]:
    """Five orientations by four points on each sphere, 5 mm off the line to its centre; and which sphere."""
    frames, sphere = [], []
    up, along = np.array([[0.0, 0.0, 1.0]]), np.array([0.1])
    for which in (0, 1):
        centre = _moved(bar, np.array([[0.0, 0.0, length_m * which]]))
        for tilt, azimuth, spin in ((1, 0, 0), (1, 120, 0), (1, 240, 0), (0, 0, 0), (0, 0, 180)):
            angles = (np.array([value]) for value in (tilt * BAR_TILT_RAD, azimuth * DEG, spin * DEG))
            frame = _frames(centre, up, along, *angles)[0]
            for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                moved = frame.copy()
                moved[:3, 3] += 0.005 * (frame[:3, 0] * x + frame[:3, 1] * y)
                frames.append(moved)
                sphere.append(which)
    return np.array(frames), np.array(sphere, dtype=np.intp)


def _aimed(random: np.random.Generator, point: FloatArray, normal: FloatArray) -> FloatArray:
    """base_T_laser at random tilt, azimuth, spin and range, onto points (m, 3) with outward normals."""
    m = len(point)
    return _frames(
        point,
        normal,
        random.uniform(*RANGES_M, m),
        MOST_TILT_RAD * np.sqrt(random.random(m)),
        random.uniform(-np.pi, np.pi, m),
        random.uniform(-np.pi, np.pi, m),
    )


def _frames(
    point: FloatArray,
    normal: FloatArray,
    range_m: FloatArray,
    tilt: FloatArray,
    azimuth: FloatArray,
    spin: FloatArray,
) -> FloatArray:
    """(m, 4, 4) with +z along the beam, tilted off the inward normal."""
    inward = -normal
    helper = np.where(np.abs(inward[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    y = np.cross(inward, helper)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    square = np.stack([np.cross(y, inward), y, inward], axis=2)
    frames = np.tile(np.eye(4), (len(point), 1, 1))
    frames[:, :3, :3] = (
        square @ Rotation.from_euler("ZYZ", np.column_stack([azimuth, tilt, spin])).as_matrix()
    )
    frames[:, :3, 3] = point - range_m[:, None] * frames[:, :3, 2]
    return frames


def _inverse(table: FloatArray, goals: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Joints (m, 6) that bring the flange to `goals`, elbow up, and whether they do within the limits.

    Closed form for the nominal arm: two links in a vertical plane reach the wrist, whose axes meet.
    """
    d1, upper, fore, d6 = table[0, 1], table[1, 2], table[3, 1], table[5, 1]
    wrist = goals[:, :3, 3] - d6 * goals[:, :3, 2]
    radial, height = np.hypot(wrist[:, 0], wrist[:, 1]), wrist[:, 2] - d1
    cos_elbow = (radial**2 + height**2 - upper**2 - fore**2) / (2 * upper * fore)
    elbow = np.arccos(np.clip(cos_elbow, -1.0, 1.0))
    rise = np.arctan2(height, radial) + np.arctan2(fore * np.sin(elbow), upper + fore * np.cos(elbow))
    q = np.zeros((len(goals), 6))
    q[:, 0] = _wrapped(np.arctan2(wrist[:, 1], wrist[:, 0]) - np.pi)  # at q = 0 the arm reaches to -x
    q[:, 1], q[:, 2] = rise - np.pi / 2, elbow
    hand = _flange(table[:3], q[:, :3])[:, :3, :3].swapaxes(1, 2) @ goals[:, :3, :3]
    sine = np.hypot(hand[:, 0, 2], hand[:, 1, 2])
    both = []
    for sign in (1.0, -1.0):  # hand = Rz(180 deg + q4) Ry(-q5) Rz(q6)
        q[:, 3] = _wrapped(np.arctan2(sign * hand[:, 1, 2], sign * hand[:, 0, 2]) - np.pi)
        q[:, 4] = -np.arctan2(sign * sine, hand[:, 2, 2])
        q[:, 5] = np.arctan2(sign * hand[:, 2, 1], -sign * hand[:, 2, 0])
        both.append(q.copy())
    allowed = np.logical_and.reduce(np.abs(both) < LIMITS_RAD, axis=2)
    q = np.where(allowed[0][:, None], both[0], both[1])
    reached = np.abs(_flange(table, q) - goals).max(axis=(1, 2)) < 1e-9
    return q, allowed.any(axis=0) & reached


def _wrapped(angle: FloatArray) -> FloatArray:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def _flange(table: FloatArray, q: FloatArray) -> FloatArray:
    """base_T_flange (m, 4, 4): Rz(theta + q) Tz(d) Tx(a) Rx(alpha) Ry(beta) for each link."""
    pose = np.eye(4)
    for (theta, d, a, alpha, beta), angle in zip(table, q.T, strict=True):
        turn = np.zeros((len(q), 4, 4))
        turn[:, 0, 0] = turn[:, 1, 1] = np.cos(theta + angle)
        turn[:, 1, 0] = np.sin(theta + angle)
        turn[:, 0, 1] = -turn[:, 1, 0]
        turn[:, 2, 2] = turn[:, 3, 3] = 1.0
        rest = np.eye(4)
        rest[:3, :3] = Rotation.from_euler("XY", [alpha, beta]).as_matrix()
        rest[:3, 3] = [a, 0.0, d]
        pose = pose @ turn @ rest
    return pose


def _moved(pose: FloatArray, points: FloatArray) -> FloatArray:
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def _log_uniform(random: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def draw_cells(first: int, count: int) -> Iterator[dict[str, Any]]:
    """Cells of consecutive seeds."""
    for seed in range(first, first + count):
        yield draw_cell(seed)


def main() -> None:
    """Print the cells."""
    parser = argparse.ArgumentParser(prog="python -m simulators.world.random_cells", description=__doc__)
    parser.add_argument("--first", type=int, default=0, help="seed of the first cell")
    parser.add_argument("--count", type=int, default=1, help="number of cells")
    arguments = parser.parse_args()
    for cell in draw_cells(arguments.first, arguments.count):
        print(json.dumps(cell), flush=True)


if __name__ == "__main__":
    main()
