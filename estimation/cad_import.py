"""The import of a STEP file, as a script of its own: python cad_import.py part.step out.npz

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


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))
