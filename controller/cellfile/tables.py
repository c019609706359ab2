"""What all tables of the cell file share: strictness, names, and placement in a frame."""

import re
from math import radians
from typing import TYPE_CHECKING, Annotated, ClassVar, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from controller.quantities import Angle, Length

if TYPE_CHECKING:  # numpy only when a transform is asked for
    from estimation.transform import Transform

_UNIT_SUFFIX: Final = re.compile(r"_(m|rad|s|m_s|rad_s|rad_s2|kg|hz)$")

Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9 _.-]*$", max_length=40)]
Text = Annotated[str, StringConstraints(min_length=1, max_length=200)]
Host = Annotated[
    str, StringConstraints(pattern=r"^[A-Za-z0-9]([A-Za-z0-9.:-]*[A-Za-z0-9])?$", max_length=253)
]
Count = Annotated[int, Field(ge=1, le=10_000)]


def key_of(field_name: str) -> str:
    """The key in the file: the Python name without its SI unit, as the value carries its own."""
    return _UNIT_SUFFIX.sub("", field_name)


class Table(BaseModel):
    """A table of the cell file: unknown keys are refused, nothing is converted silently."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        strict=True,
        alias_generator=key_of,
        use_attribute_docstrings=True,
        protected_namespaces=(),
    )


class Placement(Table):
    """Where a frame nominally lies in its parent, and how well that is known."""

    FRAME: ClassVar[str]
    PARENT: ClassVar[str]

    parent: str
    """Frame in which it is placed: `flange` for what the arm carries, `base` for what stands."""
    xyz_m: tuple[
        Annotated[Length, Field(ge=-10, le=10)],
        Annotated[Length, Field(ge=-10, le=10)],
        Annotated[Length, Field(ge=-10, le=10)],
    ]
    """Origin in the parent frame."""
    rpy_rad: tuple[Angle, Angle, Angle]
    """Rotation about the fixed x, y and z axes of the parent, in this order (REP-103)."""
    position_u_m: Length = Field(ge=0, le=0.1)
    """Standard uncertainty of the origin, each axis."""
    rotation_u_rad: Angle = Field(default=0.0, ge=0, le=radians(20))
    """Standard uncertainty of the orientation, about each axis."""

    def transform(self) -> "Transform":
        """parent_T_frame, nominal."""
        import numpy as np

        from estimation.transform import Transform

        return Transform.from_xyz_rpy(self.parent, self.FRAME, np.array(self.xyz_m), np.array(self.rpy_rad))


class SerialLine(Table):
    """What every device on a serial line has."""

    port: Text
    """Device such as `/dev/ttyUSB0`, `/dev/serial/by-id/...` or `COM3`, or a path relative to this file. \
`/dev/ttyUSB*` fits several: the device is looked for at each."""


class CanBus(Table):
    """What every device on a CAN bus has."""

    port: Text
    """Dongle such as `/dev/ttyACM0` or `COM3`, or a path relative to this file; `/dev/ttyACM*` fits \
several. With `socketcan` the interface, such as `can0`."""
    interface: Literal["slcan", "socketcan"]
    """Kind of CAN interface."""
    bitrate: Literal[50_000, 125_000, 250_000, 500_000, 1_000_000]
    """Bit/s on the bus."""
