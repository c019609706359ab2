"""Options that several commands share, and how an answer leaves the console."""

import getpass
import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from controller.daemon.address import default_socket

if TYPE_CHECKING:
    from controller.console.client import DaemonClient

CellArgument = Annotated[
    Path, typer.Argument(help="The cell file, or a folder with a cell.toml.", show_default=False)
]
JsonOption = Annotated[bool, typer.Option("--json", help="Answer with JSON on standard output.")]
SocketOption = Annotated[
    Path | None,
    typer.Option("--socket", help="The daemon's socket. Default: $TRUECELL_SOCKET, else this user's."),
]
WhoOption = Annotated[
    str | None, typer.Option("--who", help="Who decides this. Default: the user at this computer.")
]
StateOption = Annotated[
    Path | None,
    typer.Option("--state-dir", help="Store and reports. Default: .truecell beside the cell file."),
]
RunOption = Annotated[
    int | None, typer.Option("--run", min=1, help="Number of the run. Default: the newest.")
]


@contextmanager
def daemon(address: Path | None) -> Iterator["DaemonClient"]:
    """A line to the daemon, hung up at the end."""
    from controller.console.client import DaemonClient  # httpx takes longer than --help may

    client = DaemonClient(address or default_socket())
    try:
        yield client
    finally:
        client.close()


def person(who: str | None) -> str:
    """The name that goes into the audit trail."""
    if who:
        return who
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a user without an entry, as in some containers
        return f"uid {os.getuid()}"


def state_folder(cell: Path, given: Path | None) -> Path:
    """Where the store of a cell lives."""
    return given or (cell if cell.is_dir() else cell.parent) / ".truecell"


def print_json(content: Any) -> None:
    """One JSON document on one line."""
    typer.echo(json.dumps(content))


def write_file(path: Path, text: str, option: str) -> None:
    """A file that an option names. Raises BadInput where it cannot be written."""
    from controller.offline.refusal import BadInput

    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise BadInput(
            f"{option}: {path} cannot be written ({error.strerror})", "Name a file in a folder that exists"
        ) from error


@contextmanager
def working(what: str) -> Iterator[Callable[[str], None]]:
    """A sign of life on a terminal, for what may take over a second; call it to say what comes next."""
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda _: None
        return
    with console.status(what) as status:
        yield status.update
