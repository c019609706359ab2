"""Poses of a plan checked by others: rays by trimesh, collision by fcl, kinematics by the twin of tests."""

from dataclasses import dataclass

import fcl
import numpy as np
import trimesh

from controller.cellfile import Cell
from estimation.transform import FloatArray, Transform
from tests.estimation.twin import TABLE, elementary

LIMITS_RAD = np.radians([170.0, 145.0, 135.0, 170.0, 170.0, 179.0])


def frames(joints_rad: FloatArray) -> FloatArray:
    """base_T_link (7, 4, 4), from the base to the flange."""
    found = [np.eye(4)]
    for row, angle in zip(TABLE, joints_rad, strict=True):
        theta, d, a, alpha, beta = row
        pose = found[-1] @ elementary(np.array(theta + angle), 5)
        for amount, freedom in ((d, 2), (a, 0), (alpha, 3), (beta, 4)):
            pose = pose @ elementary(np.array(amount), freedom)
        found.append(pose)
    return np.array(found)


def rod(start: FloatArray, end: FloatArray, radius_m: float) -> fcl.CollisionObject:
    """A capsule between two points."""
    along = end - start
    length = float(np.linalg.norm(along))
    pose = trimesh.geometry.align_vectors([0, 0, 1], along / length)
    return fcl.CollisionObject(
        fcl.Capsule(radius_m, length), fcl.Transform(np.ascontiguousarray(pose[:3, :3]), (start + end) / 2)
    )


def box(base_T_box: FloatArray, low: FloatArray, high: FloatArray) -> fcl.CollisionObject:
    middle = base_T_box[:3, :3] @ ((low + high) / 2) + base_T_box[:3, 3]
    return fcl.CollisionObject(fcl.Box(*(high - low)), fcl.Transform(base_T_box[:3, :3].copy(), middle))


def ball(centre: FloatArray, radius_m: float) -> fcl.CollisionObject:
    return fcl.CollisionObject(fcl.Sphere(radius_m), fcl.Transform(centre))


def sensors(cell: Cell, base_T_flange: FloatArray) -> dict[str, fcl.CollisionObject]:
    """What the flange carries."""
    laser = base_T_flange @ cell.laser.mount.transform().matrix
    probe = base_T_flange @ cell.probe.mount.transform().matrix
    tip, stem = probe[:3, 3], probe[:3, 3] - 0.045 * probe[:3, 2]
    return {
        "laser": box(laser, np.array([-0.015, -0.023, -0.04]), np.array([0.015, 0.023, -0.0005])),
        "stylus": rod(tip, stem, cell.probe.ball_radius_m),
    }


def forearm(base_T_links: FloatArray) -> fcl.CollisionObject:
    """Of `frames`."""
    return rod(base_T_links[3, :3, 3], base_T_links[4, :3, 3], 0.04)


def overlaps(one: fcl.CollisionObject, other: fcl.CollisionObject) -> bool:
    return bool(fcl.collide(one, other, fcl.CollisionRequest(), fcl.CollisionResult()))


@dataclass(frozen=True)
class Standing:
    """What stands in the cell, where the cell file says."""

    cell: Cell
    part: trimesh.Trimesh  # metres, frame of the part
    base_T_part: Transform

    def objects(self) -> dict[str, fcl.CollisionObject]:
        cell = self.cell
        mesh = fcl.BVHModel()
        mesh.beginModel(len(self.part.vertices), len(self.part.faces))
        mesh.addSubModel(np.asarray(self.part.vertices), np.asarray(self.part.faces))
        mesh.endModel()
        pose = self.base_T_part
        half = np.array([*(np.array(cell.plate.size_m) / 2), 0.0])
        ends = cell.bar.transform().points(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, cell.bar.length_m]]))
        return {
            "part": fcl.CollisionObject(mesh, fcl.Transform(pose.rotation.copy(), pose.origin_m.copy())),
            "plate": box(cell.plate.transform().matrix, -half - [0, 0, 0.01], half),
            "bar": rod(ends[0], ends[1], cell.bar.sphere_radius_m),
            "sphere": ball(cell.sphere.transform().origin_m, cell.sphere.radius_m),
            "bench": box(np.eye(4), np.array([-2.0, -2.0, -0.1]), np.array([2.0, 2.0, 0.0])),
        }

    def collisions(self, joints_rad: FloatArray) -> list[str]:
        """Pairs that overlap at a posture (6,): the arm with what stands there, and tool with arm."""
        links = frames(joints_rad)
        places = links[:, :3, 3]
        tool = sensors(self.cell, links[-1])
        arm = {"upper arm": rod(places[1], places[2], 0.045), "forearm": forearm(links)}
        wrist = {"wrist": rod(places[5], places[6], 0.035)}
        column = box(np.eye(4), np.array([-0.08, -0.08, 0.0]), np.array([0.08, 0.08, 0.2]))
        found = [
            f"{name} meets {other}"
            for name, body in {**tool, **arm, **wrist}.items()
            for other, obstacle in self.objects().items()
            if overlaps(body, obstacle)
        ]
        found += [
            f"{name} meets {other}"
            for name, body in tool.items()
            for other in arm
            if overlaps(body, arm[other])
        ]
        return found + [f"{name} meets the column" for name, body in tool.items() if overlaps(body, column)]

    def seen(self, joints_rad: FloatArray, normals: FloatArray, object_p_m: FloatArray) -> list[str]:
        """What is wrong with beams at postures (m, 6) for points (m, 3) of faces with normals (m, 3)."""
        laser = self.cell.laser
        low, high = laser.working_range_m
        base_T_laser = np.array([frames(q)[-1] for q in joints_rad]) @ laser.mount.transform().matrix
        part_T_laser = np.linalg.inv(self.base_T_part.matrix) @ base_T_laser
        places, rays, triangles = self.part.ray.intersects_location(
            part_T_laser[:, :3, 3], part_T_laser[:, :3, 2], multiple_hits=False
        )
        wrong = []
        hit = dict(zip(rays.tolist(), zip(places, triangles, strict=True), strict=True))
        for row in range(len(joints_rad)):
            if np.any(np.abs(joints_rad[row]) > LIMITS_RAD):
                wrong.append("a joint beyond its limit")
            if row not in hit:
                wrong.append("the beam meets nothing")
                continue
            place, triangle = hit[row]
            distance = float(np.linalg.norm(place - part_T_laser[row, :3, 3]))
            cosine = float(-part_T_laser[row, :3, 2] @ normals[row])
            if (
                self.part.face_normals[triangle] @ normals[row] < 0.999
                or np.linalg.norm(place - object_p_m[row]) > 1e-3
            ):
                wrong.append("another face is met first")
            if not low <= distance <= high:
                wrong.append(f"range {distance * 1e3:.1f} mm")
            if cosine < np.cos(laser.max_incidence_rad):
                wrong.append(f"incidence {np.degrees(np.arccos(cosine)):.1f} deg")
        return wrong
