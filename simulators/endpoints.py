"""Which devices a cell file names, and at which ports it expects them. Nothing else of the file is read."""

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from estimation.errors import CellFileError
from simulators.registry import device_kind
from simulators.station import Endpoint

DEVICES: Final = ("robot", "laser", "probe")


@dataclass(frozen=True, slots=True)
class NamedDevice:
    """One device of the cell."""

    driver: str
    endpoint: Endpoint


def read_endpoints(cell_file: Path) -> dict[str, NamedDevice]:
    """Robot, laser and probe of a cell file. Raises CellFileError."""
    try:
        content = tomllib.loads(cell_file.read_text(encoding="utf-8"))
    except OSError as error:
        raise CellFileError(f"{cell_file}: {error.strerror}", "Name a cell file, or its folder") from error
    except ValueError as error:  # not TOML, or not even UTF-8
        raise CellFileError(f"{cell_file}: {error}", "Correct the file: truecell check") from error
    return {name: _device(name, content.get(name), cell_file) for name in DEVICES}


def _device(name: str, table: Any, cell_file: Path) -> NamedDevice:
    if not isinstance(table, dict) or "driver" not in table:
        raise CellFileError(f"{cell_file} has no driver in [{name}]", "Correct the file: truecell check")
    kind = device_kind(str(table["driver"]))
    if kind.link == "tcp":
        keys = {socket: f"{socket}_port" if socket else "port" for socket in kind.sockets}
        ports = {socket: str(table[key]) for socket, key in keys.items() if key in table}
        endpoint = Endpoint(ports, str(table.get("host", "127.0.0.1")))
    else:
        endpoint = Endpoint({"": _path(name, table, cell_file)}, directory=cell_file.parent)
    return NamedDevice(kind.name, endpoint)


def _path(name: str, table: dict[str, Any], cell_file: Path) -> str:
    port = str(table.get("port", ""))
    if table.get("interface") == "socketcan":
        raise CellFileError(
            f"{cell_file}: the {name} is on SocketCAN interface {port!r}, which cannot be simulated",
            'Write interface = "slcan" with a path as port',
        )
    if not port or (port.upper().startswith("COM") and port[3:].isdigit()):
        raise CellFileError(
            f"{cell_file}: port {port!r} of the {name} cannot be simulated",
            'Write a path that does not exist yet, such as port = "run/device"',
        )
    return port
