"""What is wrong with data at sight: shapes, numbers, units, rotations, geometry that leaves freedoms open."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimation.tasks.findings import Cause, Finding
from estimation.transform import FloatArray

METRES: Final = "Give metres, or state the unit of the file as it is"  # numbers of another unit
LARGEST_LENGTH_M: Final = 20.0  # no arm reaches as far; lengths beyond are in other units
LARGEST_ANGLE_RAD: Final = 4.0 * np.pi  # two turns of a joint
SMALLEST_ANGLE_RAD: Final = np.radians(2.0 * np.pi)  # what a turn in radians is as degrees
LARGEST_SKEW: Final = 1e-4  # of R^T R from the identity: matrices written with four decimals pass
CONSTANT_RAD: Final = np.radians(0.1)
SMALLEST_ROTATION_RAD: Final = np.radians(2.0)
SMALLEST_OFF_AXIS_RAD: Final = np.radians(1.0)
HALF_TURN_RAD: Final = np.radians(170.0)
_NOTICED_RAD: Final = np.radians(10.0)
_FLAT: Final = 0.01  # width over length of what counts as a line, height over width of what counts as a plane
_MOST_PAIRED: Final = 200  # poses that are compared each with each

Shape = tuple[int | None, ...]


def first_of(*stages: Callable[[], list[Finding]]) -> list[Finding]:
    """Findings up to the first stage that refuses: what comes after could not even be computed."""
    found: list[Finding] = []
    for stage in stages:
        found += stage()
        if any(finding.refuses for finding in found):
            break
    return found


def rows_of(given: Any) -> int | None:
    """Length of what was given as an array, None when it has none."""
    try:
        return len(given)
    except TypeError:
        return None


def numbers(arrays: Mapping[str, tuple[Any, Shape]]) -> list[Finding]:
    """Arrays of numbers of the right shape, all finite; None in a shape is any length but zero."""
    found = []
    for name, (given, shape) in arrays.items():
        try:
            array = np.asarray(given)
        except ValueError:  # ragged
            array = np.empty(0, dtype=object)
        wanted = "(" + ", ".join("n" if size is None else str(size) for size in shape) + ")"
        fits = array.ndim == len(shape) and all(
            have > 0 if want is None else have == want for have, want in zip(array.shape, shape, strict=True)
        )
        if not fits or array.dtype.kind not in "fiu":
            kind = "of numbers" if array.dtype.kind in "fiu" else f"of {array.dtype}"
            found.append(
                Finding(
                    Cause.WRONG_SHAPE,
                    f"{name} has shape {array.shape} {kind}, it must be {wanted}",
                    "Check rows and columns, and that each pose has its reading",
                )
            )
        elif not np.isfinite(array).all():
            bad = np.argwhere(~np.isfinite(array))
            found.append(
                Finding(
                    Cause.NOT_FINITE,
                    f"{name} holds {len(bad)} values that are no finite numbers, first in row {bad[0][0]}",
                    "Take out these measurements, or measure them again",
                )
            )
    return found


def indices(named: Mapping[str, tuple[Any, int]]) -> list[Finding]:
    """Indices (m,) from 0 below their count."""
    found = []
    for name, (given, count) in named.items():
        index = np.asarray(given)
        if index.dtype.kind not in "iu" or index.min() < 0 or index.max() >= count:
            found.append(
                Finding(
                    Cause.WRONG_SHAPE,
                    f"{name} runs from {index.min()} to {index.max()}, there are {count}",
                    "Count from 0, in whole numbers",
                )
            )
    return found


def deviations(named: Mapping[str, Any]) -> list[Finding]:
    """Standard deviations: finite, none negative."""
    return [
        Finding(
            Cause.NOISE,
            f"{name} is {np.min(given):.3g} at least",
            "Give standard deviations that are finite and not negative",
        )
        for name, given in named.items()
        if not (np.isfinite(given).all() and np.min(given) >= 0.0)
    ]


def covariances(named: Mapping[str, tuple[Any, int]]) -> list[Finding]:
    """Covariance matrices (3, 3), or (m, 3, 3) with one for each of m points."""
    return [
        finding
        for name, (given, count) in named.items()
        for finding in numbers({name: (given, (3, 3) if np.ndim(given) == 2 else (count, 3, 3))})
    ]


def lengths(named: Mapping[str, FloatArray]) -> list[Finding]:
    """Lengths, m, that fit into a cell."""
    found = []
    for name, array in named.items():
        largest = float(np.abs(array).max(initial=0.0))
        if largest > LARGEST_LENGTH_M:
            found.append(
                Finding(
                    Cause.WRONG_UNITS,
                    f"{name} goes up to {largest:.4g} m, limit {LARGEST_LENGTH_M:g} m",
                    f"{METRES}: these look like millimetres",
                )
            )
    return found


def angles(named: Mapping[str, FloatArray]) -> list[Finding]:
    """Angles, rad, of joints."""
    return [
        Finding(
            Cause.WRONG_UNITS,
            f"{name} goes up to {np.abs(array).max():.4g} rad, limit {LARGEST_ANGLE_RAD:.4g} rad",
            "Give radians: these look like degrees",
        )
        for name, array in named.items()
        if np.abs(array).max(initial=0.0) > LARGEST_ANGLE_RAD
    ]


def angles_of_arm(named: Mapping[str, FloatArray]) -> list[Finding]:
    """Angles, rad, of all joints of an arm, which all stay near zero at no poses worth measuring."""
    return angles(named) + [
        Finding(
            Cause.WRONG_UNITS,
            f"{name} goes up to {np.degrees(np.abs(array).max()):.3g} deg only, in all joints",
            "Check the unit of angles: these look like radians given as degrees",
        )
        for name, array in named.items()
        if 0.0 < np.abs(array).max(initial=0.0) < SMALLEST_ANGLE_RAD
    ]


def transforms(named: Mapping[str, FloatArray]) -> list[Finding]:
    """Poses (k, 4, 4): right-handed orthonormal rotations, last row 0 0 0 1."""
    found = []
    for name, poses in named.items():
        rotation = poses[:, :3, :3]
        skewed = np.abs(rotation.swapaxes(1, 2) @ rotation - np.eye(3)).max(axis=(1, 2))
        worst = int(np.argmax(skewed))
        if skewed[worst] > LARGEST_SKEW:
            found.append(
                Finding(
                    Cause.NOT_A_ROTATION,
                    f"{name}[{worst}]: R^T R differs from the identity by {skewed[worst]:.2g}, "
                    f"limit {LARGEST_SKEW:g}",
                    "Write rotations with six decimals or more, and check the order of the numbers",
                )
            )
        elif (mirrored := np.linalg.det(rotation) < 0.0).any():
            found.append(
                Finding(
                    Cause.LEFT_HANDED,
                    f"{int(mirrored.sum())} of {len(poses)} rotations of {name} are left-handed, first "
                    f"{name}[{int(np.argmax(mirrored))}]",
                    "Check the signs of the axes: x cross y must be z",
                )
            )
        elif np.abs(poses[:, 3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-9:
            found.append(
                Finding(
                    Cause.NOT_A_ROTATION,
                    f"The last row of a matrix of {name} is not 0 0 0 1",
                    "Give homogeneous matrices whose fourth column is the origin; are they transposed?",
                )
            )
    return found


def orientations(poses: FloatArray) -> list[Finding]:
    """Poses (k, 4, 4) that must differ in orientation, about two axes, for a mount to be determined."""
    if len(poses) < 2:
        return []
    chosen = poses[np.unique(np.linspace(0, len(poses) - 1, _MOST_PAIRED).astype(np.intp))]
    rotation = Rotation.from_matrix(chosen[:, :3, :3])
    first, second = np.triu_indices(len(chosen), 1)
    return turns((rotation[first].inv() * rotation[second]).as_rotvec())


def turns(turn: FloatArray) -> list[Finding]:
    """Turns of the flange (m, 3), rad, as seen from it: large enough, and about two axes."""
    angle = np.linalg.norm(turn, axis=1)
    largest = float(angle.max())
    remedy = "Turn the tool by 20 deg or more about at least two axes"
    if largest < SMALLEST_ROTATION_RAD:
        constant = largest < CONSTANT_RAD
        return [
            Finding(
                Cause.CONSTANT_ORIENTATION if constant else Cause.SMALL_ROTATIONS,
                f"The orientation of the flange changes by {np.degrees(largest):.3g} deg at most, limit "
                f"{np.degrees(SMALLEST_ROTATION_RAD):g} deg",
                remedy,
            )
        ]
    found = []
    # All turns about one axis share it, seen from the flange as well as from the base.
    axis = np.linalg.svd(turn, full_matrices=False)[2][0]
    off = float(np.linalg.norm(np.cross(turn, axis), axis=1).max())
    if off < SMALLEST_OFF_AXIS_RAD:
        found.append(
            Finding(
                Cause.ONE_AXIS,
                f"The flange turns about one axis only, about others by {np.degrees(off):.2g} deg at most, "
                f"limit {np.degrees(SMALLEST_OFF_AXIS_RAD):g} deg",
                remedy,
            )
        )
    seen = angle[angle > _NOTICED_RAD]
    if len(seen) and seen.min() > HALF_TURN_RAD:
        found.append(
            Finding(
                Cause.HALF_TURNS,
                f"Orientations differ by {np.degrees(seen.min()):.4g} to {np.degrees(seen.max()):.4g} deg, "
                "or hardly at all; the axis of a half turn has no sign",
                "Add poses with turns of 20 to 120 deg",
                refuses=False,
            )
        )
    return found


def positions(poses: FloatArray) -> list[Finding]:
    """Flange positions that all lie in a plane: errors of the arm across it stay unseen."""
    if len(poses) < 4:
        return []
    centred = poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(poses))
    if not spread[1] > 0.0 or spread[2] > _FLAT * spread[1]:
        return []
    return [
        Finding(
            Cause.COPLANAR_POSES,
            f"The flange stays in a plane to {spread[2] * 1e3:.3g} mm, "
            f"while it moves {spread[1] * 1e3:.3g} mm in it",
            "Vary the distance as well",
            refuses=False,
        )
    ]


def count(rows: int, unknowns: int) -> list[Finding]:
    """Rows enough for the unknowns, and one more to check them."""
    if rows > unknowns:
        return []
    return [
        Finding(
            Cause.TOO_FEW,
            f"{rows} measured numbers for {unknowns} unknowns"
            + ("" if rows < unknowns else ": nothing is left to check them"),
            "Measure more",
            refuses=rows < unknowns,
        )
    ]


def repeated(keys: FloatArray, unknowns: int, rows_each: int = 1) -> list[Finding]:
    """Measurements (m, k) equal in every digit: copies, which are not independent of each other."""
    distinct = len(np.unique(keys, axis=0))
    if distinct == len(keys):
        return []
    few = distinct * rows_each < unknowns
    return [
        Finding(
            Cause.DUPLICATED,
            f"Only {distinct} of {len(keys)} measurements differ"
            + (f", too few for {unknowns} unknowns" if few else ""),
            "Take out the copies; measure again instead of repeating a number",
            refuses=few,
        )
    ]


def normals(axes: FloatArray, used: NDArray[np.intp]) -> list[Finding]:
    """Normals (f, 3) of faces, of which readings name some: they must point in three directions."""
    named = axes[np.unique(used)]
    singular = np.linalg.svd(named, compute_uv=False)
    rank = int(np.sum(singular > _FLAT * singular[0]))
    if rank == 3:
        return []
    if rank == 1:
        return [
            Finding(
                Cause.ONE_FACE,
                f"All readings are on {'one face' if len(named) == 1 else 'parallel faces'} of the part",
                "Measure three faces whose normals point in different directions",
            )
        ]
    return [
        Finding(
            Cause.SYMMETRIC,
            "The measured faces are all parallel to one line: the part may slide along it unseen",
            "Measure a face across that line",
        )
    ]


def spread(points: FloatArray, what: str) -> list[Finding]:
    """Points (m, 3) that must not lie on a line."""
    centred = points - points.mean(axis=0)
    width = np.linalg.svd(centred, full_matrices=False, compute_uv=False) / np.sqrt(len(points))
    if len(width) > 1 and width[1] > _FLAT * width[0]:
        return []
    return [
        Finding(
            Cause.COLLINEAR,
            f"The {what} lie on a line, {0.0 if len(width) < 2 else width[1] * 1e3:.3g} mm wide over "
            f"{width[0] * 1e3:.3g} mm",
            "Spread them in two directions",
        )
    ]


def refusing(findings: Sequence[Finding]) -> bool:
    """Whether any of them refuses."""
    return any(finding.refuses for finding in findings)
