"""Candidate measurements: where a beam can meet a surface in range, at a fair angle, clear of everything."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from controller.planning.faces import FaceSampler, beams_meet
from controller.planning.poses import BoolArray, IntArray, beam_poses, choose_joints, directions_around
from controller.planning.workspace import (
    SIGMAS,
    Candidates,
    Workspace,
    features_of,
    range_variance,
    rows_of,
)
from estimation.measurement import RANGE_NOISE
from estimation.surfaces import Feature
from estimation.transform import FloatArray

MOST_TILT_RAD: Final = np.radians(28.0)  # more gains little, and the beam's spot grows
INCIDENCE_MARGIN_RAD: Final = np.radians(3.0)  # the mount may be turned by as much
EDGE_MARGIN_M: Final = 0.004
# Before reach, clearance and range are looked at. On the plate they must be many times what is chosen: with a
# third of them the best 160 poses leave 8 to 13 % more uncertainty.
DRAWS: Final = 6000
PART_DRAWS: Final = 3000
_FEW: Final = 200  # candidates on a face
_REDRAWS: Final = 2


def plate_candidates(workspace: Workspace, seed: int, draws: int = DRAWS) -> Candidates:
    """Beams onto the plate: points within the margin, all tilts and spins, over the whole working range."""
    random = np.random.default_rng([seed, 1])
    plate = workspace.cell.plate
    # x and y of the plate are not estimated, so its declared place and the mount's decide what is on it
    off_m = SIGMAS * float(np.hypot(plate.position_u_m, mount_offset_m(workspace)))
    half = np.array(plate.size_m) / 2 - plate.margin_m - off_m
    points = np.zeros((draws, 3))
    points[:, :2] = random.uniform(-1.0, 1.0, (draws, 2)) * np.maximum(half, 0.0)
    normals = np.broadcast_to([0.0, 0.0, 1.0], (draws, 3))
    return _aimed(
        workspace,
        "plate",
        features_of(workspace, "plate"),
        np.zeros(draws, dtype=np.intp),
        points,
        normals,
        random,
    )


def part_candidates(
    workspace: Workspace,
    faces: Sequence[str],
    seed: int,
    draws: int = PART_DRAWS,
    margin_m: float = EDGE_MARGIN_M,
    middle: float = 1.0,
) -> Candidates:
    """Beams onto plane faces of the part, `margin_m` inside their edges, at all tilts and spins.

    Faces that few beams reach are tried again with more: without them a direction may stay open.
    `middle` is the share of the working range, about its middle, in which distances are drawn.
    """
    random = np.random.default_rng([seed, 2])
    features = features_of(workspace, "part")
    place = {feature.name: i for i, feature in enumerate(features)}
    each, rare, found = draws // len(faces), tuple(faces), list[Candidates]()
    for _ in range(1 + _REDRAWS):
        points, normals, index = [], [], []
        for name in rare:
            sampler = FaceSampler.of(workspace.cell, name)
            inside = sampler.draw(random, each, margin_m)
            points.append(inside)
            normals.append(np.broadcast_to(sampler.normal, inside.shape))
            index.append(np.full(len(inside), place[name], dtype=np.intp))
        where = np.concatenate(index), np.concatenate(points), np.concatenate(normals)
        found.append(_aimed(workspace, "part", features, *where, random, middle))
        counts = np.bincount(
            np.concatenate([batch.feature_index for batch in found]), minlength=len(features)
        )
        rare = tuple(name for name in rare if counts[place[name]] < _FEW)
        if not rare:
            break
        each *= 4
    return Candidates.joined(found)


def mount_offset_m(workspace: Workspace) -> float:
    """Standard uncertainty of the beam's place on a surface, across the beam."""
    if "laser" not in workspace.belief:
        return 0.0
    covariance = workspace.belief.block_covariance("laser")
    far_m = workspace.cell.laser.working_range_m[1]
    across = covariance[:2, :2] + far_m**2 * covariance[3:5, 3:5]
    return float(np.sqrt(np.linalg.eigvalsh(across)[-1]))


def occluded(
    workspace: Workspace,
    candidates: Candidates,
    displacements: Sequence[FloatArray] = (),
    beside_m: float = 0.0,
) -> BoolArray:
    """Which candidates (m,) fail a ray check against the part: another face is met first, or none in range.

    Each displacement (4, 4) is one part_T_displaced that must work as well as the believed place. So must
    beams beside the planned one that meet its face up to `beside_m` away from it: they may not touch a boss.
    """
    laser, base_T_part = workspace.pose("laser"), workspace.pose("part")
    base_T_laser = workspace.actual_arm.flange_pose(candidates.joints_rad) @ laser.matrix
    names = [candidates.features[int(i)].name for i in candidates.feature_index]
    places = np.array([np.eye(4), *displacements])
    there_T_laser = (np.linalg.inv(base_T_part.matrix @ places)[:, None] @ base_T_laser).reshape(-1, 4, 4)
    met = beams_meet(workspace.cell, there_T_laser[:, :3, 3], there_T_laser[:, :3, 2], names * len(places))
    hit = met.on_face & met.within(workspace.cell.laser)
    failed = np.logical_not(hit.reshape(len(places), -1).all(axis=0))
    part_T_laser = there_T_laser[: len(candidates)]
    shift_m = beside_m * np.cos(workspace.cell.laser.max_incidence_rad)  # across the beam
    for axis, side in ((0, shift_m), (0, -shift_m), (1, shift_m), (1, -shift_m)) if shift_m else ():
        beside = part_T_laser[:, :3, 3] + side * part_T_laser[:, :3, axis]
        failed |= ~beams_meet(workspace.cell, beside, part_T_laser[:, :3, 2], names).on_face
    return failed


def surely_in_range(
    workspace: Workspace, candidates: Candidates, displacements: Sequence[FloatArray]
) -> BoolArray:
    """Which candidates (m,) on plane faces stay in range for every displacement (4, 4) of the part."""
    laser, low_high = workspace.pose("laser"), workspace.cell.laser.working_range_m
    base_T_laser = workspace.actual_arm.flange_pose(candidates.joints_rad) @ laser.matrix
    planes = [candidates.features[int(i)] for i in candidates.feature_index]
    point, normal = np.array([plane.point_m for plane in planes]), np.array([plane.axis for plane in planes])
    steepest = np.cos(workspace.cell.laser.max_incidence_rad)
    kept = np.ones(len(candidates), dtype=np.bool_)
    for displacement in displacements:
        part_T_laser = np.linalg.inv(workspace.pose("part").matrix @ displacement) @ base_T_laser
        height = np.einsum("mi,mi->m", part_T_laser[:, :3, 3] - point, normal)
        cosine = -np.einsum("mi,mi->m", part_T_laser[:, :3, 2], normal)
        distance = height / np.maximum(cosine, 1e-3)
        kept &= (cosine > steepest) & (distance > low_high[0]) & (distance < low_high[1])
    return kept


def aimed_beams(
    workspace: Workspace,
    base_p: FloatArray,
    base_beam: FloatArray,
    spin_rad: FloatArray,
    distance_m: FloatArray,
) -> tuple[FloatArray, BoolArray]:
    """Joints (m, 6) for beams through points, and which (m,) can be taken clear of everything."""
    flange = beam_poses(base_p, base_beam, spin_rad, distance_m, workspace.pose("laser").matrix)
    joints, found = choose_joints(workspace.arm, flange, workspace.start_rad)
    found[found] = workspace.keepout.clear(joints[found])
    return joints, found


def _aimed(
    workspace: Workspace,
    name: str,
    features: tuple[Feature, ...],
    index: IntArray,
    points: FloatArray,
    normals: FloatArray,
    random: np.random.Generator,
    middle: float = 1.0,
) -> Candidates:
    laser, count = workspace.cell.laser, len(points)
    steepest = min(MOST_TILT_RAD, laser.max_incidence_rad - INCIDENCE_MARGIN_RAD)
    # Half of the draws at the steepest tilt: what decides the hand-eye is the spread of orientations.
    tilt = steepest * np.minimum(1.0, 2.0 * np.sqrt(random.uniform(0.0, 1.0, count)))
    azimuth, spin = random.uniform(-np.pi, np.pi, (2, count))
    low, high = laser.working_range_m
    distance = (low + high) / 2 + middle * (high - low) * random.uniform(-0.5, 0.5, count)
    pose = workspace.pose(name)
    beam = pose.vectors(-directions_around(normals, tilt, azimuth))
    joints, found = aimed_beams(workspace, pose.points(points), beam, spin, distance)
    drawn = Candidates("laser", name, features, joints, distance, index, points).take(np.flatnonzero(found))
    expected, inside = in_range(workspace, drawn)
    return expected.take(np.flatnonzero(inside))


def in_range(workspace: Workspace, candidates: Candidates) -> tuple[Candidates, BoolArray]:
    """The candidates with readings as expected, and whether (m,) these surely stay in range."""
    if not len(candidates):
        return candidates, np.zeros(0, dtype=np.bool_)
    rows = rows_of(workspace, candidates)
    laser = workspace.cell.laser
    slope = np.sqrt(np.maximum(rows.noise[RANGE_NOISE] / range_variance(workspace.cell), 1e-6))  # cosine
    dense = rows.dense(workspace.belief)
    spread = np.sqrt(np.einsum("mi,mi->m", dense @ workspace.belief.covariance, dense)) / slope
    reading = candidates.reading_m + rows.residual_m / slope
    low, high = laser.working_range_m
    inside = (reading - SIGMAS * spread > low) & (reading + SIGMAS * spread < high)
    return replace(candidates, reading_m=reading), inside
