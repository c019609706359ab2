"""Random parts and cells for planning: a stepped block as a mesh, placed, sized and fixtured at random.

Geometry and noise are drawn so that independent noise decides the localization; what limits it otherwise
(kinematics, hand-eye) no choice of points can cure.
"""

import re
from pathlib import Path

import numpy as np
import trimesh

from controller.cellfile import Cell, load_cell
from estimation.transform import FloatArray
from tests.controller.planning.planned import CELL

MM = 1e3
FACES = ("top", "front", "back", "left", "right")
STEP = 0.6  # share of length and height at which the block is stepped

PART = """
[part]
name = "stepped"
cad = "part.stl"
cad_unit = "mm"
parent = "base"
xyz = [{xyz}]
rpy = ["0 deg", "0 deg", "{yaw:.4f} deg"]
position_u = "{position:.4f} mm"
rotation_u = "{rotation:.4f} deg"
position_limit = "{position3:.4f} mm"
rotation_limit = "{rotation3:.4f} deg"
{features}
[job]
[[job.phases]]
name = "hand-eye"
kind = "hand_eye"
measurements = 80
most_measurements = 160
limit = "0.40 mm"
gated_ranges = ["60 mm", "85 mm", "110 mm"]
expires = "30 days"

[[job.phases]]
name = "localize"
kind = "localize"
measurements = {measurements}
most_measurements = {most}
faces = [{faces}]
limit = "{limit:.6f} mm"
gated_points = "corners"
expires = "1 day"
"""


def stepped_block(size_mm: FloatArray) -> trimesh.Trimesh:
    """A block with a step along its second edge; one corner at the origin."""
    block = trimesh.creation.box(bounds=[np.zeros(3), size_mm])
    cut = trimesh.creation.box(
        bounds=[[STEP * size_mm[0], -1.0, STEP * size_mm[2]], [size_mm[0] + 1.0, size_mm[1] + 1.0, 1e3]]
    )
    return trimesh.boolean.difference([block, cut], engine="manifold")


def write_cell(
    folder: Path,
    seed: int,
    limit_mm: float = 10.0,
    measurements: int = 24,
    most: int = 60,
    quiet: bool = True,
) -> Path:
    """A cell folder; `quiet` declares everything but noise as nearly known. The same seed, the same cell."""
    random = np.random.default_rng([seed, 5])
    size = random.uniform(60.0, 160.0, 3)
    stepped_block(size).export(folder / "part.stl")
    reach, azimuth = random.uniform(430.0, 560.0), np.radians(random.uniform(-120.0, -55.0))
    yaw = random.uniform(-180.0, 180.0)
    turn = np.array(
        [
            [np.cos(np.radians(yaw)), -np.sin(np.radians(yaw))],
            [np.sin(np.radians(yaw)), np.cos(np.radians(yaw))],
        ]
    )
    corner = reach * np.array([np.cos(azimuth), np.sin(azimuth)]) - turn @ size[:2] / 2
    position, rotation = random.uniform(0.1, 0.5), random.uniform(0.05, 0.2)
    places = {
        "top": (0.3, 0.5, 1.0),
        "front": (0.3, 0.0, 0.3),
        "back": (0.3, 1.0, 0.3),
        "left": (0.0, 0.5, 0.5),
        "right": (1.0, 0.5, 0.3),
    }
    features = "".join(
        f'\n[[part.features]]\nname = "{name}"\nat = [{_lengths(np.array(at) * size)}]\n'
        for name, at in places.items()
    )
    text = (CELL / "cell.toml").read_text(encoding="utf-8")
    text = text[: text.index("[part]")]
    joint, laser = np.exp(random.uniform(np.log([0.001, 0.02]), np.log([0.004, 0.08])))
    text = text.replace('joint_noise = "0.0015 deg"', f'joint_noise = "{joint:.6f} deg"')
    text = text.replace('\nnoise = "0.03 mm"', f'\nnoise = "{laser:.6f} mm"')
    if quiet:
        text = re.sub(r"^((?:theta|alpha|beta)_u) = .*$", r'\1 = "0.0001 deg"', text, flags=re.MULTILINE)
        text = re.sub(r"^([ad]_u) = .*$", r'\1 = "0.001 mm"', text, flags=re.MULTILINE)
        text = text.replace('scale_u = "0.02 %"', 'scale_u = "0.001 %"')
        text = text.replace('offset_u = "0.02 mm"', 'offset_u = "0.001 mm"')
        text = text.replace(
            'position_u = "2 mm"\nrotation_u = "0.7 deg"',
            'position_u = "0.002 mm"\nrotation_u = "0.0005 deg"',
        )
    part = PART.format(
        xyz=_lengths(np.array([*corner, random.uniform(80.0, 140.0)])),
        yaw=yaw,
        position=position,
        rotation=rotation,
        position3=3.0 * position,
        rotation3=3.0 * rotation,
        features=features,
        measurements=measurements,
        most=most,
        faces=", ".join(f'"{name}"' for name in FACES),
        limit=limit_mm,
    )
    (folder / "cell.toml").write_text(text + part, encoding="utf-8")
    return folder


def random_cell(folder: Path, seed: int) -> Cell:
    return load_cell(write_cell(folder, seed))


def _lengths(values_mm: FloatArray) -> str:
    return ", ".join(f'"{value:.6f} mm"' for value in values_mm)
