"""Checks of the part: its CAD file, features, characteristics and tolerances."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import NormalDist
from typing import Final

from controller.cellfile.job import Job
from controller.cellfile.lines import KeyPath
from controller.cellfile.mistakes import nearest
from controller.cellfile.objects import UNITS_M, Diameter, Part, Position, Sphere
from controller.cellfile.probes import Probe
from controller.quantities import format_angle, format_length

Finding = tuple[KeyPath, str, str]


def cad_file(part: Part, directory: Path) -> Iterator[Finding]:
    """The CAD file is there, and its unit is the declared one; a mesh has none."""
    from estimation.cad import MESH_SUFFIXES, declared_unit_m

    path = directory / part.cad
    try:
        content = path.read_bytes()
    except OSError as error:
        others = sorted(other.name for other in directory.glob("*.st*p"))
        remedy = nearest(part.cad, others) if others else f"put it into {directory}"
        yield ("part", "cad"), f"cannot be read ({error.strerror})", remedy
        return
    if path.suffix.lower() in MESH_SUFFIXES:
        return
    if not content.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"ISO-10303-21"):
        yield (
            ("part", "cad"),
            "not a STEP file",
            "export the part as STEP (AP203, AP214 or AP242), STL or PLY",
        )
        return
    unit_m = declared_unit_m(content)
    if unit_m is None:
        yield ("part", "cad"), "the file names no unit of length", "export the part again"
    elif abs(unit_m / UNITS_M[part.cad_unit] - 1) > 1e-6:
        named = next((name for name, value in UNITS_M.items() if abs(unit_m / value - 1) < 1e-6), None)
        remedy = f'write "{named}"' if named else "export it again in mm"
        yield (
            ("part", "cad_unit"),
            f"{part.cad} is in {named or format_length(unit_m)}",
            f"{remedy}, if the part then has its real size",
        )


def names(part: Part) -> Iterator[Finding]:
    """Features and characteristics have names of their own."""
    for key, values in (
        ("features", [feature.name for feature in part.features]),
        ("characteristics", [characteristic.id for characteristic in part.characteristics]),
    ):
        yield from repeated(("part", key), "name" if key == "features" else "id", values)


def repeated(path: KeyPath, key: str, values: Sequence[str]) -> Iterator[Finding]:
    """Values of a key that an earlier table of the array has already."""
    for position, value in enumerate(values):
        if value in values[:position]:
            yield (*path, position, key), "already used", "give each its own"


def features_exist(part: Part) -> Iterator[Finding]:
    """Characteristics and their datums name features of the part."""
    known = [feature.name for feature in part.features]
    for index, characteristic in enumerate(part.characteristics):
        path = ("part", "characteristics", index)
        if characteristic.feature not in known:
            yield (*path, "feature"), "no such feature", nearest(characteristic.feature, known)
        datums = characteristic.datums if isinstance(characteristic, Position) else ()
        for position, datum in enumerate(datums):
            place = (*path, "datums", position)
            if datum not in known:
                yield place, "no such feature", nearest(datum, known)
            elif datum in datums[:position]:
                yield place, "stands twice among the datums", "name three different features"
            elif datum == characteristic.feature:
                yield place, "the feature cannot be its own datum", "name another feature"


def one_kind(part: Part, job: Job) -> Iterator[Finding]:
    """A feature with a diameter is no face: it cannot be flat, a datum plane or localized on."""
    round_features = {item.feature: item.id for item in part.characteristics if isinstance(item, Diameter)}
    for index, item in enumerate(part.characteristics):
        if item.kind == "flatness" and item.feature in round_features:
            yield (
                ("part", "characteristics", index, "feature"),
                f"not a plane: {round_features[item.feature]} is its diameter",
                "name a plane",
            )
    for index, phase in enumerate(job.phases):
        for position, face in enumerate(phase.faces if phase.kind == "localize" else ()):
            if face in round_features:
                yield (
                    ("job", "phases", index, "faces", position),
                    f"not a plane: {round_features[face]} is its diameter",
                    "name a plane",
                )


def tolerances(part: Part) -> Iterator[Finding]:
    """Lower and upper deviations in order, and a diameter that stays positive."""
    for index, item in enumerate(part.characteristics):
        if not isinstance(item, Diameter):
            continue
        lower_m, upper_m = item.tolerance_m
        path = ("part", "characteristics", index, "tolerance")
        if lower_m >= upper_m:
            yield path, "the lower deviation is not below the upper", "swap them, or correct one"
        elif item.nominal_m + lower_m <= 0:
            yield path, f"wider than the diameter of {format_length(item.nominal_m)}", "correct one of them"
        elif lower_m > 0 and upper_m > item.nominal_m / 2:
            yield (
                path,
                "looks like limits of the diameter",
                f"write deviations from {format_length(item.nominal_m)}",
            )


def reachable_tolerances(part: Part, probe: Probe, sphere: Sphere, job: Job) -> Iterator[Finding]:
    """A diameter of which no value could be accepted, because the ball radius alone uses up its tolerance."""
    # Qualifying on the sphere improves the radius, touching more often does not: the error is shared.
    certainty = [u_m**-2 for u_m in (probe.ball_radius_u_m, sphere.radius_u_m) if u_m > 0]
    if len(certainty) < 2:
        return
    u_m = 2 * sum(certainty) ** -0.5  # of a diameter: the same error on both sides
    needed_m = 2 * u_m * NormalDist().inv_cdf((1 + job.conformance_probability) / 2)  # JCGM 106, best value
    for index, item in enumerate(part.characteristics):
        if not isinstance(item, Diameter):
            continue
        width_m = item.tolerance_m[1] - item.tolerance_m[0]
        if 0 < width_m < needed_m:
            yield (
                ("part", "characteristics", index, "tolerance"),
                f"{format_length(width_m)} wide; the ball radius alone needs {format_length(needed_m, 4)}",
                "reduce ball_radius_u or the sphere's radius_u, or agree on a wider tolerance",
            )


def placement_limits(part: Part) -> Iterator[Finding]:
    """The part may lie as far off as its uncertainty says."""
    if part.position_limit_m < part.position_u_m:
        yield (
            ("part", "position_limit"),
            f"smaller than its own uncertainty ({format_length(part.position_u_m)})",
            "write about three times that",
        )
    if part.rotation_limit_rad < part.rotation_u_rad:
        yield (
            ("part", "rotation_limit"),
            f"smaller than its own uncertainty ({format_angle(part.rotation_u_rad)})",
            "write about three times that",
        )
    for index, feature in enumerate(part.features):
        if feature.form_u_m > part.position_limit_m:
            yield ("part", "features", index, "form_u"), "larger than position_limit", "correct one of them"


CHECKS: Final[tuple[Callable[..., Iterator[Finding]], ...]] = (
    cad_file,
    names,
    features_exist,
    one_kind,
    tolerances,
    reachable_tolerances,
    placement_limits,
)
