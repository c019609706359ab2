"""Points from a file of any kind that people have, in metres."""

import io
from pathlib import Path
from typing import Final

import numpy as np

from controller.offline.refusal import BadFile
from controller.offline.text_points import read_text_points
from controller.offline.units import METRES, refuse_extent, refuse_other_unit
from estimation.transform import FloatArray

_TEXT: Final = (".csv", ".txt", ".xyz")
_STL_HEADER: Final = 84  # bytes of a binary file before its triangles
_STL_TRIANGLE: Final = 50
_MESH: Final = (".ply", ".stl")


def read_points(path: Path, unit: str, size_m: float | None = None) -> FloatArray:
    """Points (n, 3) in metres; of an STL the distinct vertices.

    unit : "mm", "m" or "inch", of the numbers in the file.
    size_m : largest extent that the user expects, to a factor of two.

    Raises BadFile where the file is missing, of another kind, cannot be read without guessing, or in another
    unit than stated, as far as header, extent or `size_m` tell.
    """
    if path.is_dir():
        raise BadFile(f"{path} is a folder", "Name a file of points")
    if not path.is_file():
        raise BadFile(f"{path}: there is no such file", "Name a file of points")
    kind = path.suffix.lower()
    if path.stat().st_size == 0:
        raise BadFile(f"{path.name}: the file is empty", "Export at least the points of one surface")
    if kind in _TEXT:
        points = read_text_points(path, unit)
    elif kind in _MESH:
        points = _mesh_points(path, unit)
    else:
        raise BadFile(
            f"{path.name}: files of kind {kind or 'none'} are not read", f"Use {', '.join(_TEXT + _MESH)}"
        )
    points_m = points * METRES[unit]
    refuse_extent(float(np.ptp(points_m, axis=0).max()), unit, path.name, size_m)
    return points_m


def _mesh_points(path: Path, unit: str) -> FloatArray:
    import trimesh  # takes longer than --help may

    _refuse_declared_unit(path, unit)
    data = path.read_bytes()
    if path.suffix.lower() == ".stl":
        data = _whole_stl(data, path.name)
    try:
        loaded = trimesh.load(io.BytesIO(data), file_type=path.suffix[1:].lower(), process=False)
        points = np.asarray(getattr(loaded, "vertices", np.empty((0, 3))), dtype=np.float64)
    except Exception as error:  # trimesh raises whatever its parsers stumble on
        raise BadFile(
            f"{path.name}: not a readable {path.suffix[1:].upper()} file ({type(error).__name__})",
            "Export it again, or as CSV",
        ) from error
    if len(points) == 0:
        raise BadFile(f"{path.name}: the file has no points", "Export at least the points of one surface")
    if not np.isfinite(points).all():
        place = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise BadFile(f"{path.name}, vertex {place + 1}: not three finite numbers", "Mend or remove it")
    # Triangles repeat their corners; as points of a fit each counts once.
    return np.unique(points, axis=0) if path.suffix.lower() == ".stl" else points


def _whole_stl(data: bytes, name: str) -> bytes:
    """The file with its names in ASCII. Raises BadFile where its end is missing."""
    if data[:5].lower() == b"solid" and b"facet" in data[:1000].lower():
        if b"endsolid" not in data[-300:].lower():
            raise BadFile(f"{name}: cut off, its end (endsolid) is missing", "Export or copy it again")
        return data.decode("latin-1").encode("ascii", errors="replace")
    triangles = int.from_bytes(data[80:84], "little")
    present = max(len(data) - _STL_HEADER, 0) // _STL_TRIANGLE
    if present < triangles:
        raise BadFile(
            f"{name}: cut off, {triangles} triangles announced and {present} present",
            "Export or copy it again",
        )
    return data


def _refuse_declared_unit(path: Path, unit: str) -> None:
    """A PLY may name its unit in a comment of its header."""
    if path.suffix.lower() != ".ply":
        return
    with path.open("rb") as file:
        for number, line in enumerate(file, start=1):
            text = line.decode("ascii", errors="replace").strip()
            if text.startswith(("comment", "obj_info")):
                refuse_other_unit(text, unit, path.name, number)
            if text == "end_header" or number > 200:
                return
