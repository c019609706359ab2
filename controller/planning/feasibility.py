"""Can the limits of a job be met at all? Asked before a port is opened or anything moves."""

from collections import OrderedDict
from dataclasses import dataclass
from typing import Final

from controller.cellfile import Cell, Mistake, job
from controller.faults import GateHeld
from controller.gates import Proof, Verdict
from controller.knowledge import first_belief, with_part, with_plate
from controller.planning.candidates import part_candidates, plate_candidates
from controller.planning.estimated import COARSE_COUNT, choose, corner_points, hand_eye_points, margin_m
from controller.planning.plan import MARGIN, SLACK, GatedPrediction, gated_predictions
from controller.planning.workspace import Candidates, Workspace, observations_of
from estimation.belief import Belief
from estimation.errors import Unreachable
from estimation.kinematics import ArmModel
from estimation.measurement import Chain, Points
from estimation.solver import predicted_belief
from estimation.statistics import Outcome
from estimation.transform import FloatArray

PART_DRAWS: Final = 6000  # its faces have places that few beams reach
_KEPT: Final = 16  # answers, by cell file

# What would make each source smaller.
_CURES: Final = (
    ("kinematics", "calibrate the arm's kinematics and declare the smaller uncertainties"),
    ("laser scale", "have the laser's scale certified more closely"),
    ("laser offset", "have the laser's zero certified more closely"),
    ("range noise", "allow more measurements, or use a laser with less noise"),
    ("joint noise", "average more joint readings"),
    ("form", "declare the part's form from a measured sample"),
    ("certificate", "use an artefact with a smaller uncertainty"),
)


@dataclass(frozen=True, slots=True)
class Reachable:
    """The best that one phase can do with all the measurements that it may take."""

    phase: str
    index: int  # in the job
    best: GatedPrediction
    limit_m: float
    measurements: int
    takes: int  # of these, before the limit is met: at least those that are planned at first

    @property
    def met(self) -> bool:
        """Whether the limit can be met, as far as a prediction can tell."""
        return self.best.may_meet(self.limit_m)

    @property
    def problem(self) -> str:
        """In words, with value, limit, unit and the dominating source."""
        source, share = self.best.dominating
        return (
            f"best reachable {self.best.U_m * 1e3:.2f} mm, limit {self.limit_m * 1e3:.2f} mm, "
            f"with {self.measurements} measurements; dominated by {source}, {share:.0%} of the variance"
        )

    @property
    def remedy(self) -> str:
        """What would cure it."""
        source = self.best.dominating[0]
        cure = next((text for key, text in _CURES if key in source), f"reduce {source}")
        return f"raise the limit to {self.best.U_m * SLACK * 1e3:.2f} mm, or {cure}"


class OutOfReach(Unreachable):
    """No measurement of an object can be taken at all."""

    def __init__(self, name: str) -> None:
        super().__init__(
            f"The {name} is out of reach: no posture of the arm has the beam on it, in range and clear",
            "Place it nearer to the middle of the arm's reach, or move what stands in the way",
        )
        self.object = name


_answers: "OrderedDict[str, tuple[Reachable, ...]]" = OrderedDict()


def feasibility(cell: Cell) -> tuple[Reachable, ...]:
    """The best of each phase with a limit, each building on what the one before is planned to reach.

    Kept for cell files asked for before. Raises OutOfReach when an object cannot be measured at all.
    """
    digest = cell.digest
    if digest not in _answers:
        _answers[digest] = tuple(_walk(cell))
        while len(_answers) > _KEPT:
            _answers.popitem(last=False)
    return _answers[digest]


def limit_mistakes(cell: Cell) -> list[Mistake]:
    """Limits that cannot be met and objects out of reach, as mistakes of the cell file; for `check_cell`."""
    try:
        found = feasibility(cell)
    except OutOfReach as error:
        problem, remedy = (text[:1].lower() + text[1:] for text in (error.problem, error.remedy))
        return [cell.mistake_at((error.object, "xyz"), problem, remedy)]
    return [
        cell.mistake_at(("job", "phases", reachable.index, "limit"), reachable.problem, reachable.remedy)
        for reachable in found
        if not reachable.met
    ]


def refuse_impossible_limits(cell: Cell) -> None:
    """Raises GateHeld when the limit of a phase cannot be met."""
    for reachable in feasibility(cell):
        if not reachable.met:
            proof = Proof(
                "best reachable expanded uncertainty",
                reachable.best.U_m * 1e3,
                reachable.limit_m * 1e3,
                "mm",
                Outcome.NOT_DECIDABLE,
                reachable.problem,
            )
            remedy = reachable.remedy[:1].upper() + reachable.remedy[1:]
            raise GateHeld(reachable.phase, Verdict((proof,), reachable.problem, remedy))


def _walk(cell: Cell) -> list[Reachable]:
    arm, belief, found = cell.robot.arm_model(), first_belief(cell), list[Reachable]()
    for index, spec in enumerate(cell.job.phases):
        if isinstance(spec, job.HandEyePhase):
            prior = with_plate(belief, cell)
            workspace = Workspace(cell, arm, prior)
            points, names = hand_eye_points(prior, spec.gated_ranges_m)
            pool = plate_candidates(workspace, 0)
        elif isinstance(spec, job.LocalizePhase):
            prior = _searched(cell, with_part(belief, cell), arm, spec)
            workspace = Workspace(cell, arm, prior)
            points, names = corner_points(cell, prior)
            pool = part_candidates(workspace, spec.faces, 0, PART_DRAWS, margin_m(workspace))
        else:
            continue
        most = min(spec.most_measurements, len(pool))
        best, curve_U_m = _best(workspace, pool, points, most, spec.name)
        takes = min(spec.measurements, most)
        planned, _ = _best(workspace, pool, points, takes, spec.name)
        if _worst(planned, points, names).U_m > spec.limit_m:  # one after the other, until it is enough
            enough_m = (1.0 - MARGIN) * spec.limit_m
            takes = next((count for count, U_m in enumerate(curve_U_m) if U_m <= enough_m), most)
            planned, _ = _best(workspace, pool, points, takes, spec.name)
        best_U = _worst(best, points, names)
        found.append(Reachable(spec.name, index, best_U, spec.limit_m, most, takes))
        belief = planned.without(["plate", "part"])
    return found


def _searched(cell: Cell, prior: Belief, arm: ArmModel, spec: job.LocalizePhase) -> Belief:
    """What the coarse points leave."""
    workspace = Workspace(cell, arm, prior)
    pool = part_candidates(workspace, spec.faces, 0, PART_DRAWS // 2, margin_m(workspace))
    return _best(workspace, pool, corner_points(cell, prior)[0], COARSE_COUNT, "search")[0]


def _best(
    workspace: Workspace, pool: Candidates, points: Points, count: int, phase: str
) -> tuple[Belief, tuple[float, ...]]:
    """What the best `count` measurements leave, and `Plan.curve_U_m`."""
    if not len(pool):
        raise OutOfReach(pool.object)
    gates: FloatArray = points.jacobian
    chosen, curve_U_m = choose(workspace, pool, gates, min(count, len(pool)))
    taken = Chain(workspace.arm, [observations_of(workspace, chosen)])
    return predicted_belief(workspace.belief, taken, phase), curve_U_m


def _worst(belief: Belief, points: Points, names: tuple[str, ...]) -> GatedPrediction:
    return max(gated_predictions(belief, points, names), key=lambda point: point.U_m)
