"""Surfaces of an object by name: where they are nominally, and by what they may deviate."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from estimation.errors import EstimationError
from estimation.surfaces.shape import Shape
from estimation.transform import FloatArray

Kind = Literal["plane", "sphere", "cylinder", "cone", "torus", "freeform"]
Vector = tuple[float, float, float]

KINDS: Final[tuple[Kind, ...]] = ("plane", "sphere", "cylinder", "cone", "torus", "freeform")
SHIFTS: Final = ("shift_x", "shift_y", "shift_z")
TILTS: Final = ("tilt_x", "tilt_y", "tilt_z")
DEVIATIONS: Final = ("offset", *SHIFTS, *TILTS)
SIZES: Final = {"cone": "half_angle", "torus": "major_radius"}  # deviations that only these kinds have


@dataclass(frozen=True, slots=True)
class Feature:
    """One surface of an object, in the frame of the object.

    Attributes
    ----------
    point_m : on the plane, centre of the sphere or torus, any point on the axis of the cylinder, apex of
        the cone; for a free form only the point about which it tilts.
    axis : unit normal out of the material (plane) or axis (cylinder, torus, and cone: from the apex into
        it); unused for a sphere or free form.
    radius_m : nominal radius, of a torus that of its tube; zero for plane and cone, and where a parameter
        holds the whole radius.
    outward : True when the material is inside the sphere, cylinder, cone or tube (boss), False around it
        (bore).
    deviations : what the parameters of the feature do, in their order. "offset" (m) moves the surface
        out of the material along its normal: a boss grows, a bore shrinks. "shift_x|y|z" (m) moves the
        feature along an axis of the object; "tilt_x|y|z" (rad, small) turns it about `point_m`.
        "half_angle" (rad) opens a cone, "major_radius" (m) widens a torus; a free form has the parameters
        of its shape.
    blocks : the belief's blocks that hold the parameters: one block with all of them, or one scalar
        block for each. Features may share a block, as the two spheres of a bar share their radius.
    half_angle_rad, major_radius_m : of a cone, and of the circle in the middle of a torus's tube.
    shape : of a free form, in the frame of the object.
    """

    name: str
    kind: Kind
    point_m: Vector
    axis: Vector = (0.0, 0.0, 1.0)
    radius_m: float = 0.0
    outward: bool = True
    deviations: tuple[str, ...] = ()
    blocks: tuple[str, ...] = ()
    half_angle_rad: float = 0.0
    major_radius_m: float = 0.0
    shape: Shape | None = None

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
        self._check_size()
        if unknown := set(self.deviations) - {*DEVIATIONS, *self.own_parameters}:
            raise EstimationError(
                f"Feature {self.name} deviates by {', '.join(sorted(unknown))}",
                f"Use {', '.join((*DEVIATIONS, *self.own_parameters[:3]))}",
            )
        if len(self.blocks) not in ({1, len(self.deviations)} if self.deviations else {0}):
            raise EstimationError(
                f"Feature {self.name} has {len(self.deviations)} deviations in {len(self.blocks)} blocks",
                "Give one block for all deviations, or one for each",
            )

    def _check_size(self) -> None:
        if self.kind == "cone" and not 0.0 < self.half_angle_rad < math.pi / 2:
            raise EstimationError(
                f"Cone {self.name} has a half angle of {math.degrees(self.half_angle_rad):.6g} deg",
                "Give one between 0 and 90 deg",
            )
        if self.kind == "torus" and not self.major_radius_m > self.radius_m:
            raise EstimationError(
                f"Torus {self.name} has a major radius of {self.major_radius_m * 1e3:.6g} mm and a tube of "
                f"{self.radius_m * 1e3:.6g} mm",
                "Give a tube smaller than the circle that it follows",
            )
        if (self.kind == "freeform") != (self.shape is not None):
            raise EstimationError(
                f"Feature {self.name} is a {self.kind} with shape {self.shape!r}",
                "Give a shape to a free form, and to nothing else",
            )

    @property
    def own_parameters(self) -> tuple[str, ...]:
        """Deviations that this feature has beside those that all have."""
        if self.shape is not None:
            return self.shape.parameter_names
        return (SIZES[self.kind],) if self.kind in SIZES else ()

    @property
    def size(self) -> float:
        """What the own parameter of a cone or torus deviates from: half angle (rad) or major radius (m)."""
        return self.half_angle_rad if self.kind == "cone" else self.major_radius_m

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
        """The feature with its deviations (in their order) built in, and none left; tilts to first order.

        Raises EstimationError for a free form, whose shape has `deviated` of its own.
        """
        if self.kind == "freeform":
            raise EstimationError(
                f"Free form {self.name} keeps its deviations apart", "Use deviated() of its shape"
            )
        shift, tilt, offset, size = np.zeros(3), np.zeros(3), 0.0, 0.0
        for kind, value in zip(self.deviations, values, strict=True):
            if kind == "offset":
                offset += value
            elif kind in SHIFTS:
                shift[SHIFTS.index(kind)] += value
            elif kind in TILTS:
                tilt[TILTS.index(kind)] += value
            else:
                size += value
        axis = np.asarray(self.axis) + np.cross(tilt, self.axis)
        axis /= np.linalg.norm(axis)
        point, radius = np.asarray(self.point_m) + shift, self.radius_m
        half_angle, major_radius = self.half_angle_rad, self.major_radius_m
        growth = self.radius_sign * offset
        if self.kind == "plane":
            point = point + offset * axis
        elif self.kind == "cone":  # a parallel cone is the same cone further along its axis
            half_angle += size
            point = point - growth / math.sin(half_angle) * axis
        else:
            radius += growth
            major_radius += size
        return replace(
            self,
            point_m=_vector(point),
            axis=_vector(axis),
            radius_m=radius,
            half_angle_rad=half_angle,
            major_radius_m=major_radius,
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


def cone(name: str, apex_m: FloatArray, axis: FloatArray, half_angle_rad: float, outward: bool) -> Feature:
    """A cone from its apex along `axis`; outward when the material is inside."""
    return Feature(
        name, "cone", _vector(apex_m), _vector(axis), outward=outward, half_angle_rad=half_angle_rad
    )


def torus(
    name: str, centre_m: FloatArray, axis: FloatArray, major_radius_m: float, radius_m: float, outward: bool
) -> Feature:
    """A tube of radius `radius_m` around a circle; outward when the material is inside the tube."""
    return Feature(
        name,
        "torus",
        _vector(centre_m),
        _vector(axis),
        radius_m,
        outward,
        major_radius_m=major_radius_m,
    )


def freeform(name: str, shape: Shape, block: str | None = None) -> Feature:
    """A spline or mesh in the frame of the object; with `block`, its own parameters may deviate."""
    deviations = shape.parameter_names if block else ()
    return Feature(name, "freeform", (0.0, 0.0, 0.0), deviations=deviations, blocks=_one(block), shape=shape)


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


def _vector(values: Sequence[float] | FloatArray) -> Vector:
    x, y, z = (float(value) for value in values)
    return (x, y, z)


def _one(block: str | None) -> tuple[str, ...]:
    return (block,) if block else ()
