"""One measurement after the other: the next best, whether they are enough, and whether they ever can be.

Everything here follows from the belief and the samples that are handed in, so that a restart finds the same.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from controller.cellfile import Cell, job
from controller.planning.candidates import part_candidates, plate_candidates
from controller.planning.estimated import (
    Blocked,
    blocked_beams,
    corner_points,
    hand_eye_points,
    margin_m,
)
from controller.planning.paths import accesses, connections
from controller.planning.plan import GatedPrediction, gated_predictions, laser_step
from controller.planning.poses import BoolArray
from controller.planning.steps import Step
from controller.planning.workspace import Candidates, Workspace, observations_of, rows_of
from estimation import design
from estimation.belief import Belief
from estimation.design import DesignProblem
from estimation.kinematics import ArmModel
from estimation.measurement import Chain, Observations, Points
from estimation.model import Rows
from estimation.solver import predicted_belief

ROUND: Final = 10  # measurements after which candidates are drawn anew, around what is known by then
ADDED_NOTE: Final = "added"
_AS_GOOD: Final = 0.9  # of what the best one gains: among these the one with the shortest way is taken
_MISSED_M: Final = 0.006  # about a point where nothing was seen, nothing is tried again


@dataclass(frozen=True, eq=False)
class Prospect:
    """What may be measured next, as seen from a belief that has used the samples before."""

    workspace: Workspace
    pool: Candidates
    points: Points  # gated, with derivatives by the belief
    names: tuple[str, ...]
    phase: str
    blocked: Blocked | None = None

    @staticmethod
    def of_hand_eye(
        cell: Cell, belief: Belief, arm: ArmModel, spec: job.HandEyePhase, seed: int
    ) -> "Prospect":
        """Beams onto the plate; the better the belief, the more of the working range they use."""
        workspace = Workspace(cell, arm, belief)
        points, names = hand_eye_points(belief, spec.gated_ranges_m)
        return Prospect(workspace, plate_candidates(workspace, seed), points, names, spec.name)

    @staticmethod
    def of_part(cell: Cell, belief: Belief, arm: ArmModel, spec: job.LocalizePhase, seed: int) -> "Prospect":
        """Beams onto the faces of the part, as near to their edges as the belief allows."""
        workspace = Workspace(cell, arm, belief)
        points, names = corner_points(cell, belief)
        pool = part_candidates(workspace, spec.faces, seed, margin_m=margin_m(workspace))
        return Prospect(workspace, pool, points, names, spec.name, blocked_beams(workspace))

    def U_m(self, taken: Sequence[Observations]) -> float:
        """Predicted U of the worst gated point after further measurements."""
        return max(point.U_m for point in self._gated(self._after(taken)))

    def best(self, count: int) -> GatedPrediction:
        """The worst gated point after `count` further measurements, the best that can be found."""
        chosen = design.choose(self._problem(self.workspace.belief), min(count, len(self.pool))).chosen
        known = self._after([observations_of(self.workspace, self.pool.take(chosen))])
        return max(self._gated(known), key=lambda point: point.U_m)

    def next_step(
        self, taken: Sequence[Observations], tried: Sequence[Step], missed: Sequence[Step]
    ) -> Step | None:
        """The next best measurement, or None when none is left.

        Parameters
        ----------
        taken : measurements that the belief of this prospect has not used yet.
        tried : steps up to now, at least one; no posture is taken twice.
        missed : those that saw nothing; their surroundings are left out.
        """
        after, worth = tried[-1], design.worth(self._problem(self._after(taken)))
        worth[~self._untried(tried, missed)] = -1.0
        while (best := float(worth.max(initial=-1.0))) > 0.0:
            as_good = np.flatnonzero(worth >= _AS_GOOD * best)
            travel = np.abs(self.pool.joints_rad[as_good] - np.array(after.end_rad)).max(axis=1)
            row = int(as_good[np.argmin(travel)])
            if (step := self._step(row, after)) is not None:
                return step
            worth[row] = -1.0
        return None

    @cached_property
    def _rows(self) -> Rows:
        return rows_of(self.workspace, self.pool)

    def _problem(self, known: Belief) -> DesignProblem:
        rows = self._rows
        return DesignProblem(known.covariance, rows.dense(known), rows.noise_variance, self.points.jacobian)

    def _after(self, taken: Sequence[Observations]) -> Belief:
        belief = self.workspace.belief
        return (
            predicted_belief(belief, Chain(self.workspace.arm, list(taken)), self.phase) if taken else belief
        )

    def _gated(self, belief: Belief) -> tuple[GatedPrediction, ...]:
        return gated_predictions(belief, self.points, self.names)

    def _untried(self, tried: Sequence[Step], missed: Sequence[Step]) -> BoolArray:
        """Candidates (m,) that no step has taken, away from points that were missed."""
        untried = np.ones(len(self.pool), dtype=np.bool_)
        for step in tried:
            untried &= np.any(self.pool.joints_rad != np.array(step.joints_rad), axis=1)
        for step in missed:
            apart = np.linalg.norm(self.pool.object_p_m - np.array(step.object_p_m), axis=1)
            untried &= apart > _MISSED_M
        return untried

    def _step(self, row: int, after: Step) -> Step | None:
        """The measurement of one candidate with its way, or None when it is blocked."""
        one, keepout = self.pool.take([row]), self.workspace.keepout
        (access,) = accesses(keepout, one.joints_rad)
        if access is None or (self.blocked is not None and self.blocked(one)[0]):
            return None
        via = access
        if not after.retreat:
            before = tuple(np.array(posture) for posture in after.access)
            both = np.stack([np.array(after.joints_rad), one.joints_rad[0]])
            via = connections(keepout, both, [before, access])[1]
        return laser_step(one, 0, via, access, ADDED_NOTE)
