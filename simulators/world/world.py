"""The true scene: what the laser beam meets and what the stylus ball touches."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol

import numpy as np

from estimation.transform import FloatArray, exp_pose
from simulators.world.kinematics import Triple, TrueArm
from simulators.world.solid import Hit, Solid
from simulators.world.step_faces import read_faces
from simulators.world.truth import Truth, stream
from simulators.world.world_file import WorldFile

MOVING_SAMPLES: Final = 16  # of the distance, in a window during which the arm moves
OUT_OF_SIGHT_M: Final = 10.0
ENOUGH_M: Final = 1e-3  # an object so much farther away than another need not be measured exactly


class Motion(Protocol):
    """The moving arm, as far as the scene must know it."""

    def advance(self, time_s: float) -> None:
        """Let everything happen that is due by then."""

    def joints_at(self, time_s: float) -> FloatArray:
        """True joint angles (n,), rad."""

    def standstill(self, time_s: float) -> tuple[int, ...] | None:
        """Which standstill this is; None while a joint moves."""


class World:
    """Positions in base, metres. Changes at run time: `bump_laser`, `part_present`."""

    def __init__(
        self,
        file: WorldFile,
        truth: Truth,
        arm: Motion,
        noise_factor: float = 1.0,
        part_present: bool = True,
        cache_dir: Path | None = None,
    ) -> None:
        self.file, self.truth, self.noise_factor = file, truth, noise_factor
        self.revision = 0  # counts the changes at run time
        self._arm = arm
        self._kinematics = TrueArm(truth.link_parameters)
        self._part_present = part_present
        self.flange_T_laser = truth.flange_T_laser.copy()
        self._solid = Solid(read_faces(file.part.cad, cache_dir), file.part.features, truth.features)
        self._spheres = self._place_spheres()
        self._plate_T_base = _inverse(truth.base_T_plate)
        self._part_T_base = _inverse(truth.base_T_part)
        self._to_plate, self._to_part = _mover(self._plate_T_base), _mover(self._part_T_base)
        self._half_plate = [float(size) / 2 for size in file.plate.size_m]
        self._min_cosine = math.cos(file.laser.max_incidence_rad)
        self._point_noise = stream(truth.seed, "noise.laser.point")
        self._standstill: tuple[object, float] = (None, math.nan)
        ball_x, ball_y, ball_z = truth.flange_T_probe[:3, 3].tolist()
        self._ball = (ball_x, ball_y, ball_z)

    def _place_spheres(self) -> list[tuple[str, list[float], float]]:
        t = self.truth
        near = t.base_T_bar[:3, 3]
        far = near + t.base_T_bar[:3, 2] * t.bar_length_m
        return [
            ("bar.1", near.tolist(), float(t.bar_radii_m[0])),
            ("bar.2", far.tolist(), float(t.bar_radii_m[1])),
            ("sphere", t.base_T_sphere[:3, 3].tolist(), t.sphere_radius_m),
        ]

    # -- changes at run time ---------------------------------------------------------------------

    def bump_laser(self, translation_m: FloatArray, rotation_rad: FloatArray) -> None:
        """Somebody knocks the laser: a right perturbation of its mount."""
        xi = np.concatenate([np.asarray(translation_m, float), np.asarray(rotation_rad, float)])
        self.flange_T_laser = self.flange_T_laser @ exp_pose(xi)
        self.revision += 1

    @property
    def part_present(self) -> bool:
        return self._part_present

    @part_present.setter
    def part_present(self, present: bool) -> None:
        self._part_present = present
        self.revision += 1

    # -- laser -----------------------------------------------------------------------------------

    def flange_pose(self, joints_rad: FloatArray) -> FloatArray:
        """True base_T_flange (4, 4)."""
        return self._kinematics.flange_pose(joints_rad)

    def beam_hit(self, joints_rad: FloatArray) -> Hit | None:
        """What the beam meets first, at whatever incidence; None if nothing."""
        pose = self.flange_pose(joints_rad) @ self.flange_T_laser
        return self.ray_hit(pose[:3, 3], pose[:3, 2])

    def ray_hit(self, origin: FloatArray, direction: FloatArray) -> Hit | None:
        """The first surface along a ray from `origin` (3,) in the unit `direction` (3,), both in base."""
        best = self._plate_hit(origin, direction)
        nearest = best.distance_m if best else OUT_OF_SIGHT_M
        start, way = origin.tolist(), direction.tolist()
        for name, centre, radius in self._spheres:
            along = sum([(c - o) * d for c, o, d in zip(centre, start, way, strict=True)])
            rest = radius**2 - math.dist(centre, start) ** 2 + along**2
            if rest > 0 and 0 < (distance := along - math.sqrt(rest)) < nearest:
                nearest = distance
                best = Hit(distance, math.sqrt(rest) / radius, name)
        if self._part_present:
            matrix = self._part_T_base
            rotation = matrix[:3, :3]
            best = self._solid.hit(rotation @ origin + matrix[:3, 3], rotation @ direction, nearest) or best
        return best

    def _plate_hit(self, origin: FloatArray, direction: FloatArray) -> Hit | None:
        matrix = self._plate_T_base
        x, y, z = (matrix[:3, :3] @ origin + matrix[:3, 3]).tolist()
        dx, dy, dz = (matrix[:3, :3] @ direction).tolist()
        if z <= 0 or dz >= -1e-9:
            return None
        distance = -z / dz
        inside = (
            abs(x + distance * dx) <= self._half_plate[0] and abs(y + distance * dy) <= self._half_plate[1]
        )
        return Hit(distance, -dz, "plate") if inside else None

    def beam_length_m(self, joints_rad: FloatArray, draw: FloatArray) -> float:
        """True distance along the beam with the scatter of the point, or nan if no light comes back.

        `draw` (2,) are standard normal numbers: of the speckle, and of the surface.
        """
        hit = self.beam_hit(joints_rad)
        if hit is None or hit.cosine < self._min_cosine:
            return math.nan
        scatter = float(draw[0]) * self.file.laser.point_noise_m
        if hit.surface == "plate":
            scatter += float(draw[1]) * self.file.plate.flatness_m / hit.cosine
        return hit.distance_m + scatter * self.noise_factor

    def beam_lengths_m(self, times_s: FloatArray) -> FloatArray:
        """True distances (n,) along the beam at increasing past instants (n,); nan where no light returns.

        The scatter of the point is one draw per standstill. While the arm moves, a few instants are
        computed and the others interpolated.
        """
        first, last = float(times_s[0]), float(times_s[-1])
        self._arm.advance(last)
        key = self._arm.standstill(last)
        if key is not None and self._arm.standstill(first) == key:
            if self._standstill[0] != (key, self.revision):
                joints = self._arm.joints_at(last)
                length = self.beam_length_m(joints, self._point_noise.standard_normal(2))
                self._standstill = ((key, self.revision), length)
            return np.full(len(times_s), self._standstill[1])
        instants = np.linspace(first, last, MOVING_SAMPLES)
        draws = self._point_noise.standard_normal((MOVING_SAMPLES, 2))
        lengths = np.array(
            [
                self.beam_length_m(self._arm.joints_at(float(t)), d)
                for t, d in zip(instants, draws, strict=True)
            ]
        )
        return np.asarray(np.interp(times_s, instants, lengths), dtype=np.float64)

    # -- stylus ----------------------------------------------------------------------------------

    def clearances_m(self, joints_rad: FloatArray) -> list[tuple[str, float]]:
        """Gap between the stylus ball and each object, negative when pressed in; surface by surface."""
        return self.ball_clearances_m(self.ball(joints_rad))

    def ball(self, joints_rad: FloatArray) -> Triple:
        """True centre of the stylus ball in base."""
        return self._kinematics.point(joints_rad, self._ball)

    def ball_clearances_m(self, centre: Triple) -> list[tuple[str, float]]:
        """The same, for the ball centre in base; of the part only a lower bound where others are nearer."""
        radius = self.truth.probe_radius_m
        gaps = [(name, math.dist(centre, middle) - size - radius) for name, middle, size in self._spheres]
        gaps.append(("plate", self._plate_distance(self._to_plate(centre)) - radius))
        if self._part_present:
            enough_m = min([gap for _, gap in gaps]) + radius + ENOUGH_M
            gaps.append(("part", self._solid.signed_distance(self._to_part(centre), enough_m) - radius))
        return gaps

    def _plate_distance(self, point: Triple) -> float:
        x, y, z = point
        half = self.file.plate.thickness_m / 2
        beside_x, beside_y = abs(x) - self._half_plate[0], abs(y) - self._half_plate[1]
        above = abs(z + half) - half
        if beside_x <= 0 and beside_y <= 0:
            return max(above, beside_x, beside_y) if above <= 0 else above
        return math.sqrt(max(beside_x, 0.0) ** 2 + max(beside_y, 0.0) ** 2 + max(above, 0.0) ** 2)

    def ball_reaches_m(self) -> FloatArray:
        """How far (n,) the ball can be from each joint's axis: bounds its speed."""
        tool = math.hypot(*self._ball)
        links = np.abs(self.truth.link_parameters[:, 1]) + np.abs(self.truth.link_parameters[:, 2])
        reaches: FloatArray = np.cumsum(links[::-1])[::-1] + tool
        return reaches


def _mover(matrix: FloatArray) -> Callable[[Triple], Triple]:
    """Moves single points by `matrix` (4, 4): plain floats are faster than arrays here."""
    (xx, xy, xz, xt), (yx, yy, yz, yt), (zx, zy, zz, zt), _ = matrix.tolist()

    def move(point: Triple) -> Triple:
        x, y, z = point
        return (
            xx * x + xy * y + xz * z + xt,
            yx * x + yy * y + yz * z + yt,
            zx * x + zy * y + zz * z + zt,
        )

    return move


def _inverse(matrix: FloatArray) -> FloatArray:
    result = np.eye(4)
    result[:3, :3] = matrix[:3, :3].T
    result[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return result
