"""A plan: steps, and what they will make of the gated quantity."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from controller.planning.paths import Route, accesses, connections, nearest_order, require_all
from controller.planning.poses import BoolArray
from controller.planning.steps import Joints, Kind, Step, as_joints
from controller.planning.workspace import Candidates, Workspace
from estimation.belief import Belief
from estimation.measurement import Points
from estimation.statistics import coverage_factor

SLACK: Final = 1.05  # a prediction is not exact; what is so near to a limit is left to the gate itself
MARGIN: Final = 0.05  # of the limit, by which U must stay below it before measuring ends


@dataclass(frozen=True, slots=True)
class GatedPrediction:
    """What a plan leaves at one gated point."""

    name: str
    U_m: float  # 3-D, 95 %
    shares: Mapping[str, float]  # of the variance along the worst axis, by source, largest first

    @property
    def dominating(self) -> tuple[str, float]:
        """The largest source and its share."""
        return next(iter(self.shares.items()))

    def may_meet(self, limit_m: float) -> bool:
        """Whether the limit can be met, as far as a prediction can tell."""
        return self.U_m <= limit_m * SLACK


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Steps in order; `belief` is the predicted one, None where nothing is estimated.

    `curve_U_m` is the U of the worst gated point after 0, 1, 2 ... measurements in the order of choice, which
    is not that of the steps.
    """

    steps: tuple[Step, ...]
    gated: tuple[GatedPrediction, ...] = ()
    belief: Belief | None = None
    curve_U_m: tuple[float, ...] = ()

    @property
    def worst(self) -> GatedPrediction | None:
        """The gated point with the largest predicted U."""
        return max(self.gated, key=lambda point: point.U_m, default=None)

    def to_dict(self) -> dict[str, Any]:
        """For the console and the page."""
        return {
            "steps": [step.to_dict() for step in self.steps],
            "gated": [
                {"point": point.name, "U_m": point.U_m, "budget": dict(point.shares)} for point in self.gated
            ],
            "curve_U_m": list(self.curve_U_m),
        }


def gated_predictions(belief: Belief, points: Points, names: Sequence[str]) -> tuple[GatedPrediction, ...]:
    """U and budget of gated points, as a belief knows them."""
    values, axes = np.linalg.eigh(points.covariance(belief))
    factor = coverage_factor(3)
    predictions = []
    parts = points.budget(belief)
    for i, name in enumerate(names):
        along = axes[i, :, -1]
        shares = {source: float(along @ part[i] @ along / values[i, -1]) for source, part in parts.items()}
        ordered = dict(sorted(shares.items(), key=lambda item: -item[1]))
        predictions.append(GatedPrediction(name, float(factor * np.sqrt(values[i, -1])), ordered))
    return tuple(predictions)


def laser_steps(workspace: Workspace, chosen: Candidates, note: str | Sequence[str] = "") -> tuple[Step, ...]:
    """Steps for laser measurements, in an order of short travel, clear of everything.

    Raises Unreachable when one of them cannot be approached; `accessible` says which beforehand.
    """
    order = nearest_order(chosen.joints_rad, workspace.start_rad)
    ordered = chosen.take(order)
    notes = [note] * len(order) if isinstance(note, str) else [note[i] for i in order]
    routes = require_all(accesses(workspace.keepout, ordered.joints_rad), f"the {chosen.object}")
    vias = connections(workspace.keepout, ordered.joints_rad, routes)
    steps = [laser_step(ordered, i, vias[i], routes[i], notes[i], number=i) for i in range(len(ordered))]
    return closed(steps)


def laser_step(
    candidates: Candidates,
    row: int,
    via: Route,
    access: Route,
    note: str = "",
    number: int = 0,
    kind: Kind = "laser",
) -> Step:
    """One laser measurement as a step."""
    return Step(
        id=f"{number + 1:03d}",
        kind=kind,
        object=candidates.object,
        feature=candidates.features[int(candidates.feature_index[row])].name,
        joints_rad=as_joints(candidates.joints_rad[row]),
        via=postures(via),
        access=postures(access),
        expected_m=float(candidates.reading_m[row]),
        object_p_m=as_joints(candidates.object_p_m[row]),
        note=note,
    )


def closed(steps: Sequence[Step]) -> tuple[Step, ...]:
    """The steps, the last one ending in a carrying posture."""
    if not steps:
        return ()
    last = steps[-1]
    return (*steps[:-1], replace(last, retreat=(*last.retreat, *reversed(last.access))))


def accessible(workspace: Workspace, candidates: Candidates) -> BoolArray:
    """Which candidates (m,) can be approached clear of everything."""
    return np.array(
        [route is not None for route in accesses(workspace.keepout, candidates.joints_rad)], dtype=bool
    )


def postures(route: Route) -> tuple[Joints, ...]:
    """A route as plain tuples."""
    return tuple(as_joints(posture) for posture in route)
