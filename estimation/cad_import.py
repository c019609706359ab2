"""The import of a CAD file, as a script of its own: python cad_import.py part.step out.npz [unit in metres]

It runs in a process with a time limit, because the geometry kernel prints on stdout, may not return on absurd
input, and takes seconds to load. `estimation.cad` starts it and reads what it writes.
"""

import io
import json
import sys
from dataclasses import asdict
from pathlib import Path

import cascadio
import numpy as np
import trimesh

CHORD_MM = 0.01  # largest distance of a mesh triangle to its surface; the kernel takes it in mm
CHORD_RAD = 0.2
OPEN_MESH = 3  # exit code
FLAT_RAD = 1e-3  # between neighbours on one plane: the corners of a mesh are often rounded to float32
SMOOTH_RAD = np.radians(25.0)  # between neighbours on one curved face
LEAST_PLANE = 1e-3  # of all area: smaller flat patches belong to something curved


def main(step: Path, out: Path) -> int:
    glb = cascadio.load(step.read_bytes(), tol_linear=CHORD_MM, tol_angular=CHORD_RAD, include_brep=True)
    if not glb:  # the kernel's only sign of a file that it cannot read
        return 1
    scene = trimesh.load_scene(io.BytesIO(glb), file_type="glb")
    triangles, face_index, part_T_solid = [], [], []
    faces: list[dict[str, object] | None] = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        mesh = scene.geometry[name]
        corners = np.asarray(mesh.vertices, dtype=np.float64)[mesh.faces]
        corners = corners @ matrix[:3, :3].T + matrix[:3, 3]
        if np.linalg.det(matrix[:3, :3]) < 0:  # a mirrored solid would otherwise be inside out
            corners = corners[:, ::-1]
        triangles.append(corners)
        face_index.append(len(faces) + np.asarray(mesh.face_attributes["brep_index"], dtype=np.int64))
        for primitive in mesh.metadata["cascadio"]["brep_primitives"]:
            known = primitive is not None
            faces.append({"type": type(primitive).__name__.lower(), **asdict(primitive)} if known else None)
            part_T_solid.append(matrix)
    if not triangles:
        return 1
    np.savez(
        out,
        triangles=np.concatenate(triangles),
        face_index=np.concatenate(face_index),
        part_T_solid=np.stack(part_T_solid),
        faces=np.array(json.dumps(faces)),
    )
    return 0


def main_mesh(path: Path, out: Path, unit_m: float) -> int:
    """STL or PLY: flat regions are planes, the smooth rest is one face for each connected region."""
    try:
        mesh = trimesh.load_mesh(path)
    except ImportError:  # bytes that are no mesh are taken for a text, whose encoding another library guesses
        return 1
    mesh = trimesh.Trimesh(np.asarray(mesh.vertices) * unit_m, mesh.faces)
    mesh.merge_vertices()
    if not len(mesh.faces):
        return 1
    uses = np.unique(mesh.edges_sorted, axis=0, return_counts=True)[1]
    if (uses % 2).any():
        print(int((uses % 2).sum()), file=sys.stderr)
        return OPEN_MESH
    if mesh.volume < 0.0:
        mesh.invert()
    flat = _regions(mesh, FLAT_RAD, np.ones(len(mesh.faces), dtype=bool))
    area = np.bincount(flat, weights=mesh.area_faces)
    plane = area[flat] >= LEAST_PLANE * area.sum()
    curved = _regions(mesh, SMOOTH_RAD, ~plane)
    _, face_index = np.unique(np.where(plane, flat, len(area) + curved), return_inverse=True)
    faces: list[dict[str, object] | None] = []
    for index in range(face_index.max() + 1):
        mine = face_index == index
        normal = (mesh.face_normals[mine] * mesh.area_faces[mine, None]).sum(axis=0)
        origin = mesh.triangles[mine].reshape(-1, 3).mean(axis=0)
        known = bool(plane[mine].all())
        faces.append(
            {"type": "plane", "origin": origin.tolist(), "normal": normal.tolist()} if known else None
        )
    np.savez(
        out,
        triangles=np.asarray(mesh.triangles),
        face_index=face_index.astype(np.int64),
        part_T_solid=np.tile(np.eye(4), (len(faces), 1, 1)),
        faces=np.array(json.dumps(faces)),
    )
    return 0


def _regions(mesh: trimesh.Trimesh, most_rad: float, among: np.ndarray) -> np.ndarray:
    """Number of the region of each triangle: neighbours that turn by less than an angle are in one."""
    near = (mesh.face_adjacency_angles < most_rad) & among[mesh.face_adjacency].all(axis=1)
    labels: np.ndarray = trimesh.graph.connected_component_labels(  # type: ignore[no-untyped-call]
        mesh.face_adjacency[near], node_count=len(mesh.faces)
    )
    return np.asarray(labels)


if __name__ == "__main__":
    source, target = Path(sys.argv[1]), Path(sys.argv[2])
    sys.exit(main_mesh(source, target, float(sys.argv[3])) if len(sys.argv) > 3 else main(source, target))
