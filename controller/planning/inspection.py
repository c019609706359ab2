"""The plan of an inspection: qualify the stylus on its sphere, then touch datums and tolerated features."""

from collections.abc import Callable, Collection, Sequence
from typing import Final

import numpy as np

from controller.cellfile import Cell, job
from controller.knowledge import part_faces
from controller.planning.faces import FaceSampler
from controller.planning.plan import Plan
from controller.planning.poses import IntArray, directions_around
from controller.planning.steps import Step, named
from controller.planning.touches import HOVER_M, Aims, Touches, contacts_of, touch_steps, touches_of
from controller.planning.workspace import Workspace, features_of, observations_of, rows_of
from estimation import design
from estimation.belief import Belief
from estimation.cad import CadFace
from estimation.design import DesignProblem
from estimation.errors import Unreachable
from estimation.kinematics import ArmModel
from estimation.measurement import Chain
from estimation.solver import predicted_belief
from estimation.transform import FloatArray

SPHERE_TOUCHES: Final = 9
SPHERE_DRAWS: Final = 240
FLATNESS_TOUCHES: Final = 9
DATUM_TOUCHES: Final = 4
CYLINDER_TOUCHES: Final = 8  # on two circles
STYLUS_TILT_RAD: Final = np.radians(30.0)  # of the tool, so that the stylus is known along its own axis too
EDGE_M: Final = 0.006  # of a touch from the edges of its face
DEEPEST_M: Final = 0.026  # below the top of the part: so far the stylus reaches with its body over the part
SPINS: Final = 16
_GOLDEN: Final = 0.382
_DOWN: Final = np.array([0.0, 0.0, -1.0])


def plan_inspect(cell: Cell, belief: Belief, arm: ArmModel, spec: job.InspectPhase, seed: int) -> Plan:
    """Touches in groups: sphere, faces, bores and bosses.

    The belief holds probe, sphere, part and the inspected features. Every feature with a characteristic
    is touched, and every datum.
    """
    workspace = Workspace(cell, arm, belief)
    groups = [("stylus", _sphere_touches(workspace, seed))]
    faces = part_faces(cell)
    for name, count in _wanted(cell).items():
        pattern = _plane_aims if faces[name].kind == "plane" else _cylinder_aims
        groups.append((name, _fixed_touches(workspace, name, range(count), pattern)))
    steps = named(touch_steps(workspace, groups), spec.name)
    taken = [observations_of(workspace, touches.contact) for _, touches in groups]
    return Plan(steps, (), predicted_belief(belief, Chain(arm, taken), spec.name))


def more_inspect(
    cell: Cell, belief: Belief, arm: ArmModel, steps: Sequence[Step], names: Collection[str], rounds: int
) -> Plan:
    """`rounds` times the first touches of the features `names`, between those of `steps`.

    The belief has used the touches of `steps` already.
    """
    workspace = Workspace(cell, arm, belief)
    faces = part_faces(cell)
    groups = []
    for name, count in _wanted(cell).items():
        if name in names:
            first = sum(step.object == "part" and step.feature == name for step in steps)
            numbers = range(first, first + rounds * count)
            pattern = _plane_aims if faces[name].kind == "plane" else _cylinder_aims
            groups.append((name, _fixed_touches(workspace, name, numbers, pattern)))
    touched = [observations_of(workspace, touches.contact) for _, touches in groups]
    return Plan(touch_steps(workspace, groups), (), predicted_belief(belief, Chain(arm, touched), "touch"))


def _wanted(cell: Cell) -> dict[str, int]:
    """How many touches each feature gets: datums first, so that a wrong clamping shows early."""
    wanted: dict[str, int] = {}
    faces = part_faces(cell)
    for item in cell.part.characteristics:
        for datum in getattr(item, "datums", ()):
            wanted.setdefault(datum, DATUM_TOUCHES)
    for item in cell.part.characteristics:
        plane = faces[item.feature].kind == "plane"
        wanted[item.feature] = FLATNESS_TOUCHES if plane else CYLINDER_TOUCHES
    return wanted


def _sphere_touches(workspace: Workspace, seed: int) -> Touches:
    """From all possible touches of the sphere's upper half those that tell most about the stylus."""
    cell, random = workspace.cell, np.random.default_rng([seed, 5])
    count = SPHERE_DRAWS
    away = cell.sphere.radius_m + cell.probe.ball_radius_m
    normal = directions_around(
        np.array([0.0, 0.0, 1.0]),
        np.arccos(random.uniform(np.sin(np.radians(10.0)), 1.0, count)),
        random.uniform(-np.pi, np.pi, count),
    )
    tilt = STYLUS_TILT_RAD * random.integers(0, 2, count)
    tool = directions_around(_DOWN, tilt, random.uniform(-np.pi, np.pi, count))
    # The shaft must not meet the sphere before the ball does.
    apart = np.einsum("ij,ij->i", normal, -tool) > 0.1
    normal, tool = normal[apart], tool[apart]
    aims = Aims(
        "sphere",
        features_of(workspace, "sphere"),
        np.zeros(len(normal), dtype=np.intp),
        away * normal,
        normal,
        (away + 2.0 * HOVER_M) * normal,
        tool,
        random.uniform(-np.pi, np.pi, len(normal)),
    )
    possible, _ = touches_of(workspace, aims)
    if len(possible.contact) < SPHERE_TOUCHES:
        raise _unreachable("the stylus sphere")
    rows = rows_of(workspace, possible.contact)
    gates = np.zeros((1, 3, workspace.belief.size))
    gates[0, :, workspace.belief.index("probe")] = np.eye(3)
    problem = DesignProblem(
        workspace.belief.covariance, rows.dense(workspace.belief), rows.noise_variance, gates
    )
    chosen = design.choose(problem, SPHERE_TOUCHES).chosen
    return possible.take(chosen)


Pattern = Callable[[Workspace, str, range], tuple[FloatArray, FloatArray, FloatArray]]


def _fixed_touches(workspace: Workspace, name: str, numbers: range, pattern: Pattern) -> Touches:
    """Contacts of these numbers in an endless pattern, with the spin of the tool that suits all of them best.

    One spin for all touches of a feature, so that the stylus position cancels; where none reaches all
    of them, each takes the nearest to the one that reaches most.
    """
    contact, normal, hover = pattern(workspace, name, numbers)
    features = features_of(workspace, "part")
    place = [feature.name for feature in features].index(name)
    many = len(normal) * SPINS
    aims = Aims(
        "part",
        features,
        np.full(many, place, dtype=np.intp),
        np.tile(contact, (SPINS, 1)),
        np.tile(normal, (SPINS, 1)),
        np.tile(hover, (SPINS, 1)),
        np.broadcast_to(_DOWN, (many, 3)),
        np.repeat(np.arange(SPINS) * 2.0 * np.pi / SPINS, len(normal)),
    )
    joints, found = contacts_of(workspace, aims)
    motion = np.where(found, np.abs(joints - workspace.start_rad)[:, 1:].max(axis=1), 2.0 * np.pi)
    order = np.argsort(motion.reshape(SPINS, -1).sum(axis=1), kind="stable")
    wanted = np.arange(many).reshape(SPINS, -1)
    whole = np.all(found.reshape(SPINS, -1), axis=1)
    for spin in order[np.asarray(whole)[order]]:
        touches, rows = touches_of(workspace, aims.take(wanted[spin]))
        if len(rows) == len(normal):
            return touches
    touches, rows = touches_of(workspace, aims)
    place_of = np.full(many, -1)
    place_of[rows] = np.arange(len(rows))
    table = place_of.reshape(SPINS, -1)
    missing = int((table < 0).all(axis=0).sum())
    if missing:
        raise _unreachable(f"{missing} of {len(normal)} touches on {name}")
    common = int(np.argmax((table >= 0).sum(axis=1)))
    turn = np.abs((np.arange(SPINS) - common + SPINS // 2) % SPINS - SPINS // 2)
    best = np.argmin(np.where(table >= 0, turn[:, None], SPINS), axis=0)
    return touches.take(table[best, np.arange(len(normal))])


def _plane_aims(workspace: Workspace, name: str, numbers: range) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Contacts spread as far apart as the face allows."""
    sampler = FaceSampler.of(workspace.cell, name)
    points = sampler.draw(np.random.default_rng(0), 400, EDGE_M)
    top_m = _top_m(workspace)
    points = points[points[:, 2] > top_m - DEEPEST_M]
    spread = points[_farthest(points, numbers.stop)[numbers.start :]]
    ball_m = workspace.cell.probe.ball_radius_m
    normal = np.broadcast_to(sampler.normal, spread.shape)
    return spread + ball_m * normal, normal, spread + (ball_m + HOVER_M) * normal


def _cylinder_aims(
    workspace: Workspace, name: str, numbers: range
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Two circles of contacts, turned against each other; hovering on the axis of a bore, outside a boss.

    Each further pair of circles is turned by the golden part of the step between contacts.
    """
    face = part_faces(workspace.cell)[name]
    low, high = _extent_m(face)
    around = CYLINDER_TOUCHES // 2
    turn, place = np.divmod(np.array(numbers), CYLINDER_TOUCHES)
    second = place >= around
    heights = low + (high - low) * np.where(second, 0.75, 0.3)
    angle = 2.0 * np.pi / around * (place + 0.5 * second + _GOLDEN * turn)
    radial = directions_around(face.axis, np.full(len(numbers), np.pi / 2), angle)
    normal = radial if face.outward else -radial
    axis_p = face.point_m + heights[:, None] * face.axis
    ball_m = workspace.cell.probe.ball_radius_m
    contact = axis_p + face.radius_m * radial + ball_m * normal
    hover = contact + HOVER_M * normal if face.outward else axis_p
    return contact, normal, hover


def _extent_m(face: CadFace) -> tuple[float, float]:
    """From where to where a cylinder reaches along its axis, from its point."""
    along = (face.triangles.reshape(-1, 3) - face.point_m) @ face.axis
    return float(along.min()), float(along.max())


def _top_m(workspace: Workspace) -> float:
    """Height of the highest plane face of the part, frame of the part."""
    faces = part_faces(workspace.cell).values()
    return float(max(face.bounds_m[1, 2] for face in faces if face.kind == "plane"))


def _farthest(points: FloatArray, count: int) -> IntArray:
    """Rows of points, each the farthest from those before; the first is farthest from the middle."""
    distance = np.linalg.norm(points - points.mean(axis=0), axis=1)
    chosen = [int(np.argmax(distance))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen, dtype=np.intp)


def _unreachable(what: str) -> Unreachable:
    return Unreachable(f"Not clear of the cell: {what}", "Move the part or what stands near it")
