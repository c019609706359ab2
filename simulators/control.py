"""A Unix socket by which others let things happen to simulated devices: JSON objects, one a line."""

import contextlib
import json
import os
import socket
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from estimation.errors import CellError
from simulators.outlets import Loop
from simulators.station import Station

STATION_COMMANDS: Final = ("unplug", "plug", "silence", "restart")


class ControlSocket:
    """Answers each request, such as {"do": "unplug", "device": "laser"}, with what `do` returns."""

    def __init__(self, loop: Loop, path: Path, do: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
        self._loop, self.path, self._do = loop, path, do
        path.unlink(missing_ok=True)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(_short(path))
        self._listener.listen()
        self._listener.setblocking(False)
        loop.watch(self._listener, self._accept)

    def close(self) -> None:
        """Take no more requests."""
        self._listener.close()
        self.path.unlink(missing_ok=True)

    def _accept(self) -> None:
        connection, _ = self._listener.accept()
        connection.settimeout(1.0)
        stream = connection.makefile("rwb")

        def answer() -> None:
            line = b""
            with contextlib.suppress(OSError):
                line = stream.readline()
            if not line:
                self._loop.forget(connection)
                stream.close()
                connection.close()
                return
            with contextlib.suppress(OSError):
                stream.write(json.dumps(self._answer(line)).encode() + b"\n")
                stream.flush()

        self._loop.watch(connection, answer)

    def _answer(self, line: bytes) -> dict[str, Any]:
        try:
            return {"ok": True, **self._do(json.loads(line))}
        except (CellError, ValueError, KeyError, TypeError, OSError) as error:
            return {"ok": False, "error": f"{type(error).__name__}: {error}"}


def happen(stations: Mapping[str, Station], request: Mapping[str, Any]) -> None:
    """Carry out one of STATION_COMMANDS at the device that the request names. Raises ValueError."""
    name = request["device"]
    if name not in stations:
        raise ValueError(f"{name!r} is not one of {', '.join(stations)}")
    station = stations[name]
    match request["do"]:
        case "unplug":
            station.unplug()
        case "plug":
            station.plug(request.get("port"))
        case "silence":
            station.silence(float(request["seconds"]))
        case "restart":
            station.restart()


def _short(path: Path) -> str:
    """A Unix socket's path has room for about 100 characters only."""
    relative = os.path.relpath(path)
    return relative if len(relative) < len(str(path)) else str(path)
