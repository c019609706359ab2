"""Every simulated device by the name of its driver: for cells, for `--device`, for the conformance tests."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from estimation.errors import CellFileError
from simulators.device_kind import DeviceKind, Surroundings
from simulators.probes.kinds import PROBES
from simulators.robots.kinds import ROBOTS
from simulators.sensors.kinds import LASERS

DEVICES: Final[Mapping[str, DeviceKind[Any]]] = {
    **{kind.name: kind for kind in ROBOTS},
    **{kind.name: kind for kind in LASERS},
    **{kind.name: kind for kind in PROBES},
}


def device_kind(name: str) -> DeviceKind[Any]:
    """The device of this name. Raises CellFileError."""
    return choose(name, "device", tuple(DEVICES.values()))


def choose(name: str, what: str, kinds: Sequence[DeviceKind[Surroundings]]) -> DeviceKind[Surroundings]:
    """The one of this name among these. Raises CellFileError."""
    for kind in kinds:
        if kind.name == name:
            return kind
    known = ", ".join(kind.name for kind in kinds)
    raise CellFileError(f"No simulated {what} {name!r}", f"Choose one of {known}")
