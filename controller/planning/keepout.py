"""What the arm must not touch: boxes around everything that stands in the cell, the bench and the arm's base.

No collision library: points of forearm, wrist, flange, the laser's head and the stylus, each with a radius,
against boxes. Good for planned postures and the straight joint paths between them, in a cell laid out for it.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from controller.planning.poses import BoolArray
from estimation.kinematics import ArmModel
from estimation.transform import FloatArray, Transform

BENCH_M: Final = 0.02  # least height of any point of the tool above the bench, z = 0 of the base
COLUMN_RADIUS_M: Final = 0.11  # the arm's own base, as high as
COLUMN_HEIGHT_M: Final = 0.40
ELBOW_HEIGHT_M: Final = 0.20
CLEARANCE_M: Final = 0.008
SAMPLES: Final = 12  # along one joint path
FOREARM_SAMPLES: Final = 16  # from wrist to elbow: between two, 3 mm of the clearance are lost

# Outlines in the frames of the sensors: a laser head of 46 x 30 x 40 mm behind its window, a stylus.
_LASER_HEAD: Final = np.array(
    [[x, y, z] for x in (-0.015, 0.015) for y in (-0.023, 0.023) for z in (0.0, -0.02, -0.04)]
)
_STYLUS: Final = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -0.015], [0.0, 0.0, -0.03], [0.0, 0.0, -0.045]])
_PROBE_BODY: Final = np.array([[x, y, -0.055] for x in (-0.012, 0.012) for y in (-0.012, 0.012)])


@dataclass(frozen=True, slots=True, eq=False)
class ToolOutline:
    """Points of what the flange carries, and of the wrist behind it, frame flange."""

    points_m: FloatArray  # (k, 3)
    radius_m: FloatArray  # (k,)
    stylus: BoolArray  # (k,) the points that may come near what they touch
    sensors: BoolArray  # (k,) laser, probe and stylus, without bracket and wrist

    @staticmethod
    def of(flange_T_laser: Transform, flange_T_probe: Transform, wrist_m: float) -> "ToolOutline":
        """For sensors on their mounts; the wrist's centre is `wrist_m` behind the flange."""
        laser, stylus = flange_T_laser.points(_LASER_HEAD), flange_T_probe.points(_STYLUS)
        body = flange_T_probe.points(_PROBE_BODY)
        arm = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -wrist_m / 2], [0.0, 0.0, -wrist_m]])
        # The bracket runs from the flange to either sensor.
        bracket = np.stack([0.5 * laser.mean(axis=0), 0.5 * body.mean(axis=0)])
        points = np.concatenate([laser, body, bracket, arm, stylus])
        radius = np.concatenate(
            [
                np.zeros(len(laser) + len(body)),
                [0.01, 0.01],
                [0.03, 0.04, 0.045],
                np.full(len(stylus), 0.0015),
            ]
        )
        place, heads, stem = np.arange(len(points)), len(laser) + len(body), len(points) - len(stylus)
        return ToolOutline(points, radius, place >= stem, (place < heads) | (place >= stem))


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """Something solid; `low_m` and `high_m` (3,) in its own frame, with what its place is uncertain by."""

    name: str
    base_T_box: Transform
    low_m: FloatArray
    high_m: FloatArray

    @property
    def top_m(self) -> float:
        """Height of its highest corner over the bench: a tilted box stands higher than it is."""
        up = self.base_T_box.rotation[2]
        return float(self.base_T_box.origin_m[2] + np.maximum(up * self.low_m, up * self.high_m).sum())


@dataclass(frozen=True, eq=False)
class Keepout:
    """Boxes, bench and base, and the tool that must stay clear of them."""

    arm: ArmModel
    outline: ToolOutline
    boxes: tuple[Box, ...]
    forearm_m: float  # radius, from the elbow to the wrist

    def clear(self, joints_rad: FloatArray, touching: str = "") -> BoolArray:
        """Whether postures (..., 6) are clear; the stylus may be near the box of the name `touching`."""
        shape = joints_rad.shape[:-1]
        joints = joints_rad.reshape(-1, 6)
        flange = self.arm.flange_pose(joints)
        elbow, wrist = self._forearm(joints, flange)
        free = elbow[:, 2] > ELBOW_HEIGHT_M
        rotation, origin = flange[:, :3, :3], flange[:, :3, 3]
        points = rotation @ self.outline.points_m.T + origin[:, :, None]  # (m, 3, k)
        radius = self.outline.radius_m
        height = points[:, 2] - radius
        free &= (height > BENCH_M).all(axis=1)
        across = points[:, 0] ** 2 + points[:, 1] ** 2 < (COLUMN_RADIUS_M + radius) ** 2
        beside: BoolArray = np.logical_and(across, height < COLUMN_HEIGHT_M)
        free &= ~beside.any(axis=1)
        bent = np.abs(self.arm.theta[4] + joints[:, 4])
        folded = np.flatnonzero(free & (bent > self.folded_rad))
        free[folded] = self._beside_forearm(elbow[folded], wrist[folded], points[folded])
        lowest = np.minimum(elbow[:, 2], wrist[:, 2]) - self.forearm_m - CLEARANCE_M
        for box in self.boxes:
            which = ~self.outline.stylus if box.name == touching else slice(None)
            room = (radius[which] + CLEARANCE_M)[:, None]
            low, high = box.low_m[:, None] - room.T, box.high_m[:, None] + room.T
            turn, place = box.base_T_box.rotation.T, box.base_T_box.origin_m
            middle = (origin - place) @ turn.T
            apart = np.maximum(np.maximum(box.low_m - middle, middle - box.high_m), 0.0)
            near = np.flatnonzero(free & ((apart**2).sum(axis=1) < self._reach_m**2))
            local = turn @ (points[near][:, :, which] - place[:, None])
            inside = np.asarray(((local > low) & (local < high)).all(axis=1))
            free[near[inside.any(axis=1)]] = False
            under = np.flatnonzero(free & (lowest < box.top_m))
            free[under] = self._forearm_clear(elbow[under], wrist[under], box)
        shaped: BoolArray = free.reshape(shape)
        return shaped

    def _forearm(self, joints: FloatArray, flange: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Elbow and wrist (m, 3) at joints (m, 6)."""
        angle, turn = self.arm.theta[1] + joints[:, 1], self.arm.theta[0] + joints[:, 0]
        out = self.arm.a[0] + self.arm.a[1] * np.cos(angle)
        rise = self.arm.d[0] + self.arm.a[1] * np.sin(angle)
        elbow = np.stack([out * np.cos(turn), out * np.sin(turn), rise], axis=1)
        return elbow, flange[:, :3, 3] - self.arm.d[-1] * flange[:, :3, 2]

    def _forearm_clear(self, elbow: FloatArray, wrist: FloatArray, box: Box) -> BoolArray:
        """Whether the forearms from elbows to wrists (m, 3) are clear of a box."""
        share = np.linspace(0.0, 1.0, FOREARM_SAMPLES)[:, None]
        points = wrist[:, None] + share * (elbow - wrist)[:, None]
        local = (points - box.base_T_box.origin_m) @ box.base_T_box.rotation
        beside = np.maximum(np.maximum(box.low_m - local, local - box.high_m), 0.0)
        apart = np.linalg.norm(beside, axis=2)
        clear: BoolArray = np.all(apart > self.forearm_m + CLEARANCE_M, axis=1)
        return clear

    def _beside_forearm(self, elbow: FloatArray, wrist: FloatArray, points: FloatArray) -> BoolArray:
        """Whether the sensors' points (m, 3, k) are clear of the arm's own forearm."""
        along = elbow - wrist
        tool = self.outline.sensors
        offset = points[:, :, tool] - wrist[:, :, None]
        share = np.clip(np.einsum("mi,mik->mk", along, offset) / (along**2).sum(axis=1)[:, None], 0.0, 1.0)
        apart = np.linalg.norm(offset - along[:, :, None] * share[:, None], axis=1)
        clear: BoolArray = np.all(apart > self.forearm_m + CLEARANCE_M + self.outline.radius_m[tool], axis=1)
        return clear

    @cached_property
    def folded_rad(self) -> float:
        """How far axis 5 may bend, from straight, before a sensor can come near the forearm at some spin.

        A point at a distance from the wrist and an angle from the flange's axis comes to within
        distance sin(bend + angle) of the line of the forearm, once that passes 90 deg.
        """
        tool = self.outline.sensors
        points = self.outline.points_m[tool] + [0.0, 0.0, self.arm.d[-1]]
        distance = np.linalg.norm(points, axis=1)
        room = self.forearm_m + CLEARANCE_M + self.outline.radius_m[tool]
        angle = np.arccos(points[:, 2] / distance)
        near = np.pi - np.arcsin(np.minimum(room / distance, 1.0)) - angle
        skew = np.arctan2(abs(self.arm.a[2]), abs(self.arm.d[3]))  # of that line against axis 4
        return float(max(near.min() - skew, 0.0))

    @cached_property
    def _reach_m(self) -> float:
        """How far from the flange the tool can meet anything."""
        reach = np.linalg.norm(self.outline.points_m, axis=1) + self.outline.radius_m
        return float(reach.max() + CLEARANCE_M)

    def path_clear(self, start_rad: FloatArray, end_rad: FloatArray, touching: str = "") -> BoolArray:
        """Whether straight joint paths (m, 6) to (m, 6) are clear between their ends."""
        fractions = np.arange(1, SAMPLES) / SAMPLES
        postures = start_rad[:, None] + fractions[:, None] * (end_rad - start_rad)[:, None]
        along: BoolArray = np.all(self.clear(postures, touching), axis=1)
        return along
