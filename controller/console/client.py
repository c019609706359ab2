"""The console's line to the daemon: HTTP over its unix socket."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import httpx

from controller.console.exit_codes import ExitCode
from estimation.errors import CellError

_REPLY_TIMEOUT_S: Final = 10.0
_REPORT_TIMEOUT_S: Final = 120.0
_SILENCE_S: Final = 3.0  # the daemon sends a sign of life every second


class ConsoleError(CellError):
    """Something for the person at the console, with the code for their script."""

    def __init__(self, code: ExitCode, problem: str, remedy: str) -> None:
        super().__init__(problem, remedy)
        self.code = code

    def __reduce__(self) -> tuple[type["ConsoleError"], tuple[ExitCode, str, str]]:
        return ConsoleError, (self.code, self.problem, self.remedy)


_CODES: Final = {404: ExitCode.BAD_INPUT, 409: ExitCode.REFUSED, 422: ExitCode.BAD_INPUT, 503: ExitCode.FAULT}


class DaemonClient:
    """One daemon. Every method raises ConsoleError: no daemon, refused, bad input."""

    def __init__(self, address: Path) -> None:
        self._address = address
        self._client = httpx.Client(
            transport=httpx.HTTPTransport(uds=str(address)),
            base_url="http://truecell",
            timeout=_REPLY_TIMEOUT_S,
            trust_env=False,  # a proxy has no business between us
        )

    def close(self) -> None:
        """Hang up."""
        self._client.close()

    def get(self, path: str, **parameters: object) -> dict[str, Any]:
        """What the daemon says at `path`; parameters that are None are left out."""
        given = {name: str(value) for name, value in parameters.items() if value is not None}
        timeout_s = _REPORT_TIMEOUT_S if path == "/report" else _REPLY_TIMEOUT_S
        with self._reachable():
            return _content(self._client.get(path, params=given, timeout=timeout_s))

    def post(self, path: str, who: str, reason: str) -> dict[str, Any]:
        """Ask the daemon to do something."""
        with self._reachable():
            return _content(self._client.post(path, json={"who": who, "reason": reason}))

    def events(self) -> Iterator[dict[str, Any]]:
        """The status, then every event until the daemon ends."""
        timeout = httpx.Timeout(_REPLY_TIMEOUT_S, read=_SILENCE_S)
        with self._reachable(), self._client.stream("GET", "/events", timeout=timeout) as stream:
            for line in stream.iter_lines():
                if line.startswith("data: "):
                    yield json.loads(line.removeprefix("data: "))

    @contextmanager
    def _reachable(self) -> Iterator[None]:
        try:
            yield
        except httpx.TimeoutException as error:
            raise ConsoleError(
                ExitCode.NO_DAEMON,
                f"The daemon at {self._address} does not answer",
                "Look at its log; if the arm moves, use the stop at the robot",
            ) from error
        except httpx.ConnectError as error:
            raise ConsoleError(
                ExitCode.NO_DAEMON,
                f"No daemon answers at {self._address}",
                "Start one with `truecell serve CELL`, or name its socket with --socket",
            ) from error
        except httpx.TransportError as error:
            raise ConsoleError(
                ExitCode.NO_DAEMON,
                f"The daemon at {self._address} ended the connection",
                "Start it again with `truecell serve CELL`; it goes on from its last sample",
            ) from error


def _content(response: httpx.Response) -> dict[str, Any]:
    content = response.json()
    if response.is_success:
        return dict(content)
    code = _CODES.get(response.status_code, ExitCode.DEFECT)
    raise ConsoleError(code, content["problem"], content["remedy"])
