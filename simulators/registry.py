"""Every simulated device by name: for `truecell simulate --device`, and for the conformance tests."""

from collections.abc import Mapping
from typing import Final

from estimation.errors import CellFileError
from simulators.device_kind import DeviceKind
from simulators.probes import adam6052, wago750
from simulators.robots import alone as robots
from simulators.robots import canopen_arm
from simulators.sensors import alone as sensors
from simulators.sensors import optoncdt

DEVICES: Final[Mapping[str, DeviceKind]] = {
    kind.name: kind
    for kind in (
        canopen_arm.KIND,
        *robots.KINDS,
        optoncdt.KIND,
        *sensors.KINDS,
        adam6052.KIND,
        wago750.KIND,
    )
}


def device_kind(name: str) -> DeviceKind:
    """The device of this name. Raises CellFileError."""
    if name not in DEVICES:
        raise CellFileError(f"No simulated device {name!r}", f"Choose one of {', '.join(DEVICES)}")
    return DEVICES[name]
