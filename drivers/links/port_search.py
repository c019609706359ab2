"""A port that has no fixed name: the device is looked for at every port that fits a pattern."""

import fnmatch
import glob
import sys
from dataclasses import dataclass
from pathlib import PurePath
from typing import Protocol

from drivers.capabilities import Device, Identity
from estimation.errors import DeviceError


class Movable(Protocol):
    """A link that opens another port when it is told a new name."""

    port: str


def is_pattern(port: str) -> bool:
    """Whether a port of the cell file stands for several: with *, ? or [...]."""
    return any(character in port for character in "*?[")


@dataclass(slots=True)
class PortSearch:
    """Connects at the port where it was last, else at the first one that has the expected device.

    Each port that fits is opened and asked; so the pattern must not fit ports of devices of another kind.
    """

    link: Movable
    pattern: str

    def connect(self, device: Device) -> Identity:
        """Open links and read identities until one is the expected one. Raises DeviceError."""
        ports = self.candidates()
        failures = list[DeviceError]()
        for port in ports:
            self.link.port = port
            try:
                return device.connect()
            except DeviceError as error:
                device.close()
                failures.append(error)
        if not failures:
            raise DeviceError(f"No port {self.pattern} is there", "Plug the device in")
        if len(failures) == 1:
            raise failures[0]
        found = "; ".join(
            f"{PurePath(port).name}: {error.problem}" for port, error in zip(ports, failures, strict=True)
        )
        raise DeviceError(f"None of the ports {self.pattern} has the device ({found})", failures[-1].remedy)

    def candidates(self) -> list[str]:
        """The ports that are there and fit, the last one used first."""
        if sys.platform == "win32":
            from serial.tools.list_ports import comports

            found = [port.device for port in comports() if fnmatch.fnmatch(port.device, self.pattern)]
        else:
            found = glob.glob(self.pattern)
        return sorted(found, key=lambda port: (port != self.link.port, len(port), port))
