"""What the cell file says is known before anything was measured: blocks of the belief, surfaces, noise."""

import math
import os
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np

from controller.cellfile import Cell
from controller.samples import Sample
from estimation.belief import Belief
from estimation.cad import CadFace, face_at, read_faces
from estimation.measurement import Observations
from estimation.surfaces import Feature, bar_features, cylinder, plane, plate_features, sphere_features
from estimation.transform import FloatArray

LASER_FREEDOMS = ("tx", "ty", "tz", "rx", "ry")  # turning about the beam changes no reading
PLANE_FREEDOMS = ("tz", "rx", "ry")
BAR_FREEDOMS = ("tx", "ty", "tz", "rx", "ry")  # turning about the line of centres changes nothing
POINT_FREEDOMS = ("tx", "ty", "tz")
INSPECTED_U_M = 1e-3  # of a size or place that is still to be inspected, for aiming


def first_belief(cell: Cell) -> Belief:
    """Kinematics, laser mount, scale and offset, as the cell file declares them."""
    belief = Belief()
    free = cell.robot.arm_model().parameter_labels
    if free:
        belief = belief.with_block(
            "kinematics",
            np.zeros(len(free)),
            std=cell.robot.parameter_u(),
            freedoms=free,
            source="kinematics",
        )
    mount = cell.laser.mount
    std = [mount.position_u_m] * 3 + [mount.rotation_u_rad] * 2
    belief = belief.with_block(
        "laser", mount.transform(), std=std, freedoms=LASER_FREEDOMS, source="laser mount"
    )
    belief = belief.with_block("laser.scale", 0.0, std=cell.laser.scale_u, source="laser scale")
    return belief.with_block("laser.offset", 0.0, std=cell.laser.offset_u_m, source="laser offset")


def with_plate(belief: Belief, cell: Cell) -> Belief:
    """Adds the plane of the calibration plate."""
    plate = cell.plate
    std = [plate.position_u_m] + [plate.rotation_u_rad] * 2
    return belief.with_block(
        "plate", plate.transform(), std=std, freedoms=PLANE_FREEDOMS, source="plate place"
    )


def with_bar(belief: Belief, cell: Cell) -> Belief:
    """Adds the two-sphere bar with its certificate."""
    bar = cell.bar
    std = [bar.position_u_m] * 3 + [bar.rotation_u_rad] * 2
    belief = belief.with_block("bar", bar.transform(), std=std, freedoms=BAR_FREEDOMS, source="bar place")
    belief = belief.with_block("bar.length", bar.length_m, std=bar.length_u_m, source="bar certificate")
    return belief.with_block(
        "bar.radius", bar.sphere_radius_m, std=bar.sphere_radius_u_m, source="bar certificate"
    )


def with_part(belief: Belief, cell: Cell) -> Belief:
    """Adds the pose of the part and the form deviation of each of its faces."""
    part = cell.part
    std = [part.position_u_m] * 3 + [part.rotation_u_rad] * 3
    belief = belief.with_block("part", part.transform(), std=std, source="part place")
    for feature in part_features(cell):
        if feature.kind == "plane":
            form_u_m = cell.part.feature(feature.name).form_u_m
            belief = belief.with_block(f"part.{feature.name}", 0.0, std=form_u_m, source="part form")
    return belief


def with_probe(belief: Belief, cell: Cell) -> Belief:
    """Adds the stylus and the sphere on which it is qualified."""
    probe, sphere = cell.probe, cell.sphere
    belief = belief.with_block(
        "probe",
        probe.mount.transform(),
        std=probe.mount.position_u_m,
        freedoms=POINT_FREEDOMS,
        source="probe mount",
    )
    # Joints that are late by as much in every touch look like a smaller ball, and are qualified with it.
    late_m = probe.touch_speed_m_s * cell.robot.contact_delay_s
    radius_u_m = math.hypot(probe.ball_radius_u_m, late_m / math.sqrt(12.0))
    belief = belief.with_block("probe.radius", probe.ball_radius_m, std=radius_u_m, source="probe ball")
    belief = belief.with_block(
        "sphere", sphere.transform(), std=sphere.position_u_m, freedoms=POINT_FREEDOMS, source="sphere place"
    )
    return belief.with_block(
        "sphere.radius", sphere.radius_m, std=sphere.radius_u_m, source="sphere certificate"
    )


def with_inspected(belief: Belief, cell: Cell, u_m: float = INSPECTED_U_M) -> Belief:
    """Adds size and place of each bore and boss; with an infinite u only measurements can tell them."""
    for feature in part_features(cell):
        if feature.kind == "cylinder":
            belief = belief.with_block(
                f"part.{feature.name}",
                np.zeros(3),
                std=u_m,
                freedoms=feature.deviations,
                units=["m"] * 3,
                source="inspected feature",
            )
    return belief


def cache_dir() -> Path:
    """Where parsed CAD files are kept between starts."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "truecell"


@lru_cache(maxsize=8)
def _faces(cad: Path, unit_m: float, modified_ns: int) -> tuple[CadFace, ...]:
    return read_faces(cad, cache_dir(), unit_m)


@lru_cache(maxsize=8)
def _named_faces(
    faces: tuple[CadFace, ...], points: tuple[tuple[str, tuple[float, ...]], ...]
) -> dict[str, CadFace]:
    return {name: face_at(faces, np.array(at_m)) for name, at_m in points}


def all_faces(cell: Cell) -> tuple[CadFace, ...]:
    """Every face of the part, named or not; the same tuple while the file stays. Raises CellFileError."""
    return _faces(cell.cad_path, cell.part.cad_unit_m, cell.cad_path.stat().st_mtime_ns)


def part_faces(cell: Cell) -> dict[str, CadFace]:
    """The CAD face of each named feature. Raises CellFileError, EstimationError."""
    points = tuple((feature.name, feature.at_m) for feature in cell.part.features)
    return _named_faces(all_faces(cell), points)


def part_features(cell: Cell) -> tuple[Feature, ...]:
    """The named features of the part with their deviation parameters, in the order of the cell file."""
    features = []
    for name, face in part_faces(cell).items():
        block = f"part.{name}"
        if face.kind == "plane":
            features.append(plane(name, face.point_m, face.axis, block))
        else:
            features.append(cylinder(name, face.point_m, face.axis, face.radius_m, face.outward, block))
    return tuple(features)


def object_features(cell: Cell, name: str) -> tuple[Feature, ...]:
    """The features of any object of the cell."""
    match name:
        case "plate":
            return plate_features()
        case "bar":
            return bar_features()
        case "sphere":
            return sphere_features()
        case _:
            return part_features(cell)


def part_corners_m(cell: Cell) -> FloatArray:
    """Corners (8, 3) of the block that the localized faces span, frame of the part."""
    planes = [face.bounds_m for face in part_faces(cell).values() if face.kind == "plane"]
    bounds = np.stack([np.min([b[0] for b in planes], axis=0), np.max([b[1] for b in planes], axis=0)])
    return np.array(
        [[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    )


def joint_variance(cell: Cell, readings: float) -> float:
    """Variance (rad^2) of a mean of `readings` joint readings: noise and the step of the encoder."""
    robot, count = cell.robot, max(readings, 1)
    step = robot.encoder_step_rad**2 / 12
    if robot.coarse:  # the readings of one standstill share what the step takes
        return robot.joint_noise_rad**2 / count + step
    return (robot.joint_noise_rad**2 + step) / count


def observations(cell: Cell, samples: Sequence[Sample]) -> list[Observations]:
    """Samples as the estimator takes them: one batch per sensor and object, by first appearance."""
    groups: dict[tuple[Literal["laser", "probe"], str], list[Sample]] = {}
    for sample in samples:
        sensor: Literal["laser", "probe"] = "probe" if sample.kind == "touch" else "laser"
        groups.setdefault((sensor, sample.object), []).append(sample)
    return [_batch(cell, sensor, name, group) for (sensor, name), group in groups.items()]


def _batch(
    cell: Cell, sensor: Literal["laser", "probe"], name: str, samples: Sequence[Sample]
) -> Observations:
    measured = {sample.feature for sample in samples}
    features = tuple(feature for feature in object_features(cell, name) if feature.name in measured)
    place = {feature.name: i for i, feature in enumerate(features)}
    count, joints = len(samples), len(samples[0].joints_rad)
    variance = np.array([joint_variance(cell, sample.joint_readings) for sample in samples])
    if sensor == "laser":
        reading = np.array([sample.reading_m for sample in samples])
        cycles = np.array([max(sample.readings, 1) for sample in samples])
        reading_variance = cell.laser.noise_m**2 + cell.laser.reading_noise_m**2 / cycles
    else:
        reading = np.zeros(count)
        declared_m = cell.probe.touch_speed_m_s * cell.probe.poll_period_s
        travel_m = np.array([max(declared_m, sample.reading_scatter_m) for sample in samples])
        reading_variance = cell.probe.noise_m**2 + travel_m**2 / 12
    flatness_m = cell.plate.flatness_u_m if name == "plate" else 0.0
    return Observations(
        sensor=sensor,
        object=name,
        joints_rad=np.array([sample.joints_rad for sample in samples]),
        joint_variance=np.repeat(variance[:, None], joints, axis=1),
        reading_m=reading,
        reading_variance=reading_variance,
        surface_variance=np.full(count, flatness_m**2),
        features=features,
        feature_index=np.array([place[sample.feature] for sample in samples]),
    )
