"""Where the daemon listens: a unix socket whose folder only its owner may enter."""

import os
import socket
import stat
import tempfile
from pathlib import Path
from typing import Final

from estimation.errors import CellError

VARIABLE: Final = "TRUECELL_SOCKET"
_LONGEST_PATH: Final = 107  # bytes, sockaddr_un of Linux


def default_socket() -> Path:
    """$TRUECELL_SOCKET, else daemon.sock in a folder of this user."""
    if named := os.environ.get(VARIABLE):
        return Path(named)
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(runtime) / "truecell" / "daemon.sock"
    return Path(tempfile.gettempdir()) / f"truecell-{os.getuid()}" / "daemon.sock"


def listen(path: Path) -> socket.socket:
    """A bound socket at `path`, in a folder of mode 0700; replaces what a dead daemon left there.

    Raises CellError: another daemon answers there, or the folder is open to others.
    """
    path = path.absolute()
    if len(os.fsencode(path)) > _LONGEST_PATH:
        raise CellError(
            f"Socket path {path} has {len(os.fsencode(path))} bytes, limit {_LONGEST_PATH}",
            "Give a shorter --socket",
        )
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        _require_private(path.parent)
        _remove_dead(path)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            listener.bind(str(path))
            path.chmod(0o600)
        except OSError:
            listener.close()
            raise
    except OSError as error:
        raise CellError(f"Cannot listen at {path}: {error.strerror}", "Give another --socket") from error
    return listener


def _require_private(folder: Path) -> None:
    """Who may enter the folder may command the robot."""
    found = folder.stat()
    mode = stat.S_IMODE(found.st_mode)
    if found.st_uid != os.getuid() or mode & 0o077:
        raise CellError(
            f"Socket folder {folder} has mode {mode:04o} and owner {found.st_uid}, "
            f"needed 0700 and {os.getuid()}",
            f"Run `chmod 700 {folder}`, or give --socket in a folder of your own",
        )


def _remove_dead(path: Path) -> None:
    if not path.exists():
        return
    if not path.is_socket():
        raise CellError(f"{path} exists and is no socket", "Give another --socket")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()
            return
    raise CellError(f"A daemon already answers at {path}", "Use that one, or give another --socket")
