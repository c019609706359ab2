"""Makes docs/bench-block.png: the bench-block cell, and what its planned poses are worth.

Run `.venv/bin/python docs/make_picture.py` from the root of the project. Everything is computed: the arm
from its kinematics, the part from its CAD file, the poses and the curve by the planner.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import to_rgb
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection  # type: ignore[import-untyped]

from controller.cellfile import Cell, HandEyePhase, load_cell
from controller.knowledge import all_faces, first_belief, with_plate
from controller.planning import Plan, plan_hand_eye
from controller.planning.candidates import plate_candidates
from controller.planning.estimated import hand_eye_points
from controller.planning.plan import gated_predictions
from controller.planning.workspace import Workspace, observations_of
from estimation.solver import predicted_belief
from estimation.transform import FloatArray

ROOT: Final = Path(__file__).parents[1]
PICTURE: Final = Path(__file__).with_name("bench-block.png")
SEED: Final = 1
COUNTS: Final = (10, 12, 15, 20, 28, 40, 56, 80, 112, 160)
RANDOM_DRAWS: Final = 12  # choices of random poses; their median and range are drawn
LIGHT: Final = np.array([0.35, -0.5, 0.8])

ARM, JOINT, TOOL = "#e8a33d", "#55606b", "#30383f"
PLATE, PART, STEEL, STAND = "#9fb8cc", "#86a886", "#c9ced3", "#d9d5ce"
BEAM, PLANNED, RANDOM, LIMIT = "#d1332e", "#1f5f99", "#8a8f94", "#d1332e"


@dataclass
class Scene:
    """Shaded polygons (metres, frame of the base), sorted together by depth when drawn."""

    faces: list[FloatArray]
    colours: list[tuple[float, float, float]]

    def add(self, faces: FloatArray, colour: str) -> None:
        """Polygons (k, corners, 3)."""
        light = LIGHT / np.linalg.norm(LIGHT)
        for face in faces:
            normal = np.cross(face[1] - face[0], face[2] - face[0])
            length = np.linalg.norm(normal)
            bright = 0.72 + 0.28 * float(normal @ light / length) if length > 0 else 0.7
            self.faces.append(face)
            self.colours.append(tuple(np.clip(np.array(to_rgb(colour)) * bright, 0, 1)))

    def box(self, low: list[float], high: list[float], colour: str, pose: FloatArray | None = None) -> None:
        """A box along the axes of its pose; its sides are cut up so that sorting by depth works."""
        pose = np.eye(4) if pose is None else pose
        size, start = np.array(high) - low, np.array(low)
        for axis in range(3):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            m, n = (max(1, round(size[i] / 0.04)) for i in (u, v))
            for side in (0.0, 1.0):
                for i in range(m):
                    for j in range(n):
                        corners = np.empty((4, 3))
                        for c, (a, b) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
                            corners[c, axis] = side
                            corners[c, u], corners[c, v] = (i + a) / m, (j + b) / n
                        corners = start + corners * size
                        outward = corners if side else corners[::-1]
                        self.add((outward @ pose[:3, :3].T + pose[:3, 3])[None], colour)

    def tube(self, start: FloatArray, end: FloatArray, radius_m: float, colour: str) -> None:
        """A round bar with its ends."""
        along = end - start
        axis = along / np.linalg.norm(along)
        across = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.8 else [0.0, 1.0, 0.0])
        across /= np.linalg.norm(across)
        turn = np.linspace(0, 2 * np.pi, 33)
        ring = radius_m * (np.outer(np.cos(turn), across) + np.outer(np.sin(turn), np.cross(axis, across)))
        pieces = max(1, round(float(np.linalg.norm(along)) / 0.015))
        for k in range(pieces):
            a, b = start + along * k / pieces + ring, start + along * (k + 1) / pieces + ring
            self.add(np.stack([a[:-1], a[1:], b[1:], b[:-1]], axis=1), colour)
        self.add((end + ring[:-1])[None], colour)
        self.add((start + ring[:-1][::-1])[None], colour)

    def ball(self, centre: FloatArray, radius_m: float, colour: str) -> None:
        """A sphere."""
        u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 19), np.linspace(0, np.pi, 10), indexing="ij")
        p = centre + radius_m * np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1)
        quads = np.stack([p[:-1, :-1], p[:-1, 1:], p[1:, 1:], p[1:, :-1]], axis=2)
        self.add(quads.reshape(-1, 4, 3), colour)


def standing(scene: Scene, cell: Cell) -> None:
    """Plate, bar, sphere and part on their stands."""
    plate = cell.plate.transform()
    half = np.array(cell.plate.size_m) / 2
    scene.box([-half[0], -half[1], -0.015], [half[0], half[1], 0.0], PLATE, plate.matrix)
    scene.box([-0.1, -0.1, -plate.origin_m[2]], [0.1, 0.1, -0.015], STAND, plate.matrix)
    ends = cell.bar.transform().points(np.array([[0.0, 0, 0], [0, 0, cell.bar.length_m]]))
    scene.tube(ends[0], ends[1], 0.006, JOINT)
    for end in ends:
        scene.ball(end, cell.bar.sphere_radius_m, STEEL)
    middle = ends.mean(axis=0)
    scene.tube(np.array([*middle[:2], 0.0]), middle - [0, 0, 0.006], 0.01, STAND)
    ball = cell.sphere.transform().origin_m
    scene.tube(np.array([*ball[:2], 0.0]), ball, 0.006, STAND)
    scene.ball(ball, cell.sphere.radius_m, STEEL)
    part = cell.part.transform()
    faces = all_faces(cell)
    for face in faces:
        scene.add(part.points(face.triangles.reshape(-1, 3)).reshape(-1, 3, 3), PART)
    points = np.concatenate([face.bounds_m for face in faces])
    low, high = points.min(axis=0), points.max(axis=0)
    scene.box([low[0], low[1], -part.origin_m[2]], [high[0], high[1], low[2]], STAND, part.matrix)


def arm(scene: Scene, cell: Cell, joints_rad: FloatArray) -> None:
    """The links between the axes, and what the flange carries."""
    model = cell.robot.arm_model()
    frames = [np.eye(4)]
    for i in range(model.joint_count):
        frames.append(frames[-1] @ link(cell, i, joints_rad[i]))
    p = [frame[:3, 3] for frame in frames]
    assert np.allclose(frames[-1], model.flange_pose(joints_rad[None])[0])
    scene.tube(np.zeros(3), np.array([0, 0, 0.05]), 0.085, JOINT)
    # a link begins and ends at the skin of its joints: polygons that cut each other cannot be sorted
    for start, end, radius, trims in (
        (p[0], p[1], 0.06, (0.05, 0.055)),
        (p[1], p[2], 0.05, (0.055, 0.047)),
        (p[3], p[4], 0.043, (0.047, 0.04)),
        (p[5], p[6], 0.035, (0.04, 0.0)),
    ):
        along = (end - start) / np.linalg.norm(end - start)
        scene.tube(start + trims[0] * along, end - trims[1] * along, radius, ARM)
    for place, axis, radius in ((p[1], frames[1], 0.064), (p[2], frames[2], 0.056), (p[4], frames[4], 0.047)):
        half = axis[:3, 2] * radius * 1.15
        scene.tube(place - half, place + half, radius, JOINT)
    flange = frames[-1]
    scene.box([-0.065, -0.018, 0.0], [0.085, 0.018, 0.012], TOOL, flange)
    scene.box([0.062, -0.014, 0.012], [0.098, 0.014, 0.06], TOOL, flange)
    probe = flange @ cell.probe.mount.transform().matrix
    scene.tube(probe[:3, 3] - 0.098 * probe[:3, 2], probe[:3, 3] - 0.04 * probe[:3, 2], 0.01, TOOL)
    scene.tube(probe[:3, 3] - 0.04 * probe[:3, 2], probe[:3, 3], 0.002, STEEL)


def link(cell: Cell, index: int, angle_rad: float) -> FloatArray:
    """Rz(theta + q) Tz(d) Tx(a) Rx(alpha) Ry(beta)."""
    model = cell.robot.arm_model()
    turn, twist, tilt = model.theta[index] + angle_rad, model.alpha[index], model.beta[index]
    z, x, y = np.eye(4), np.eye(4), np.eye(4)
    z[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    x[1:3, 1:3] = [[np.cos(twist), -np.sin(twist)], [np.sin(twist), np.cos(twist)]]
    y[0, 0], y[0, 2], y[2, 0], y[2, 2] = np.cos(tilt), np.sin(tilt), -np.sin(tilt), np.cos(tilt)
    shift = np.eye(4)
    shift[0, 3], shift[2, 3] = model.a[index], model.d[index]
    product: FloatArray = z @ shift @ x @ y
    return product


def beams(cell: Cell, plan: Plan) -> FloatArray:
    """Origin and end (m, 2, 3) of the beam of each planned pose."""
    joints = np.array([step.joints_rad for step in plan.steps])
    lasers = cell.robot.arm_model().flange_pose(joints) @ cell.laser.mount.transform().matrix
    lengths = np.array([step.expected_m for step in plan.steps])
    return np.stack([lasers[:, :3, 3], lasers[:, :3, 3] + lengths[:, None] * lasers[:, :3, 2]], axis=1)


def draw_cell(axes: Any, cell: Cell, plan: Plan) -> None:
    """The cell in 3-D with the beams of all planned poses."""
    drawn = beams(cell, plan)
    shown = int(np.argmin(drawn[:, 1] @ [1.0, -0.6, -1.0]))  # at the back of the plate, to hide little
    scene = Scene([], [])
    standing(scene, cell)
    arm(scene, cell, np.array(plan.steps[shown].joints_rad))
    colours = np.array(scene.colours)
    axes.add_collection3d(
        Poly3DCollection(scene.faces, facecolors=colours, edgecolors=colours, linewidths=0.3)
    )
    axes.add_collection3d(Line3DCollection(drawn, colors=BEAM, linewidths=0.7, alpha=0.75, zorder=10))
    axes.scatter(*drawn[:, 0].T, s=7, color=TOOL, depthshade=False, zorder=11)
    for text, place in (
        ("plate", (0.56, -0.16, 0.02)),
        ("two-sphere\nbar", (-0.09, 0.4, 0.0)),
        ("sphere", (-0.28, 0.19, 0.185)),
        ("part", (-0.04, -0.55, 0.2)),
    ):
        axes.text(*place, text, fontsize=9, ha="center", color="#222222", zorder=20)
    axes.set_proj_type("persp", focal_length=0.9)
    low, high = np.array([-0.3, -0.58, 0.0]), np.array([0.57, 0.42, 0.66])
    axes.set(**{f"{name}lim": (low[i], high[i]) for i, name in enumerate("xyz")})
    axes.set_box_aspect(high - low, zoom=1.45)
    axes.view_init(elev=27, azim=-57)
    axes.set_axis_off()


def curves(cell: Cell) -> tuple[FloatArray, FloatArray, list[Plan]]:
    """U in mm after each of COUNTS measurements: planned (n,), and at random (RANDOM_DRAWS, n)."""
    model, belief = cell.robot.arm_model(), with_plate(first_belief(cell), cell)
    plans = [plan_hand_eye(cell, belief, model, count, SEED) for count in COUNTS]
    planned = np.array([plan.worst.U_m * 1e3 for plan in plans if plan.worst is not None])
    workspace = Workspace(cell, model, belief)
    pool = plate_candidates(workspace, SEED)
    points, names = hand_eye_points(belief, hand_eye(cell).gated_ranges_m)
    random = np.random.default_rng(SEED)
    at_random = np.empty((RANDOM_DRAWS, len(COUNTS)))
    for draw in range(RANDOM_DRAWS):
        order = random.permutation(len(pool))
        for column, count in enumerate(COUNTS):
            taken = [observations_of(workspace, pool.take(order[:count]))]
            after = predicted_belief(belief, model, taken, "hand-eye")
            at_random[draw, column] = max(p.U_m for p in gated_predictions(after, points, names)) * 1e3
    return planned, at_random, plans


def hand_eye(cell: Cell) -> HandEyePhase:
    """The phase that is drawn."""
    return next(phase for phase in cell.job.phases if isinstance(phase, HandEyePhase))


def draw_curve(axes: Any, cell: Cell, planned: FloatArray, at_random: FloatArray) -> None:
    """Uncertainty against the number of measurements, with the limit."""
    spec = hand_eye(cell)
    limit_mm = spec.limit_m * 1e3
    axes.fill_between(
        COUNTS, at_random.min(axis=0), at_random.max(axis=0), color=RANDOM, alpha=0.2, linewidth=0
    )
    axes.plot(COUNTS, np.median(at_random, axis=0), color=RANDOM, linewidth=1.4)
    axes.plot(COUNTS, planned, color=PLANNED, linewidth=2.2, marker="o", markersize=4)
    axes.axhline(limit_mm, color=LIMIT, linewidth=1.4, linestyle=(0, (5, 3)))
    axes.set(xscale="log", yscale="log", xlim=(9.5, 168), ylim=(0.12, 4.0))
    axes.set_xticks(ticks := [10, 20, 40, 80, 160], [str(tick) for tick in ticks])
    axes.set_yticks(levels := [0.2, 0.4, 1.0, 2.0, 4.0], [f"{level:g}" for level in levels])
    axes.minorticks_off()
    axes.grid(color="#e4e4e4", linewidth=0.7)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel("plate measurements")
    axes.set_title("Hand-eye: predicted expanded uncertainty U (mm, 3-D, 95 %)", fontsize=10, loc="left")
    axes.text(
        164, limit_mm * 1.03, f"limit {limit_mm:.2f} mm", color=LIMIT, fontsize=9, ha="right", va="bottom"
    )
    own = COUNTS.index(spec.measurements)
    axes.annotate(
        f"the job: {spec.measurements} planned, U = {planned[own]:.2f} mm",
        (COUNTS[own], planned[own]),
        xytext=(22, 0.145),
        fontsize=9,
        color=PLANNED,
        arrowprops={"arrowstyle": "-", "color": PLANNED, "linewidth": 0.8, "shrinkB": 4},
    )
    middle = 5
    axes.text(
        COUNTS[middle] * 1.02,
        at_random[:, middle].max() * 1.15,
        "poses at random\n(median and range of 12 draws)",
        color="#5f6468",
        fontsize=9,
        va="bottom",
    )


def main() -> None:
    """Compute, draw, write."""
    cell = load_cell(ROOT / "cells" / "bench-block" / "cell.toml")
    planned, at_random, plans = curves(cell)
    print("planned:", dict(zip(COUNTS, planned.round(3).tolist(), strict=True)))
    print("random, median:", dict(zip(COUNTS, np.median(at_random, axis=0).round(3).tolist(), strict=True)))
    figure = plt.figure(figsize=(11.5, 4.9), dpi=130)
    draw_cell(
        figure.add_axes((-0.055, -0.02, 0.65, 1.06), projection="3d", computed_zorder=False),
        cell,
        plans[COUNTS.index(40)],
    )
    draw_curve(figure.add_axes((0.6, 0.14, 0.375, 0.74)), cell, planned, at_random)
    figure.savefig(PICTURE, facecolor="white")


if __name__ == "__main__":
    main()
