"""Surfaces of an object and how far points are from them, with parameters for how the surfaces deviate."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from estimation.errors import DegenerateGeometry, EstimationError
from estimation.transform import FloatArray

Kind = Literal["plane", "sphere", "cylinder"]
Vector = tuple[float, float, float]

KINDS: Final[tuple[Kind, ...]] = ("plane", "sphere", "cylinder")
SHIFTS: Final = ("shift_x", "shift_y", "shift_z")
TILTS: Final = ("tilt_x", "tilt_y", "tilt_z")
DEVIATIONS: Final = ("offset", *SHIFTS, *TILTS)
_SMALLEST_RADIUS_M: Final = 1e-9  # nearer to a centre or an axis there is no direction to the surface


@dataclass(frozen=True, slots=True)
class Feature:
    """One surface of an object, in the frame of the object.

    Attributes
    ----------
    point_m : on the plane, centre of the sphere, or any point on the axis of the cylinder.
    axis : unit normal out of the material (plane) or axis (cylinder); unused for a sphere.
    radius_m : nominal radius; zero for a plane, and where a parameter holds the whole radius.
    outward : True when the material is inside the sphere or cylinder (boss), False around it (bore).
    deviations : what the parameters of the feature do, in their order. "offset" (m) moves the surface
        out of the material along its normal: a boss grows, a bore shrinks. "shift_x|y|z" (m) moves the
        feature along an axis of the object; "tilt_x|y|z" (rad, small) turns it about `point_m`.
    blocks : the belief's blocks that hold the parameters: one block with all of them, or one scalar
        block for each. Features may share a block, as the two spheres of a bar share their radius.
    """

    name: str
    kind: Kind
    point_m: Vector
    axis: Vector = (0.0, 0.0, 1.0)
    radius_m: float = 0.0
    outward: bool = True
    deviations: tuple[str, ...] = ()
    blocks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        # Tuples of plain floats, so that features compare, hash and print.
        object.__setattr__(self, "point_m", _vector(self.point_m))
        axis = np.asarray(self.axis, dtype=np.float64)
        length = float(np.linalg.norm(axis))
        if self.kind not in KINDS:
            raise EstimationError(f"Feature {self.name} is a {self.kind}", f"Use one of {', '.join(KINDS)}")
        if not 0.999 < length < 1.001 or not np.isfinite(self.point_m).all() or not self.radius_m >= 0.0:
            raise EstimationError(
                f"Feature {self.name}: axis of length {length:.6g}, radius {self.radius_m * 1e3:.6g} mm",
                "Give finite numbers, an axis of length 1 and a radius of at least 0 mm",
            )
        object.__setattr__(self, "axis", _vector(axis / length))
        if unknown := set(self.deviations) - set(DEVIATIONS):
            raise EstimationError(
                f"Feature {self.name} deviates by {', '.join(sorted(unknown))}",
                f"Use {', '.join(DEVIATIONS)}",
            )
        if len(self.blocks) not in ({1, len(self.deviations)} if self.deviations else {0}):
            raise EstimationError(
                f"Feature {self.name} has {len(self.deviations)} deviations in {len(self.blocks)} blocks",
                "Give one block for all deviations, or one for each",
            )

    @property
    def parameters(self) -> tuple[tuple[str, int], ...]:
        """(block, place within the block) of each deviation."""
        if len(self.blocks) == len(self.deviations):
            return tuple((block, 0) for block in self.blocks)
        return tuple((self.blocks[0], place) for place in range(len(self.deviations)))

    @property
    def radius_sign(self) -> float:
        """Metres of radius for one metre of "offset": +1, or -1 for a bore."""
        return 1.0 if self.outward else -1.0

    def deviated(self, values: Sequence[float]) -> "Feature":
        """The feature with its deviations (in their order) built in, and none left; tilts to first order."""
        shift, tilt, offset = np.zeros(3), np.zeros(3), 0.0
        for kind, value in zip(self.deviations, values, strict=True):
            if kind == "offset":
                offset += value
            elif kind in SHIFTS:
                shift[SHIFTS.index(kind)] += value
            else:
                tilt[TILTS.index(kind)] += value
        axis = np.asarray(self.axis) + np.cross(tilt, self.axis)
        axis /= np.linalg.norm(axis)
        point = np.asarray(self.point_m) + shift + (offset * axis if self.kind == "plane" else 0.0)
        radius = 0.0 if self.kind == "plane" else self.radius_m + self.radius_sign * offset
        return replace(
            self,
            point_m=_vector(point),
            axis=_vector(axis),
            radius_m=radius,
            deviations=(),
            blocks=(),
        )


def plane(name: str, point_m: FloatArray, normal: FloatArray, block: str | None = None) -> Feature:
    """A face with `normal` out of the material; with `block`, it may lie off its nominal place."""
    deviations = ("offset",) if block else ()
    return Feature(name, "plane", _vector(point_m), _vector(normal), 0.0, True, deviations, _one(block))


def cylinder(
    name: str,
    point_m: FloatArray,
    axis: FloatArray,
    radius_m: float,
    outward: bool,
    block: str | None = None,
    shifts: tuple[str, ...] = ("shift_x", "shift_y"),
) -> Feature:
    """A boss (outward) or bore; with `block`, it may be shifted across its axis and off its size."""
    deviations = (*shifts, "offset") if block else ()
    return Feature(
        name, "cylinder", _vector(point_m), _vector(axis), radius_m, outward, deviations, _one(block)
    )


def plate_features() -> tuple[Feature, ...]:
    """The calibration plate: the plane z = 0 of its frame."""
    return (Feature("plate", "plane", (0.0, 0.0, 0.0)),)


def bar_features(name: str = "bar") -> tuple[Feature, ...]:
    """Two spheres, at the origin and along +z; the blocks `<name>.length` and `.radius` hold whole values."""
    radius, length = f"{name}.radius", f"{name}.length"
    return (
        Feature(f"{name} first", "sphere", (0.0, 0.0, 0.0), deviations=("offset",), blocks=(radius,)),
        Feature(
            f"{name} second",
            "sphere",
            (0.0, 0.0, 0.0),
            deviations=("shift_z", "offset"),
            blocks=(length, radius),
        ),
    )


def sphere_features(name: str = "sphere") -> tuple[Feature, ...]:
    """One sphere at the origin; the block `<name>.radius` holds the whole radius."""
    return (Feature(name, "sphere", (0.0, 0.0, 0.0), deviations=("offset",), blocks=(f"{name}.radius",)),)


@dataclass(frozen=True, slots=True, eq=False)
class SignedDistance:
    """Distances of points to their features, positive on the free side of the surface."""

    distance_m: FloatArray  # (m,)
    gradient: FloatArray  # (m, 3) by the point, frame of the object
    deviation: FloatArray  # (m, p) by the parameters, in the order of `FeatureTable.blocks`


@dataclass(frozen=True, slots=True, eq=False)
class FeatureTable:
    """The features as arrays, with the linear maps from all their parameters to shift, tilt and offset."""

    blocks: tuple[tuple[str, int], ...]  # each block and how many parameters it holds
    kind: NDArray[np.intp]  # (f,) place in KINDS
    point_m: FloatArray  # (f, 3)
    axis: FloatArray  # (f, 3)
    radius_m: FloatArray  # (f,)
    sign: FloatArray  # (f,)
    curved: bool  # any feature is not a plane
    tilted: bool  # any feature has a tilt
    shift: FloatArray  # (f, 3, p)
    tilt: FloatArray  # (f, 3, p)
    offset: FloatArray  # (f, p)


@lru_cache(maxsize=256)
def feature_table(features: tuple[Feature, ...]) -> FeatureTable:
    """Arrays of some features; cached, because the same features come with every batch and iteration."""
    sizes: dict[str, int] = {}
    for feature in features:
        for block, place in feature.parameters:
            sizes[block] = max(sizes.get(block, 0), place + 1)
    start = dict(zip(sizes, np.cumsum([0, *sizes.values()])[:-1].tolist(), strict=True))
    count, total = len(features), sum(sizes.values())
    shift, tilt = np.zeros((count, 3, total)), np.zeros((count, 3, total))
    offset = np.zeros((count, total))
    for i, feature in enumerate(features):
        for kind, (block, place) in zip(feature.deviations, feature.parameters, strict=True):
            column = start[block] + place
            if kind == "offset":
                offset[i, column] = 1.0
            elif kind in SHIFTS:
                shift[i, SHIFTS.index(kind), column] = 1.0
            else:
                tilt[i, TILTS.index(kind), column] = 1.0
    return FeatureTable(
        blocks=tuple(sizes.items()),
        kind=np.array([KINDS.index(feature.kind) for feature in features], dtype=np.intp),
        point_m=np.array([feature.point_m for feature in features]).reshape(count, 3),
        axis=np.array([feature.axis for feature in features]).reshape(count, 3),
        radius_m=np.array([feature.radius_m for feature in features]),
        sign=np.array([feature.radius_sign for feature in features]),
        curved=any(feature.kind != "plane" for feature in features),
        tilted=bool(tilt.any()),
        shift=shift,
        tilt=tilt,
        offset=offset,
    )


def signed_distance(
    features: tuple[Feature, ...],
    index: NDArray[np.intp],
    object_p: FloatArray,
    parameters: FloatArray | None = None,
) -> SignedDistance:
    """Signed distances of points to their features, and the derivatives.

    Parameters
    ----------
    index : (m,) place in `features` of the feature that each point belongs to.
    object_p : (m, 3), metres, frame of the object.
    parameters : (p,) deviations, in the order of `feature_table(features).blocks`; None means zeros.

    Raises
    ------
    DegenerateGeometry
        A point in the centre of its sphere or on the axis of its cylinder.

    Notes
    -----
    Source: Sallinen (2003), eq. (62-67), signed so that the distance is positive outside the material.
    """
    table = feature_table(features)
    values = np.zeros(table.offset.shape[1]) if parameters is None else parameters
    arm = object_p - (table.point_m + table.shift @ values)[index]
    if not table.tilted:
        distance, gradient = _untilted(features, table, index, arm)
        turned = 0.0
    else:
        tilt = (table.tilt @ values)[index]
        # The feature turns by +tilt, so in its own frame the point turns by -tilt about it.
        distance, normal = _untilted(features, table, index, arm - cross(tilt, arm))
        gradient = normal + cross(tilt, normal)
        turned = np.einsum("ij,ijk->ik", cross(arm, normal), table.tilt[index])
    offset = table.offset[index]
    deviation = -np.einsum("ij,ijk->ik", gradient, table.shift[index]) - turned - offset
    return SignedDistance(distance - offset @ values, gradient, deviation)


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """a x b for rows of 3; an eighth of the time of numpy's, which counts in the inner loop."""
    product = np.empty(np.broadcast_shapes(a.shape, b.shape))
    ax, ay, az, bx, by, bz = a[..., 0], a[..., 1], a[..., 2], b[..., 0], b[..., 1], b[..., 2]
    product[..., 0] = ay * bz - az * by
    product[..., 1] = az * bx - ax * bz
    product[..., 2] = ax * by - ay * bx
    return product


def _untilted(
    features: tuple[Feature, ...], table: FeatureTable, index: NDArray[np.intp], arm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Distance (m,) and unit gradient (m, 3) at points `arm` (m, 3) from the points of their features."""
    axis = table.axis[index]
    along: FloatArray = np.einsum("ij,ij->i", arm, axis)
    if not table.curved:
        return along, axis
    kind, sign = table.kind[index], table.sign[index]
    curved = kind != KINDS.index("plane")
    across = arm - np.where(kind == KINDS.index("cylinder"), along, 0.0)[:, None] * axis
    radial = np.sqrt(np.einsum("ij,ij->i", across, across))
    centred = curved & (radial < _SMALLEST_RADIUS_M)
    if centred.any():
        raise DegenerateGeometry(
            f"A point lies within {_SMALLEST_RADIUS_M * 1e9:.0f} nm of the centre or axis of "
            f"{features[int(index[np.argmax(centred)])].name}",
            "Measure on the surface",
        )
    outwards = (sign / np.where(curved, radial, 1.0))[:, None] * across
    normal = np.where(curved[:, None], outwards, axis)
    return np.where(curved, sign * (radial - table.radius_m[index]), along), normal


def _vector(values: Sequence[float] | FloatArray) -> Vector:
    x, y, z = (float(value) for value in values)
    return (x, y, z)


def _one(block: str | None) -> tuple[str, ...]:
    return (block,) if block else ()
