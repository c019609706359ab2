"""The tables of what stands in the cell: artefacts and the part with its characteristics."""

from datetime import date
from math import radians
from typing import Annotated, ClassVar, Final, Literal

from pydantic import Field

from controller.cellfile.tables import Name, Placement, Table, Text
from controller.quantities import Angle, Length

UNITS_M: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}

PartCoordinate = Annotated[Length, Field(ge=-10, le=10)]


class Artefact(Placement):
    """Something of known size, with the certificate that says so."""

    certificate: Text | None = None
    """Number of the calibration certificate."""
    certified: date | None = None
    """Day of the calibration."""
    valid_to: date | None = None
    """Last day on which the certificate holds."""


class Plate(Artefact):
    """Calibration plane: z = 0 of its frame, normal +z, origin in its middle."""

    FRAME: ClassVar[str] = "plate"
    PARENT: ClassVar[str] = "base"

    size_m: tuple[Annotated[Length, Field(gt=0, le=5)], Annotated[Length, Field(gt=0, le=5)]]
    """Length along x and y."""
    flatness_u_m: Length = Field(ge=0, le=0.001)
    """Standard deviation of the surface from the plane, independent from point to point."""
    margin_m: Length = Field(ge=0, le=1)
    """Border that is not used."""


class Bar(Artefact):
    """Two spheres: the first at the origin of its frame, the second along +z."""

    FRAME: ClassVar[str] = "bar"
    PARENT: ClassVar[str] = "base"

    sphere_radius_m: Length = Field(gt=0, le=0.5)
    """Radius of both spheres."""
    sphere_radius_u_m: Length = Field(ge=0, le=0.001)
    """Standard uncertainty of the radius."""
    length_m: Length = Field(gt=0, le=5)
    """Distance between the centres."""
    length_u_m: Length = Field(ge=0, le=0.001)
    """Standard uncertainty of the length."""


class Sphere(Artefact):
    """The sphere on which the stylus is qualified; origin in its centre."""

    FRAME: ClassVar[str] = "sphere"
    PARENT: ClassVar[str] = "base"

    radius_m: Length = Field(gt=0, le=0.5)
    """Radius."""
    radius_u_m: Length = Field(ge=0, le=0.001)
    """Standard uncertainty of the radius."""


class PartFeature(Table):
    """A face of the part: plane, cylinder or sphere, as the CAD file says."""

    name: Name
    """How characteristics and phases call it."""
    at_m: tuple[PartCoordinate, PartCoordinate, PartCoordinate]
    """Any point on the face, in the CAD frame."""
    form_u_m: Length = Field(default=0.0, ge=0, le=0.01)
    """Standard deviation of the real face from its nominal place, along the normal."""
    size_u_m: Length = Field(default=0.0, ge=0, le=0.01)
    """Standard deviation of the radius."""
    position_u_m: Length = Field(default=0.0, ge=0, le=0.01)
    """Standard deviation of the place of a bore or boss, each axis."""


class Diameter(Table):
    """A diameter with two limits."""

    kind: Literal["diameter"]
    """What is toleranced, and which keys it has."""
    id: Name
    """Number on the drawing."""
    feature: str
    """Name of the feature."""
    nominal_m: Length = Field(gt=0, le=5)
    """Nominal diameter."""
    tolerance_m: tuple[Length, Length]
    """Lower and upper deviation from nominal."""


class Position(Table):
    """The position of an axis in a datum system."""

    kind: Literal["position"]
    """What is toleranced, and which keys it has."""
    id: Name
    """Number on the drawing."""
    feature: str
    """Name of the feature."""
    datums: Annotated[tuple[str, ...], Field(min_length=3, max_length=3)]
    """Primary, secondary and tertiary datum: names of features."""
    tolerance_m: Length = Field(gt=0, le=0.1)
    """Diameter of the zone."""


class Flatness(Table):
    """The flatness of a face."""

    kind: Literal["flatness"]
    """What is toleranced, and which keys it has."""
    id: Name
    """Number on the drawing."""
    feature: str
    """Name of the feature."""
    tolerance_m: Length = Field(gt=0, le=0.1)
    """Distance of the two planes."""


Characteristic = Annotated[Diameter | Position | Flatness, Field(discriminator="kind")]


class Part(Placement):
    """The part: where it lies nominally, its CAD file, features and characteristics."""

    FRAME: ClassVar[str] = "part"
    PARENT: ClassVar[str] = "base"

    name: Name
    """Name of the part."""
    cad: Text
    """STEP file, or a closed mesh (STL, PLY), relative to this file."""
    cad_unit: Literal["mm", "cm", "m", "in"]
    """Unit of the CAD file: compared with what a STEP file says; that of a mesh, which says nothing."""
    position_limit_m: Length = Field(gt=0, le=1)
    """Farthest that the part may lie from its nominal place."""
    rotation_limit_rad: Angle = Field(gt=0, le=radians(45))
    """Farthest that the part may be turned."""
    features: Annotated[tuple[PartFeature, ...], Field(min_length=1)]
    """Faces that are measured."""
    characteristics: tuple[Characteristic, ...] = ()
    """What is inspected."""

    @property
    def cad_unit_m(self) -> float:
        """The unit of the CAD file, metres."""
        return UNITS_M[self.cad_unit]

    def feature(self, name: str) -> PartFeature:
        """The feature of this name, which a loaded cell file is known to have."""
        return next(feature for feature in self.features if feature.name == name)
