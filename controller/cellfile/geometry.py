"""Whether the CAD file bears out what the cell file says of the part: faces, kinds, diameters, datums."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from controller.cellfile.cell import Cell
from controller.cellfile.lines import KeyPath
from controller.cellfile.mistakes import Mistake
from controller.cellfile.objects import Diameter, Position
from controller.quantities import format_length
from estimation.errors import CellError, CellFileError

if TYPE_CHECKING:  # numpy and the CAD reader only when a part is looked at
    from estimation.cad import CadFace

Finding = tuple[KeyPath, str, str]

SAME_SIZE_M: Final = 1e-6  # STEP files carry rounded numbers
LEAST_SPREAD: Final = 0.1  # smallest singular value of the normals: below it a direction is nearly open


def check_geometry(cell: Cell) -> list[Mistake]:
    """Compare a cell file that is in order by itself with its CAD file; reads the CAD file."""
    from estimation.cad import read_faces

    try:
        all_faces = read_faces(cell.cad_path, cell.cache_dir, cell.part.cad_unit_m)
    except CellFileError as error:
        return [cell.mistake_at(("part", "cad"), _in_a_row(error.problem), _in_a_row(error.remedy))]
    faces, findings = _named_faces(cell, all_faces)
    if not findings:  # else what follows would mostly repeat them
        for check in (_characteristics, _datums, _localized_faces):
            findings += check(cell, faces)
    return [cell.mistake_at(*finding) for finding in findings]


def _in_a_row(text: str) -> str:
    return text[:1].lower() + text[1:]


def _named_faces(cell: Cell, faces: tuple["CadFace", ...]) -> tuple[dict[str, "CadFace"], list[Finding]]:
    import numpy as np

    from estimation.cad import face_at

    named: dict[str, CadFace] = {}
    findings: list[Finding] = []
    for index, feature in enumerate(cell.part.features):
        path = ("part", "features", index, "at")
        try:
            face = face_at(faces, np.array(feature.at_m))
        except CellError as error:
            findings.append((path, _in_a_row(error.problem), _in_a_row(error.remedy)))
            continue
        others = [name for name, other in named.items() if other.index == face.index]
        if others:
            findings.append((path, f"lies on the same face as {others[0]}", "name each face once"))
        elif face.kind not in ("plane", "cylinder"):
            findings.append((path, f"lies on a {face}", "only planes and cylinders can be measured"))
        named[feature.name] = face
    return named, findings


def _characteristics(cell: Cell, faces: dict[str, "CadFace"]) -> Iterator[Finding]:
    for index, item in enumerate(cell.part.characteristics):
        face, path = faces[item.feature], ("part", "characteristics", index)
        wanted = "plane" if item.kind == "flatness" else "cylinder"
        if face.kind != wanted:
            yield (*path, "feature"), f"{item.feature} is a {face.kind}", f"a {item.kind} needs a {wanted}"
        elif isinstance(item, Diameter) and abs(2 * face.radius_m - item.nominal_m) > SAME_SIZE_M:
            yield (
                (*path, "nominal"),
                f"{item.feature} has a diameter of {format_length(2 * face.radius_m)} in the CAD file",
                "correct one of them",
            )


def _datums(cell: Cell, faces: dict[str, "CadFace"]) -> Iterator[Finding]:
    for index, item in enumerate(cell.part.characteristics):
        datums = item.datums if isinstance(item, Position) else ()
        path: KeyPath = ("part", "characteristics", index, "datums")
        for position, datum in enumerate(datums):
            if faces[datum].kind != "plane":
                yield (*path, position), f"{datum} is a {faces[datum].kind}", "a datum must be a plane"
        if datums and _leaves_a_direction_open([faces[datum] for datum in datums]):
            yield path, "the datums leave a direction open", "name planes that look in three directions"


def _localized_faces(cell: Cell, faces: dict[str, "CadFace"]) -> Iterator[Finding]:
    for index, phase in enumerate(cell.job.phases):
        names = phase.faces if phase.kind == "localize" else ()
        path: KeyPath = ("job", "phases", index, "faces")
        for position, name in enumerate(names):
            if faces[name].kind != "plane":
                yield (*path, position), f"{name} is a {faces[name].kind}", "localize on planes"
        if names and _leaves_a_direction_open([faces[name] for name in names]):
            yield path, "the faces leave a direction open", "add a face that looks in another direction"


def _leaves_a_direction_open(faces: list["CadFace"]) -> bool:
    """Whether planes fix fewer than three translations (and with them, rotations)."""
    import numpy as np

    if any(face.kind != "plane" for face in faces):
        return False  # reported already
    normals = np.stack([face.axis for face in faces])
    return bool(np.linalg.svd(normals, compute_uv=False)[-1] < LEAST_SPREAD)
