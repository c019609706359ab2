"""Reads world.toml: what is in the simulated cell, where it is meant to stand, and how far it may err."""

import math
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from estimation.errors import CellFileError
from estimation.transform import FloatArray, Transform
from simulators.world.toml_table import StrictTable

LINK_PARAMETERS: Final = (
    ("theta", "angle"),
    ("d", "length"),
    ("a", "length"),
    ("alpha", "angle"),
    ("beta", "angle"),
)


@dataclass(frozen=True, slots=True, eq=False)
class LinkSpec:
    """One link: nominal parameter values, and the standard deviation of the error of those that err."""

    values: dict[str, float]  # theta, d, a, alpha, beta; m, rad
    sigmas: dict[str, float]
    lower_rad: float
    upper_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """A nominal pose and the spread of its right perturbation."""

    nominal: Transform
    position_sigma_m: float
    rotation_sigma_rad: float = 0.0
    position_limit_m: float = math.inf
    rotation_limit_rad: float = math.inf


@dataclass(frozen=True, slots=True, eq=False)
class ArmSpec:
    nodes: tuple[int, ...]
    device_name: str
    serial_number: int
    speed_limit_rad_s: float
    acceleration_rad_s2: float
    quick_stop_rad_s2: float
    enable_delay_s: float
    boot_time_s: float
    fast_move_rad_s: float
    noise_rad: float
    encoder_step_rad: float
    start_joints_rad: FloatArray
    links: tuple[LinkSpec, ...]
    touch_probe: bool = False  # the stylus is wired to an input of every drive as well


@dataclass(frozen=True, slots=True, eq=False)
class LaserSpec:
    model: str
    serial_number: str
    article: str
    version: str
    baud: int
    range_start_m: float
    range_m: float
    max_incidence_rad: float
    point_noise_m: float
    reading_noise_m: float
    scale_sigma: float
    offset_sigma_m: float
    clock_drift: float
    latency_s: float
    mount: Placement


@dataclass(frozen=True, slots=True, eq=False)
class ProbeSpec:
    model: int
    channel: int
    reply_delay_s: float
    ball_radius_m: float
    ball_radius_sigma_m: float
    noise_m: float
    release_m: float
    mount: Placement


@dataclass(frozen=True, slots=True, eq=False)
class PlateSpec:
    placement: Placement
    size_m: FloatArray  # (2,)
    thickness_m: float
    flatness_m: float


@dataclass(frozen=True, slots=True, eq=False)
class BarSpec:
    placement: Placement
    sphere_radius_m: float
    sphere_radius_sigma_m: float
    length_m: float
    length_sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class SphereSpec:
    placement: Placement
    radius_m: float
    radius_sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class FeatureSpec:
    """A face of the part that deviates from its CAD; `at_m` is a point on it, in the part frame."""

    name: str
    at_m: FloatArray
    offset_sigma_m: float
    shift_sigma_m: float
    waviness_m: float
    wavelength_m: float


@dataclass(frozen=True, slots=True, eq=False)
class PartSpec:
    cad: Path
    placement: Placement
    features: tuple[FeatureSpec, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Scenario:
    """What a scenario changes in the world."""

    name: str
    part_present: bool = True
    joint_noise_factors: tuple[float, ...] = ()
    bump_translation_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    bump_rotation_rad: FloatArray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, slots=True, eq=False)
class WorldFile:
    """Everything in world.toml; SI units, frames base, flange, laser, probe, plate, bar, sphere, part."""

    name: str
    arm: ArmSpec
    laser: LaserSpec
    probe: ProbeSpec
    plate: PlateSpec
    bar: BarSpec
    sphere: SphereSpec
    part: PartSpec
    scenarios: dict[str, Scenario]


def _placement(table: StrictTable, target: str, source: str) -> Placement:
    nominal = Transform.from_xyz_rpy(
        target, source, table.vector("xyz", "length", 3), table.vector("rpy", "angle", 3)
    )
    return Placement(
        nominal,
        table.length("position_sigma"),
        table.number("rotation_sigma", "angle", 0.0),
        table.length("position_limit", math.inf),
        table.number("rotation_limit", "angle", math.inf),
    )


def _link(table: StrictTable) -> LinkSpec:
    values = {name: table.number(name, kind, 0.0) for name, kind in LINK_PARAMETERS}
    sigmas = {
        name: table.number(f"{name}_sigma", kind)
        for name, kind in LINK_PARAMETERS
        if table.has(f"{name}_sigma")
    }
    lower, upper = table.vector("limits", "angle", 2)
    table.end()
    return LinkSpec(values, sigmas, float(lower), float(upper))


def _arm(table: StrictTable) -> ArmSpec:
    nodes = tuple(int(node) for node in table.take("nodes"))
    spec = ArmSpec(
        nodes=nodes,
        device_name=table.text("device_name"),
        serial_number=table.integer("serial_number"),
        speed_limit_rad_s=table.number("speed_limit", "angular speed"),
        acceleration_rad_s2=table.number("acceleration", "angular acceleration"),
        quick_stop_rad_s2=table.number("quick_stop_deceleration", "angular acceleration"),
        enable_delay_s=table.number("enable_delay", "time"),
        boot_time_s=table.number("boot_time", "time"),
        fast_move_rad_s=table.number("fast_move", "angular speed"),
        noise_rad=table.number("noise", "angle"),
        encoder_step_rad=table.number("encoder_step", "angle"),
        start_joints_rad=table.vector("start_joints", "angle", len(nodes)),
        links=tuple(_link(item) for item in table.tables("links")),
        touch_probe=table.has("touch_probe") and bool(table.take("touch_probe")),
    )
    if len(spec.links) != len(nodes):
        raise CellFileError(f"{len(nodes)} arm nodes, {len(spec.links)} links", "Give one link per node")
    table.end()
    return spec


def _laser(table: StrictTable) -> LaserSpec:
    mount = table.table("mount")
    spec = LaserSpec(
        model=table.text("model"),
        serial_number=table.text("serial_number"),
        article=table.text("article"),
        version=table.text("version"),
        baud=table.integer("baud"),
        range_start_m=table.length("range_start"),
        range_m=table.length("range"),
        max_incidence_rad=table.number("max_incidence", "angle"),
        point_noise_m=table.length("point_noise"),
        reading_noise_m=table.length("reading_noise"),
        scale_sigma=table.number("scale_sigma", "ratio"),
        offset_sigma_m=table.length("offset_sigma"),
        clock_drift=table.number("clock_drift", "ratio"),
        latency_s=table.number("latency", "time"),
        mount=_placement(mount, "flange", "laser"),
    )
    mount.end()
    table.end()
    return spec


def _probe(table: StrictTable) -> ProbeSpec:
    mount = table.table("mount")
    spec = ProbeSpec(
        model=table.integer("model"),
        channel=table.integer("channel"),
        reply_delay_s=table.number("reply_delay", "time"),
        ball_radius_m=table.length("ball_radius"),
        ball_radius_sigma_m=table.length("ball_radius_sigma"),
        noise_m=table.length("noise"),
        release_m=table.length("release"),
        mount=_placement(mount, "flange", "probe"),
    )
    mount.end()
    table.end()
    return spec


def _feature(table: StrictTable) -> FeatureSpec:
    spec = FeatureSpec(
        name=table.text("name"),
        at_m=table.vector("at", "length", 3),
        offset_sigma_m=table.length("offset_sigma"),
        shift_sigma_m=table.length("shift_sigma", 0.0),
        waviness_m=table.length("waviness", 0.0),
        wavelength_m=table.length("wavelength", 0.1),
    )
    table.end()
    return spec


def _scenario(name: str, table: StrictTable) -> Scenario:
    scenario = Scenario(
        name=name,
        part_present=bool(table.take("part_present", True)),
        joint_noise_factors=tuple(float(factor) for factor in table.take("joint_noise_factors", [])),
        bump_translation_m=table.vector("bump_translation", "length", 3)
        if table.has("bump_translation")
        else np.zeros(3),
        bump_rotation_rad=table.vector("bump_rotation", "angle", 3)
        if table.has("bump_rotation")
        else np.zeros(3),
    )
    table.end()
    return scenario


def read_world_file(directory: Path) -> WorldFile:
    """The world.toml in `directory`. Raises CellFileError, also for a key that means nothing."""
    path = directory / "world.toml"
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise CellFileError(f"{path} does not exist", "Name the directory of a simulated cell") from error
    except ValueError as error:  # not TOML, or not even UTF-8
        raise CellFileError(f"{path}: {error}", "Correct the file") from error
    root = StrictTable(content, "world.toml")
    world, plate = root.table("world"), root.table("plate")
    bar, sphere, part = root.table("bar"), root.table("sphere"), root.table("part")
    scenarios = root.take("scenarios")
    result = WorldFile(
        name=world.text("name"),
        arm=_arm(root.table("arm")),
        laser=_laser(root.table("laser")),
        probe=_probe(root.table("probe")),
        plate=PlateSpec(
            _placement(plate, "base", "plate"),
            plate.vector("size", "length", 2),
            plate.length("thickness"),
            plate.length("flatness"),
        ),
        bar=BarSpec(
            _placement(bar, "base", "bar"),
            bar.length("sphere_radius"),
            bar.length("sphere_radius_sigma"),
            bar.length("length"),
            bar.length("length_sigma"),
        ),
        sphere=SphereSpec(
            _placement(sphere, "base", "sphere"), sphere.length("radius"), sphere.length("radius_sigma")
        ),
        part=PartSpec(
            directory / part.text("cad"),
            _placement(part, "base", "part"),
            tuple(_feature(item) for item in part.tables("features")),
        ),
        scenarios={
            name: _scenario(name, StrictTable(t, f"scenarios.{name}")) for name, t in scenarios.items()
        },
    )
    for table in (root, world, plate, bar, sphere, part):
        table.end()
    return result
