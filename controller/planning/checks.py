"""Plans that enter no fit of the hand-eye: the bar with plate poses measured again, and the noise."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from controller.cellfile import Cell, job
from controller.planning.candidates import aimed_beams, in_range, plate_candidates
from controller.planning.paths import accesses, connections, nearest_order, require_all
from controller.planning.plan import Plan, accessible, laser_steps, postures
from controller.planning.poses import BoolArray, IntArray, directions_around
from controller.planning.steps import Step, named
from controller.planning.workspace import SIGMAS, Candidates, Workspace, features_of
from estimation.belief import Belief
from estimation.errors import Unreachable
from estimation.kinematics import ArmModel
from estimation.transform import FloatArray

BAR_TILT_RAD: Final = np.radians(45.0)
PATCH: Final = (4, 3)  # points of the noise patch
HOP_M: Final = 0.002  # between them: another speckle, the same plane
_SPINS: Final = 12
_AZIMUTHS: Final = np.radians(np.arange(0.0, 360.0, 30.0))
_NEAR_AND_FAR: Final = (0.15, 0.8)  # of the working range
_LEAST_OFFSET: Final = 0.35  # of the cap's radius: nearer to its middle a point says nothing sideways
_DOWN: Final = np.array([0.0, 0.0, -1.0])


def plan_bar_check(
    cell: Cell, belief: Belief, arm: ArmModel, spec: job.CheckPhase, steps: Sequence[Step], seed: int
) -> Plan:
    """Both spheres from five tool orientations, and poses of the hand-eye (`steps`) on the plate again.

    Orientations: straight down at two spins half a turn apart, and tilted by 45 deg towards three azimuths.
    One orientation alone is blind: a bump of the sensor moves both spheres alike.
    """
    workspace = Workspace(cell, arm, belief)
    measured: tuple[Step, ...] = ()
    if spec.points_per_sphere:
        options = _options(workspace, spec.points_per_sphere)
        chosen = _five(workspace, options)
        batches = [options.candidates.take(options.rows[option]) for option in chosen]
        measured = laser_steps(workspace, Candidates.joined(batches), "bar")
    again = [step for step in steps if step.object == "plate" and step.kind == "laser"]
    repeated: tuple[Step, ...] = ()
    if again and spec.plate_poses:
        repeated = _repeated(workspace, again, spec.plate_poses)
    return Plan(named((*measured, *repeated), spec.name))


def plan_noise(cell: Cell, belief: Belief, arm: ArmModel, spec: job.NoisePhase) -> Plan:
    """Standstills on the plate, far apart, and a small patch of points seen with one orientation."""
    workspace = Workspace(cell, arm, belief)
    pool = plate_candidates(workspace, 0, draws=600)
    pool = pool.take(np.flatnonzero(accessible(workspace, pool)))
    if len(pool) < spec.poses:
        raise _unreachable("the noise on the plate")
    still = laser_steps(workspace, pool.take(_apart(pool.joints_rad, spec.poses)), "standstill")
    still = tuple(replace(step, kind="noise", readings=spec.readings) for step in still)
    patch = laser_steps(workspace, _patch(workspace), "patch")
    return Plan(named((*still, *patch), spec.name))


@dataclass(frozen=True, slots=True, eq=False)
class _Options:
    """Tool orientations in which all points of both spheres can be measured."""

    candidates: Candidates
    rows: IntArray  # (o, points) of the candidates, each option
    tilt_rad: FloatArray  # (o,)
    azimuth: IntArray  # (o,) place in _AZIMUTHS
    spin: IntArray  # (o,)
    motion: FloatArray  # (o,) largest joint angle away from the start


def _options(workspace: Workspace, points: int) -> _Options:
    """All orientations that work, with tilts 0 and 45 deg, all azimuths and spins.

    The points of a cap are seen from near and from far in turn: from one distance, a shift of the laser and a
    turn about it look alike, and what a bump does at other distances would stay open.
    """
    bar, low, high = workspace.cell.bar, *workspace.cell.laser.working_range_m
    ends = workspace.pose("bar").points(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, bar.length_m]]))
    distances = low + (high - low) * np.array(_NEAR_AND_FAR)
    tilted = np.array(
        [(1, a, s, d) for a in range(len(_AZIMUTHS)) for s in range(_SPINS) for d in range(2)]
        + [(0, 0, s, d) for s in range(_SPINS) for d in range(2)]
    )
    tilt = BAR_TILT_RAD * tilted[:, 0]
    azimuth, spin_place = tilted[:, 1], tilted[:, 2]
    spin = spin_place * 2.0 * np.pi / _SPINS
    beams = directions_around(_DOWN, tilt, _AZIMUTHS[azimuth])
    # First the middles of the caps, which rule out most; then every point of what is left.
    crown = np.repeat(ends[None], len(beams), 0) - bar.sphere_radius_m * beams[:, None]
    _, reached = aimed_beams(
        workspace,
        crown.reshape(-1, 3),
        np.repeat(beams, 2, 0),
        np.repeat(spin, 2),
        np.full(2 * len(beams), distances.mean()),
    )
    left = np.flatnonzero(reached.reshape(-1, 2).all(axis=1))
    offset_m = _offset_m(workspace)
    height_m = np.sqrt(bar.sphere_radius_m**2 - offset_m**2)
    many = len(left) * points
    turns = np.tile(2.0 * np.pi * (np.arange(points) + 0.5) / points, len(left))
    along = np.repeat(beams[left], points, 0)
    sideways = directions_around(along, np.full(many, np.pi / 2), turns)
    local = offset_m * sideways - height_m * along
    base_p = np.concatenate([ends[0] + local, ends[1] + local])
    far_first = np.repeat(tilted[left, 3], points)
    ranges = np.tile(distances[(np.tile(np.arange(points), len(left)) + far_first) % 2], 2)
    spins = np.tile(np.repeat(spin[left], points), 2)
    joints, found = aimed_beams(workspace, base_p, np.tile(along, (2, 1)), spins, ranges)
    features = features_of(workspace, "bar")
    index = np.repeat(np.arange(2, dtype=np.intp), many)
    object_p = workspace.pose("bar").inverse().points(base_p)
    drawn = Candidates("laser", "bar", features, joints, ranges, index, object_p)
    rows = np.arange(2 * many).reshape(2, len(left), points).transpose(1, 0, 2).reshape(len(left), -1)
    whole = np.flatnonzero(found[rows].all(axis=1) & _all_in_range(workspace, drawn, found)[rows].all(axis=1))
    motion = np.abs(joints[rows[whole]] - workspace.start_rad)[..., 1:].max(axis=(1, 2))
    kept = left[whole]
    return _Options(drawn, rows[whole], tilt[kept], azimuth[kept], spin_place[kept], motion)


def _five(workspace: Workspace, options: _Options) -> list[int]:
    """Two straight options half a turn apart, three tilted a third of a turn apart; the nearest that work."""
    order = np.argsort(options.motion, kind="stable")
    usable: dict[int, bool] = {}

    def nearest(which: BoolArray) -> int | None:
        for option in order[np.asarray(which)[order]].tolist():
            if option not in usable:
                usable[option] = bool(
                    accessible(workspace, options.candidates.take(options.rows[option])).all()
                )
            if usable[option]:
                return int(option)
        return None

    straight, tilted = options.tilt_rad == 0.0, options.tilt_rad > 0.0
    third, half = len(_AZIMUTHS) // 3, _SPINS // 2
    pairs = [
        [nearest(straight & (options.spin == spin + k * half)) for k in range(2)] for spin in range(half)
    ]
    triples = [
        [nearest(tilted & (options.azimuth == azimuth + k * third)) for k in range(3)]
        for azimuth in range(third)
    ]
    chosen: list[int] = []
    for sets, what in ((pairs, "straight down at two spins"), (triples, "from three sides")):
        complete = [[option for option in one if option is not None] for one in sets if None not in one]
        if not complete:
            raise _unreachable(f"both spheres of the bar, {what}")
        chosen += min(complete, key=lambda one: max(float(options.motion[option]) for option in one))
    return chosen


def _offset_m(workspace: Workspace) -> float:
    """How far the points of a cap lie from the beam through the centre: its rim, less what it may be off."""
    cell = workspace.cell
    cap_m = cell.bar.sphere_radius_m * np.sin(cell.laser.max_incidence_rad)
    place = [i for i, name in enumerate(workspace.belief.block("bar").freedoms) if name.startswith("t")]
    covariance = workspace.belief.block_covariance("bar")[np.ix_(place, place)]
    off_m = SIGMAS * np.sqrt(np.linalg.eigvalsh(covariance)[-1])
    return float(max(cap_m - off_m, _LEAST_OFFSET * cap_m))


def _all_in_range(workspace: Workspace, drawn: Candidates, found: BoolArray) -> BoolArray:
    inside = np.zeros(len(drawn), dtype=np.bool_)
    rows = np.flatnonzero(found)
    inside[rows] = in_range(workspace, drawn.take(rows))[1]
    return inside


def _repeated(workspace: Workspace, steps: Sequence[Step], count: int) -> tuple[Step, ...]:
    """Some of the steps again, far apart in the joints, with ways of their own."""
    joints = np.array([step.joints_rad for step in steps])
    # What was learnt since may have brought one too near to something.
    clear = [row for row, way in enumerate(accesses(workspace.keepout, joints)) if way is not None]
    if not clear:
        raise _unreachable("poses of the hand-eye again")
    steps, joints = [steps[row] for row in clear], joints[clear]
    chosen = _apart(joints, min(count, len(steps)))
    order = chosen[nearest_order(joints[chosen], workspace.start_rad)]
    routes = require_all(accesses(workspace.keepout, joints[order]), "the plate")
    vias = connections(workspace.keepout, joints[order], routes)
    again = [
        replace(
            steps[row], via=postures(via), access=postures(route), retreat=(), note=f"again {steps[row].id}"
        )
        for row, via, route in zip(order, vias, routes, strict=True)
    ]
    again[-1] = replace(again[-1], retreat=tuple(reversed(again[-1].access)))
    return tuple(again)


def _patch(workspace: Workspace) -> Candidates:
    """A few points HOP_M apart in the middle of the plate, straight down; the first spin that works."""
    columns, rows = PATCH
    x, y = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(columns * rows)]) * HOP_M
    pose, count = workspace.pose("plate"), columns * rows
    distance_m = float(np.mean(workspace.cell.laser.working_range_m))
    for spin in np.arange(_SPINS) * 2.0 * np.pi / _SPINS:
        beams = np.broadcast_to(-pose.rotation[:, 2], points.shape)
        joints, found = aimed_beams(
            workspace, pose.points(points), beams, np.full(count, spin), np.full(count, distance_m)
        )
        patch = Candidates(
            "laser",
            "plate",
            features_of(workspace, "plate"),
            joints,
            np.full(count, distance_m),
            np.zeros(count, dtype=np.intp),
            points,
        )
        if found.all() and in_range(workspace, patch)[1].all() and accessible(workspace, patch).all():
            return patch
    raise _unreachable("the noise patch in the middle of the plate")


def _apart(joints: FloatArray, count: int) -> IntArray:
    """Rows of postures, each the farthest from those before."""
    chosen = [0]
    distance = np.abs(joints - joints[0]).max(axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.abs(joints - joints[chosen[-1]]).max(axis=1))
    return np.array(chosen, dtype=np.intp)


def _unreachable(what: str) -> Unreachable:
    return Unreachable(
        f"No clear poses for {what}",
        "Place it nearer to the middle of the arm's reach, or clear its surroundings",
    )
