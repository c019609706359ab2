"""The faces of a STEP part: exact planes and cylinders, and the outline of each (own reading of the CAD)."""

import hashlib
import io
import json
from collections import Counter
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from estimation.errors import CellFileError
from estimation.transform import FloatArray

OUTLINE_TOLERANCE_MM: Final = 0.002
OUTLINE_ANGLE_RAD: Final = 0.05
FORMAT: Final = 1  # of the cache file


@dataclass(frozen=True, slots=True, eq=False)
class StepFace:
    """One face, metres, part frame. A plane has radius 0; `axis` is then its outward normal."""

    origin: FloatArray  # (3,) on the plane, or on the cylinder's axis at height 0
    axis: FloatArray  # (3,) unit
    x_dir: FloatArray  # (3,) unit, where the angle is 0
    radius: float
    outward: float  # cylinder: +1 if the material is inside (boss), -1 for a hole
    angles: FloatArray  # (2,) cylinder: from, to, rad
    heights: FloatArray  # (2,) cylinder: from, to along the axis
    outline: FloatArray  # (k, 2, 3) edge segments around the face


@lru_cache(maxsize=4)
def read_faces(path: Path, cache_dir: Path | None = None) -> tuple[StepFace, ...]:
    """All faces of the part. Raises CellFileError for a face that is neither plane nor cylinder.

    The CAD kernel takes seconds to load, so what it found is kept in `cache_dir`, by content.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CellFileError(f"{path} cannot be read", "Name the STEP file of the part") from error
    cached = None
    if cache_dir is not None:
        cached = cache_dir / f"faces-{FORMAT}-{hashlib.sha256(data).hexdigest()[:16]}.json"
        if cached.is_file():
            return tuple(_from_json(item) for item in json.loads(cached.read_text(encoding="utf-8")))
    faces = tuple(_import(data, path.name))
    if cached is not None:
        cached.parent.mkdir(parents=True, exist_ok=True)
        partial = cached.with_suffix(".partial")
        partial.write_text(json.dumps([_to_json(face) for face in faces]), encoding="utf-8")
        partial.replace(cached)
    return faces


def _to_json(face: StepFace) -> dict[str, Any]:
    return {
        name: value.tolist() if isinstance(value := getattr(face, name), np.ndarray) else value
        for name in StepFace.__dataclass_fields__
    }


def _from_json(item: dict[str, Any]) -> StepFace:
    values: dict[str, Any] = {k: np.array(v) if isinstance(v, list) else v for k, v in item.items()}
    return StepFace(**values)


def _import(data: bytes, name: str) -> list[StepFace]:
    import cascadio
    import trimesh

    glb = cascadio.load(
        data, tol_linear=OUTLINE_TOLERANCE_MM, tol_angular=OUTLINE_ANGLE_RAD, include_brep=True
    )
    if not glb:
        raise CellFileError(f"{name} is not a STEP file that can be read", "Export it again")
    scene: Any = trimesh.load(io.BytesIO(glb), file_type="glb")
    faces = []
    for mesh in scene.geometry.values():
        triangle_face = np.asarray(mesh.face_attributes["brep_index"])
        primitives = mesh.metadata["cascadio"]["brep_primitives"]
        triangles = np.asarray(mesh.vertices, dtype=np.float64)[np.asarray(mesh.faces)]
        for number, primitive in enumerate(primitives):
            kind = type(primitive).__name__
            if kind not in ("Plane", "Cylinder"):
                raise CellFileError(
                    f"{name}: face {number} is a {kind}", "The simulator knows planes and cylinders"
                )
            faces.append(_face(primitive, kind, triangles[triangle_face == number]))
    return faces


def _face(primitive: Any, kind: str, triangles: FloatArray) -> StepFace:
    origin = np.array(primitive.origin, dtype=np.float64)
    outline = _outline(triangles)
    # The surface's own normal may point either way: the triangles know outside from inside.
    first = triangles[0]
    outside = np.cross(first[1] - first[0], first[2] - first[0])
    if kind == "Plane":
        normal = np.array(primitive.normal, dtype=np.float64)
        normal *= np.sign(normal @ outside)
        x_dir = np.array(primitive.x_dir, dtype=np.float64)
        return StepFace(origin, normal, x_dir, 0.0, 1.0, np.zeros(2), np.zeros(2), outline)
    axis = np.array(primitive.axis, dtype=np.float64)
    middle = first.mean(axis=0) - origin
    radial = middle - (middle @ axis) * axis
    vertices = triangles.reshape(-1, 3) - origin
    # The angles of the CAD count from a direction that the primitive does not tell: measure them instead.
    across = vertices - np.outer(vertices @ axis, axis)
    x_dir = across[0] / np.linalg.norm(across[0])
    y_dir = np.cross(axis, x_dir)
    lower, upper = primitive.extent_angle
    span = float(upper - lower)
    angle = np.arctan2(across @ y_dir, across @ x_dir)
    if span < 2 * np.pi - 1e-6:
        centre = np.arctan2(np.sin(angle).mean(), np.cos(angle).mean())
        angles = np.array([centre - span / 2, centre + span / 2])
    else:
        angles = np.array([-np.pi, np.pi])
    return StepFace(
        origin=origin,
        axis=axis,
        x_dir=x_dir,
        radius=float(primitive.radius),
        outward=float(np.sign(radial @ outside)),
        angles=angles,
        heights=np.array(primitive.extent_height, dtype=np.float64),
        outline=outline,
    )


def _outline(triangles: FloatArray) -> FloatArray:
    """Edges (k, 2, 3) that belong to one triangle of the face only."""
    corners = np.round(triangles * 1e7).astype(np.int64)  # the mesh is float32: 0.1 um joins what belongs
    count: Counter[tuple[tuple[int, ...], ...]] = Counter()
    for triangle in corners.tolist():
        points = [tuple(point) for point in triangle]
        for i in range(3):
            count[tuple(sorted((points[i], points[(i + 1) % 3])))] += 1
    edges = [edge for edge, times in count.items() if times == 1]
    return np.array(edges, dtype=np.float64) * 1e-7
