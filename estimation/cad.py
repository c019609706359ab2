"""Faces of a CAD part (STEP, STL, PLY) as typed surfaces and triangles: metres, frame of the part.

The one module of this package that reads files. A file is parsed in a process of its own
(`cad_import.py`); with `cache_dir` the result is kept under the digest of the file, so that a restart does
not load the geometry kernel.
"""

import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from estimation.errors import CellFileError, EstimationError
from estimation.transform import FloatArray

FaceKind = Literal["plane", "cylinder", "cone", "sphere", "torus", "other"]
IntArray = NDArray[np.int64]

LARGEST_PART_M: Final = 5.0
IMPORT_TIMEOUT_S: Final = 30.0
MESH_SUFFIXES: Final = (".stl", ".ply")
OPEN_MESH: Final = 3  # exit code of the importer
IMPORTER: Final = Path(__file__).with_name("cad_import.py")

_REAL = rb"[-+0-9.Ee]+"
_POINT = re.compile(
    rb"#(\d+)\s*=\s*CARTESIAN_POINT\s*\(\s*'[^']*'\s*,\s*\(\s*(%b)\s*,\s*(%b)\s*,\s*(%b)\s*\)"
    % ((_REAL,) * 3)
)
_VERTEX = re.compile(rb"=\s*VERTEX_POINT\s*\(\s*'[^']*'\s*,\s*#(\d+)")
_LENGTH_UNIT = re.compile(rb"#(\d+)\s*=\s*(\([^;]*\bLENGTH_UNIT\s*\(\s*\)[^;]*);")
_SI_METRE = re.compile(rb"SI_UNIT\s*\(\s*(?:\$|\.(\w+)\.)\s*,\s*\.METRE\.")
_CONVERSION = re.compile(rb"CONVERSION_BASED_UNIT\s*\(\s*'[^']*'\s*,\s*#(\d+)")
_MEASURE = rb"#%b\s*=\s*[^;]*?LENGTH_MEASURE\s*\(\s*([-+0-9.Ee]+)\s*\)\s*,\s*#(\d+)"
_SI_PREFIX_M: Final = {b"": 1.0, b"KILO": 1e3, b"DECI": 0.1, b"CENTI": 1e-2, b"MILLI": 1e-3, b"MICRO": 1e-6}


@dataclass(frozen=True, slots=True, eq=False)
class CadFace:
    """One face of the part; the arrays are read-only.

    `point_m` and `axis` by kind: plane, a point on it and the outward normal; cylinder, a point on the axis
    and its direction; cone, the apex and the direction into the cone; sphere and torus, the centre (the axis
    of a sphere is arbitrary); other, the centroid and mean outward normal. For an open shell, outward is the
    side that its triangles face.
    """

    index: int
    kind: FaceKind
    point_m: FloatArray  # (3,)
    axis: FloatArray  # (3,) unit
    radius_m: float  # cylinder, sphere, tube of a torus; else 0
    outward: bool  # the material lies inside (boss, round); False: around it (bore). True for a plane
    bounds_m: FloatArray  # (2, 3) least and greatest coordinates
    triangles: FloatArray  # (k, 3, 3) corners, counter-clockwise seen from outside
    major_radius_m: float = 0.0  # torus only
    half_angle_rad: float = 0.0  # cone only

    def distance_m(self, point_m: FloatArray) -> float:
        """Distance of a point to the face within its edges, to the chord error of the triangles (0.01 mm)."""
        return float(np.sqrt(_squared_distances(self.triangles, np.asarray(point_m, dtype=np.float64)).min()))

    def __str__(self) -> str:
        middle = ", ".join(f"{value * 1e3:.1f}" for value in self.bounds_m.mean(axis=0))
        radius = f" of radius {self.radius_m * 1e3:.3f} mm" if self.radius_m else ""
        return f"{self.kind}{radius} around ({middle}) mm"


@dataclass(frozen=True, slots=True, eq=False)
class CadMesh:
    """The part as one mesh, for ray casting. Closed when the part is one solid."""

    vertices_m: FloatArray  # (n, 3)
    triangles: IntArray  # (m, 3) vertices, counter-clockwise seen from outside
    face_index: IntArray  # (m,) the CadFace.index of each triangle


def read_faces(path: Path, cache_dir: Path | None = None, unit_m: float | None = None) -> tuple[CadFace, ...]:
    """All faces of the part; the same file always gives the same order and `index`.

    A STEP file says its unit itself; a mesh (STL, PLY) is in `unit_m` and must be closed. Flat regions of a
    mesh are planes; the rest is free form, one face for each smooth region.

    Raises CellFileError for a file that is missing, broken, open, of unknown unit, without faces, or larger
    than 5 m.
    """
    mesh_unit = None
    if path.suffix.lower() in MESH_SUFFIXES:
        if unit_m is None:
            raise CellFileError(f"The mesh {path} names no unit of length", "Say in which unit it is")
        mesh_unit = repr(unit_m)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise CellFileError(
            f"The CAD file {path} cannot be read: {error.strerror}", "Check its path"
        ) from None
    if mesh_unit is None:
        _refuse_unreadable(path, content)
    # Part of the key: another importer gives other triangles, another unit another size.
    key = hashlib.sha256(IMPORTER.read_bytes() + (mesh_unit or "").encode()).digest()
    digest = hashlib.sha256(key + content).hexdigest()
    cached = cache_dir / f"{digest}.npz" if cache_dir else None
    if cached is not None:
        try:
            return _load_faces(path, cached)
        except (OSError, ValueError, KeyError, zipfile.BadZipFile):
            pass  # not there yet, or damaged: the file itself is what counts
    with tempfile.TemporaryDirectory(prefix="truecell-cad-") as folder:
        parsed = Path(folder, "part.npz")
        _import(path, content, parsed, mesh_unit)
        faces = _load_faces(path, parsed)
        if cached is not None:
            _keep(parsed, cached)
    return faces


def read_mesh(path: Path, cache_dir: Path | None = None) -> CadMesh:
    """The mesh of a STEP part; raises like `read_faces`."""
    return mesh_of(read_faces(path, cache_dir))


def mesh_of(faces: tuple[CadFace, ...]) -> CadMesh:
    """The faces as one mesh; neighbours have exactly equal corners on their common edge, which are merged."""
    corners = np.concatenate([face.triangles for face in faces])
    vertices, inverse = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    face_index = np.repeat([face.index for face in faces], [len(face.triangles) for face in faces])
    return CadMesh(vertices, inverse.reshape(-1, 3).astype(np.int64), face_index.astype(np.int64))


def face_at(faces: tuple[CadFace, ...], point_m: FloatArray, tolerance_m: float = 1e-3) -> CadFace:
    """The face on which a point lies, to the tolerance.

    Raises EstimationError when no face is that near, or when a second one is nearly as near (an edge).
    """
    point_m = np.asarray(point_m, dtype=np.float64)
    ranked = sorted((face.distance_m(point_m), face.index, face) for face in faces)
    distance_m, _, nearest = ranked[0]
    at = "(" + ", ".join(f"{value * 1e3:g}" for value in np.round(point_m, 7)) + ") mm"
    if not distance_m <= tolerance_m:
        raise EstimationError(
            f"No face of the part lies within {tolerance_m * 1e3:g} mm of {at}; the nearest is"
            f" {distance_m * 1e3:.3f} mm away, a {nearest}",
            "Give a point on the face, in the frame of the CAD file",
        )
    if len(ranked) > 1 and ranked[1][0] - distance_m < tolerance_m / 4:
        raise EstimationError(
            f"The point {at} lies on an edge: {distance_m * 1e3:.3f} mm from a {nearest}, and"
            f" {ranked[1][0] * 1e3:.3f} mm from a {ranked[1][2]}",
            f"Give a point more than {tolerance_m / 4 * 1e3:g} mm inside the face that is meant",
        )
    return nearest


def _refuse_unreadable(path: Path, content: bytes) -> None:
    """Refuses from the text alone what the kernel would fail on silently, or not finish."""
    again = "Export the part again as STEP (AP203, AP214 or AP242)"
    if not content.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"ISO-10303-21"):
        raise CellFileError(f"The CAD file {path} {'is not a STEP file' if content else 'is empty'}", again)
    if b"END-ISO-10303-21" not in content:
        raise CellFileError(
            f"The CAD file {path} is cut off: its end mark END-ISO-10303-21 is missing", again
        )
    points = {match[1]: match.groups()[1:] for match in _POINT.finditer(content)}
    # Points that span the part; axes and splines may have theirs far outside it.
    used = {match[1] for match in _VERTEX.finditer(content)} & points.keys()
    chosen = [points[key] for key in used] if len(used) > 1 else list(points.values())
    if not chosen:
        raise CellFileError(f"The CAD file {path} has no points", again)
    try:
        coordinates = np.array(chosen, dtype="S").astype(np.float64)
    except ValueError:
        raise CellFileError(f"The CAD file {path} has points that are no numbers", again) from None
    _refuse_large(path, float(np.ptp(coordinates, axis=0).max()) * _unit_m(content))


def _refuse_large(path: Path, size_m: float) -> None:
    if not size_m <= LARGEST_PART_M:
        raise CellFileError(
            f"The part in {path} measures {size_m:.4g} m, more than the {LARGEST_PART_M:g} m that a part may"
            " have; this is mostly a mistake of the unit (millimetres exported as metres or inches)",
            "Export it again with the unit in which it was drawn",
        )


def declared_unit_m(content: bytes) -> float | None:
    """The length unit that the text of a STEP file names, in metres; the largest, if there are several."""
    units: dict[bytes, float] = {}
    converted: dict[bytes, bytes] = {}
    for match in _LENGTH_UNIT.finditer(content):
        if (si := _SI_METRE.search(match[2])) is not None:
            units[match[1]] = _SI_PREFIX_M.get(si[1] or b"", 1e-3)
        elif (by := _CONVERSION.search(match[2])) is not None:
            converted[match[1]] = by[1]
    bases = set()
    for key, measure in converted.items():
        if (factor := re.search(_MEASURE % measure, content)) is not None:
            units[key] = float(factor[1]) * units.get(factor[2], 1e-3)
            bases.add(factor[2])
    # A unit that only defines another one is not the unit of the coordinates.
    return max((value for key, value in units.items() if key not in bases), default=None)


def _unit_m(content: bytes) -> float:
    """The length unit of the file, millimetres if none is named."""
    unit_m = declared_unit_m(content)
    return 1e-3 if unit_m is None else unit_m


def _import(path: Path, content: bytes, out: Path, mesh_unit: str | None) -> None:
    source = out.with_suffix(path.suffix.lower() if mesh_unit else ".step")
    source.write_bytes(content)  # what was hashed is what is parsed, even if the file changes meanwhile
    command = [sys.executable, "-P", str(IMPORTER), str(source), str(out)]
    command += [mesh_unit] if mesh_unit else []
    try:
        done = subprocess.run(command, capture_output=True, timeout=IMPORT_TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        raise CellFileError(
            f"The CAD file {path} was not read within {IMPORT_TIMEOUT_S:g} s",
            "Export only the measured part, without fasteners and engravings",
        ) from None
    if b"ModuleNotFoundError" in done.stderr:
        raise CellFileError(
            f"The CAD file {path} cannot be read: {done.stderr.decode(errors='replace').splitlines()[-1]}",
            "Install truecell again with all its dependencies",
        )
    if done.returncode == OPEN_MESH:
        raise CellFileError(
            f"The mesh {path} is open: {int(done.stderr.split()[-1])} edges do not belong to two triangles",
            "Close it in a mesh editor, or export the solid as STEP",
        )
    if done.returncode != 0 or not out.exists():
        raise CellFileError(
            f"The CAD file {path} is damaged or holds no faces",
            "Open it in a CAD viewer, and export the solid again as STEP (AP203, AP214 or AP242)",
        )


def _keep(parsed: Path, cached: Path) -> None:
    """Copies to the cache, at once for a reader. A cache that cannot be written costs only time."""
    fresh = cached.with_suffix(f".{os.getpid()}.tmp")
    try:
        cached.parent.mkdir(parents=True, exist_ok=True)
        fresh.write_bytes(parsed.read_bytes())
        fresh.replace(cached)
    except OSError:
        fresh.unlink(missing_ok=True)


def _load_faces(path: Path, parsed: Path) -> tuple[CadFace, ...]:
    with np.load(parsed, allow_pickle=False) as arrays:
        triangles: FloatArray = arrays["triangles"]
        face_index: IntArray = arrays["face_index"]
        part_T_solid: FloatArray = arrays["part_T_solid"]
        primitives: list[dict[str, Any] | None] = json.loads(str(arrays["faces"]))
    corners = triangles.reshape(-1, 3)
    _refuse_large(path, float(np.ptp(corners, axis=0).max()))
    faces = []
    for index, primitive in enumerate(primitives):
        mine = triangles[face_index == index]
        if len(mine):  # the kernel gives no triangles for a face of no area
            faces.append(_face(index, primitive, part_T_solid[index], mine))
    return tuple(faces)


def _face(
    index: int, primitive: dict[str, Any] | None, part_T_solid: FloatArray, triangles: FloatArray
) -> CadFace:
    area_vectors = 0.5 * np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    areas = np.linalg.norm(area_vectors, axis=1)
    middles = triangles.mean(axis=1)
    kind: FaceKind = "other"
    point_m, axis = np.average(middles, axis=0, weights=areas + 1e-30), area_vectors.sum(axis=0)
    outward, radius_m, major_radius_m, half_angle_rad = True, 0.0, 0.0, 0.0
    if primitive is not None and primitive["type"] in get_args(FaceKind):
        kind = cast(FaceKind, primitive["type"])
        origin = primitive.get("origin") or primitive.get("center") or primitive["apex"]
        point_m = part_T_solid[:3, :3] @ np.array(origin) + part_T_solid[:3, 3]
        direction = primitive.get("normal") or primitive.get("axis") or (0.0, 0.0, 1.0)
        axis = part_T_solid[:3, :3] @ np.array(direction)
        radius_m = float(primitive.get("radius") or primitive.get("minor_radius") or 0.0)
        major_radius_m = float(primitive.get("major_radius") or 0.0)
        half_angle_rad = abs(float(primitive.get("semi_angle") or 0.0))
        # The surface's own normal says nothing of the material; the winding of its triangles does.
        if kind == "plane":
            axis = axis if area_vectors.sum(axis=0) @ axis > 0.0 else -axis
        else:
            from_axis = _away(kind, middles - point_m, axis, major_radius_m)
            outward = bool((area_vectors * from_axis).sum() > 0.0)
        if kind == "cone" and areas @ (middles - point_m) @ axis < 0.0:
            axis = -axis
    length = float(np.linalg.norm(axis))
    axis = axis / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    bounds_m = np.stack([triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))])
    for array in (point_m, axis, bounds_m, triangles):
        array.flags.writeable = False
    return CadFace(
        index, kind, point_m, axis, radius_m, outward, bounds_m, triangles, major_radius_m, half_angle_rad
    )


def _away(kind: FaceKind, offsets: FloatArray, axis: FloatArray, major_radius_m: float) -> FloatArray:
    """Unit vectors (n, 3) at points offset from `point_m`, away from the axis, centre or centre circle."""
    radial: FloatArray = offsets if kind == "sphere" else offsets - np.outer(offsets @ axis, axis)
    if kind != "torus":
        return _units(radial)
    tube: FloatArray = offsets - major_radius_m * _units(radial)
    return _units(tube)


def _units(vectors: FloatArray) -> FloatArray:
    lengths: FloatArray = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.maximum(lengths, 1e-30)


def _squared_distances(triangles: FloatArray, point_m: FloatArray) -> FloatArray:
    """Squared distances (n,) of a point to triangles (n, 3, 3)."""
    sides = np.roll(triangles, -1, axis=1) - triangles  # (n, 3, 3): the side that starts at each corner
    offsets = point_m - triangles
    lengths = np.maximum(np.einsum("nij,nij->ni", sides, sides), 1e-30)
    along = np.clip(np.einsum("nij,nij->ni", offsets, sides) / lengths, 0.0, 1.0)
    to_sides = offsets - along[..., None] * sides
    squared: FloatArray = np.einsum("nij,nij->ni", to_sides, to_sides).min(axis=1)
    normals = np.cross(sides[:, 0], sides[:, 1])
    inside = (np.einsum("nij,nj->ni", np.cross(sides, offsets), normals) >= 0.0).all(axis=1)
    normal_squared = np.einsum("nj,nj->n", normals, normals)
    inside &= normal_squared > 1e-12 * lengths.max(axis=1) ** 2  # poles and apexes have triangles of no area
    normal_squared = np.maximum(normal_squared, 1e-30)
    heights = np.einsum("nj,nj->n", offsets[:, 0], normals)
    nearest: FloatArray = np.where(inside, np.minimum(squared, heights**2 / normal_squared), squared)
    return nearest
