"""Draws what is really in the cell: every error from one seed, each from a stream of its own name."""

import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimation.transform import FloatArray, exp_pose
from simulators.world.world_file import LINK_PARAMETERS, Placement, WorldFile


@dataclass(frozen=True, slots=True, eq=False)
class FaceDeviation:
    """How one face of the part differs from its CAD."""

    offset_m: float  # plane: outward along its normal; cylinder: growth of the radius
    shift_m: FloatArray  # (3,) in the part frame
    waviness_m: float  # amplitude
    wavelength_m: float
    phases_rad: FloatArray  # (2,) of the waves along the two directions of the face


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The cell as it is. Poses are (4, 4) matrices a_T_b, metres."""

    seed: int
    link_parameters: FloatArray  # (n, 5) theta, d, a, alpha, beta
    link_errors: dict[str, float]  # by label, "a1" being that of the first link; m, rad
    flange_T_laser: FloatArray
    laser_scale: float  # true distance = (1 + scale) * reading + offset
    laser_offset_m: float
    flange_T_probe: FloatArray
    probe_radius_m: float
    base_T_plate: FloatArray
    base_T_bar: FloatArray
    bar_length_m: float
    bar_radii_m: FloatArray  # (2,)
    base_T_sphere: FloatArray
    sphere_radius_m: float
    base_T_part: FloatArray
    features: dict[str, FaceDeviation]
    deviations: dict[str, FloatArray]  # (6,) [t; phi] of each placement from its nominal pose

    def to_json(self) -> dict[str, Any]:
        """Everything, as plain values; blocks are named as in the estimate. SI units."""
        poses = {
            "laser": self.flange_T_laser,
            "probe": self.flange_T_probe,
            "plate": self.base_T_plate,
            "bar": self.base_T_bar,
            "sphere": self.base_T_sphere,
            "part": self.base_T_part,
        }
        scalars = {
            "laser.scale": self.laser_scale,
            "laser.offset": self.laser_offset_m,
            "probe.radius": self.probe_radius_m,
            "bar.length": self.bar_length_m,
            "bar.radius": float(self.bar_radii_m.mean()),
            "sphere.radius": self.sphere_radius_m,
        }
        features = {
            f"part.{name}": {
                "offset": face.offset_m,
                "shift_x": float(face.shift_m[0]),
                "shift_y": float(face.shift_m[1]),
                "shift_z": float(face.shift_m[2]),
                "flatness": 2.0 * face.waviness_m,  # crest to trough
            }
            for name, face in self.features.items()
        }
        return {
            "seed": self.seed,
            "kinematics": self.link_errors,
            "link_parameters": self.link_parameters.tolist(),
            "poses": {name: matrix.tolist() for name, matrix in poses.items()},
            "deviations": {name: xi.tolist() for name, xi in self.deviations.items()},
            "scalars": scalars,
            "features": features,
        }


def stream(seed: int, name: str) -> np.random.Generator:
    """The random numbers of one purpose: another purpose, added or taken away, does not shift them."""
    return np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(name.encode())]))


def _limited(vector: FloatArray, limit: float) -> FloatArray:
    norm = float(np.linalg.norm(vector))
    return vector if norm <= limit else vector * (limit / norm)


def draw_truth(world: WorldFile, seed: int, error_factor: float = 1.0) -> Truth:
    """The truth that belongs to `seed`; `error_factor` 0 is the nominal cell, for tests."""

    def normal(name: str, sigma: float, size: int = 1) -> FloatArray:
        return stream(seed, f"truth.{name}").standard_normal(size) * (sigma * error_factor)

    deviations: dict[str, FloatArray] = {}

    def placed(name: str, placement: Placement) -> FloatArray:
        position = normal(f"{name}.position", placement.position_sigma_m, 3)
        rotation = normal(f"{name}.rotation", placement.rotation_sigma_rad, 3)
        position = _limited(position, placement.position_limit_m)
        xi = np.concatenate([position, _limited(rotation, placement.rotation_limit_rad)])
        deviations[name] = xi
        return placement.nominal.matrix @ exp_pose(xi)

    names = [name for name, _ in LINK_PARAMETERS]
    parameters = np.array([[link.values[name] for name in names] for link in world.arm.links])
    errors: dict[str, float] = {}
    for row, link in enumerate(world.arm.links):
        for name, sigma in link.sigmas.items():
            label = f"{name}{row + 1}"
            errors[label] = float(normal(f"kinematics.{label}", sigma)[0])
            parameters[row, names.index(name)] += errors[label]

    features = {
        spec.name: FaceDeviation(
            offset_m=float(normal(f"part.{spec.name}.offset", spec.offset_sigma_m)[0]),
            shift_m=normal(f"part.{spec.name}.shift", spec.shift_sigma_m, 3) * (1, 1, 0),
            waviness_m=spec.waviness_m * min(error_factor, 1.0),
            wavelength_m=spec.wavelength_m,
            phases_rad=stream(seed, f"truth.part.{spec.name}.waviness").uniform(0, 2 * np.pi, 2),
        )
        for spec in world.part.features
    }
    laser, probe, bar, sphere = world.laser, world.probe, world.bar, world.sphere
    bar_radius_m = bar.sphere_radius_m + normal("bar.radius", bar.sphere_radius_sigma_m)[0]
    return Truth(
        seed=seed,
        link_parameters=parameters,
        link_errors=errors,
        flange_T_laser=placed("laser", laser.mount),
        laser_scale=float(normal("laser.scale", laser.scale_sigma)[0]),
        laser_offset_m=float(normal("laser.offset", laser.offset_sigma_m)[0]),
        flange_T_probe=placed("probe", probe.mount),
        probe_radius_m=probe.ball_radius_m + float(normal("probe.radius", probe.ball_radius_sigma_m)[0]),
        base_T_plate=placed("plate", world.plate.placement),
        base_T_bar=placed("bar", bar.placement),
        bar_length_m=bar.length_m + float(normal("bar.length", bar.length_sigma_m)[0]),
        bar_radii_m=np.array([bar_radius_m, bar_radius_m]),
        base_T_sphere=placed("sphere", sphere.placement),
        sphere_radius_m=sphere.radius_m + float(normal("sphere.radius", sphere.radius_sigma_m)[0]),
        base_T_part=placed("part", world.part.placement),
        features=features,
        deviations=deviations,
    )
