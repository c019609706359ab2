"""The cell as a planner sees it: where things are believed to be, the tool, and what to keep clear of."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from controller.cellfile import Cell
from controller.knowledge import joint_variance, object_features, part_corners_m, part_faces
from controller.planning.keepout import Box, Keepout, ToolOutline
from controller.planning.paths import carrying
from controller.planning.poses import BoolArray, IntArray
from estimation.belief import Belief
from estimation.kinematics import ArmModel
from estimation.measurement import Chain, Observations, object_point_jacobian
from estimation.model import Rows, evaluate
from estimation.surfaces import Feature
from estimation.transform import FloatArray, Transform

BENCH_BELOW_M: Final = -1.0  # boxes reach down to the bench: what carries an object is as solid as the object
PLANNED_CYCLES: Final = 100  # laser cycles averaged in one measurement, about
SIGMAS: Final = 2.5  # how far off a thing may be, in standard uncertainties, for a plan to hold still
_BOX_SIGMAS: Final = 3.0
_LEAST_GROWTH_M: Final = 0.002


@dataclass(frozen=True, eq=False)
class Workspace:
    """Cell, nominal arm and belief together; everything derived is computed once."""

    cell: Cell
    arm: ArmModel
    belief: Belief

    def pose(self, name: str) -> Transform:
        """base_T_object or flange_T_sensor: as believed, or as the cell file says."""
        if name in self.belief:
            return self.belief.transform(name)
        nominal = {placement.FRAME: placement for placement in self.cell.placements}
        return nominal[name].transform()

    @cached_property
    def actual_arm(self) -> ArmModel:
        """The arm with what was learnt of its geometry."""
        if "kinematics" not in self.belief:
            return self.arm
        return self.arm.with_deviation(self.belief.vector("kinematics"))

    @cached_property
    def start_rad(self) -> FloatArray:
        """A carrying posture: where plans begin and end."""
        start: FloatArray = carrying(self.keepout, np.array([self.cell.robot.start_joints_rad]))[0]
        return start

    @cached_property
    def keepout(self) -> Keepout:
        """All boxes, grown by what the places of the objects are uncertain by."""
        outline = ToolOutline.of(self.pose("laser"), self.pose("probe"), float(self.arm.d[-1]))
        boxes = (*self._standing_boxes(), self._part_box())
        return Keepout(self.arm, outline, boxes, self.cell.robot.forearm_m)

    def part_offset_m(self) -> float:
        """How far any point of the part may lie from where it is believed to be."""
        part = self.cell.part
        corners = part_corners_m(self.cell)
        reach_m = float(np.linalg.norm(corners, axis=1).max())
        limit_m = part.position_limit_m + part.rotation_limit_rad * reach_m
        if "part" not in self.belief:
            return limit_m
        covariance = object_point_jacobian(self.belief, "part", corners).covariance(self.belief)
        return min(_BOX_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(covariance).max())), limit_m)

    def _standing_boxes(self) -> tuple[Box, ...]:
        cell = self.cell
        half_x, half_y = cell.plate.size_m[0] / 2, cell.plate.size_m[1] / 2
        plate_m = self._growth_m(
            "plate", cell.plate.position_u_m, cell.plate.rotation_u_rad * max(half_x, half_y)
        )
        plate = _box("plate", self.pose("plate"), [-half_x, -half_y, 0.0], [half_x, half_y, 0.0], plate_m)
        bar_m = self._growth_m("bar", cell.bar.position_u_m, cell.bar.rotation_u_rad * cell.bar.length_m)
        ends = self.pose("bar").points(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, cell.bar.length_m]]))
        sphere_m = self._growth_m("sphere", cell.sphere.position_u_m, 0.0)
        balls = [
            ("bar", ends[0], cell.bar.sphere_radius_m, bar_m),
            ("bar", ends[1], cell.bar.sphere_radius_m, bar_m),
            ("sphere", self.pose("sphere").origin_m, cell.sphere.radius_m, sphere_m),
        ]
        upright = [
            _box(name, _shifted(centre), [-radius] * 3, [radius] * 3, growth)
            for name, centre, radius, growth in balls
        ]
        return (plate, *upright)

    def _part_box(self) -> Box:
        bounds = np.array([face.bounds_m for face in part_faces(self.cell).values()])
        low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
        return _box("part", self.pose("part"), low, high, max(self.part_offset_m(), _LEAST_GROWTH_M))

    def _growth_m(self, name: str, position_u_m: float, turn_u_m: float) -> float:
        if name in self.belief:
            covariance = self.belief.block_covariance(name)
            places = [
                i for i, freedom in enumerate(self.belief.block(name).freedoms) if freedom.startswith("t")
            ]
            std_m = float(np.sqrt(np.diag(covariance)[places].max()))
        else:
            std_m = float(np.hypot(position_u_m, turn_u_m))
        return max(_BOX_SIGMAS * std_m, _LEAST_GROWTH_M)


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Measurements that could be taken: clear of everything, in range, each with its row of the model."""

    sensor: str
    object: str
    features: tuple[Feature, ...]
    joints_rad: FloatArray  # (m, 6)
    reading_m: FloatArray  # (m,) expected; zeros for touches
    feature_index: IntArray  # (m,)
    object_p_m: FloatArray  # (m, 3)

    def __len__(self) -> int:
        return len(self.joints_rad)

    @staticmethod
    def joined(batches: Sequence["Candidates"]) -> "Candidates":
        """All of several batches with the same sensor, object and features."""
        first = batches[0]
        return Candidates(
            first.sensor,
            first.object,
            first.features,
            np.concatenate([batch.joints_rad for batch in batches]),
            np.concatenate([batch.reading_m for batch in batches]),
            np.concatenate([batch.feature_index for batch in batches]),
            np.concatenate([batch.object_p_m for batch in batches]),
        )

    def take(self, rows: IntArray | BoolArray | list[int]) -> "Candidates":
        """Some of them."""
        return Candidates(
            self.sensor,
            self.object,
            self.features,
            self.joints_rad[rows],
            self.reading_m[rows],
            self.feature_index[rows],
            self.object_p_m[rows],
        )


def observations_of(workspace: Workspace, candidates: Candidates) -> Observations:
    """The candidates as if they had been measured, with the noise that the cell file declares."""
    cell, count = workspace.cell, len(candidates)
    if candidates.sensor == "laser":
        variance = range_variance(cell)
        readings = cell.robot.readings
    else:
        travel_m = cell.probe.touch_speed_m_s * cell.probe.poll_period_s
        variance, readings = cell.probe.noise_m**2 + travel_m**2 / 12, 1
    flatness_m = cell.plate.flatness_u_m if candidates.object == "plate" else 0.0
    return Observations(
        sensor="laser" if candidates.sensor == "laser" else "probe",
        object=candidates.object,
        joints_rad=candidates.joints_rad,
        joint_variance=np.full((count, 6), joint_variance(cell, readings)),
        reading_m=candidates.reading_m,
        reading_variance=np.full(count, variance),
        surface_variance=np.full(count, flatness_m**2),
        features=candidates.features,
        feature_index=candidates.feature_index,
    )


def range_variance(cell: Cell) -> float:
    """Variance (m^2) of one laser measurement: speckle, and what averaging leaves of the cycles."""
    return cell.laser.noise_m**2 + cell.laser.reading_noise_m**2 / PLANNED_CYCLES


def rows_of(workspace: Workspace, candidates: Candidates) -> Rows:
    """Residuals and derivatives of the candidates at the belief's values."""
    return evaluate(workspace.belief, Chain(workspace.arm, [observations_of(workspace, candidates)]))


def features_of(workspace: Workspace, name: str) -> tuple[Feature, ...]:
    """The features of an object whose deviations the belief knows, or that have none."""
    return tuple(
        feature
        for feature in object_features(workspace.cell, name)
        if all(block in workspace.belief for block in feature.blocks)
    )


def _box(
    name: str,
    base_T_box: Transform,
    low: FloatArray | list[float],
    high: FloatArray | list[float],
    growth_m: float,
) -> Box:
    grown_low, grown_high = np.asarray(low) - growth_m, np.asarray(high) + growth_m
    grown_low[2] = BENCH_BELOW_M
    return Box(name, base_T_box, grown_low, grown_high)


def _shifted(origin_m: FloatArray) -> Transform:
    matrix = np.eye(4)
    matrix[:3, 3] = origin_m
    return Transform("base", "box", matrix)
