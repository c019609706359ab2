"""Copies of the bench-block cell: with other devices, and on ports of their own."""

import re
import shutil
import socket
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from estimation.errors import CellFileError

BENCH_BLOCK: Final = Path(__file__).parents[1] / "cells" / "bench-block"
_PORT: Final = re.compile(r"^((?:\w+_)?port = )\d+", re.MULTILINE)
_HEAD: Final = re.compile(r"\[(\w+)\]\n")


def copy_bench_block(folder: Path, devices: Iterable[str] = ()) -> Path:
    """Copy the cell, with these variants in place of its own devices; returns its cell file.

    TCP ports are free ones, so that cells do not meet. Raises CellFileError for a variant that is not there.
    """
    shutil.copytree(
        BENCH_BLOCK,
        folder,
        ignore=shutil.ignore_patterns("run", ".truecell", "__pycache__"),
        dirs_exist_ok=True,
    )
    cell_file = folder / "cell.toml"
    text = cell_file.read_text()
    for name in devices:
        text = with_device(text, name)
    cell_file.write_text(_on_free_ports(text))
    return cell_file


def variants() -> list[str]:
    """Names of the devices that can stand in the place of the cell's own."""
    return sorted(path.stem for path in (BENCH_BLOCK / "variants").glob("*.toml"))


def with_device(text: str, name: str) -> str:
    """A cell file with the table of a variant in place of its own; subtables such as the mount stay."""
    if name not in variants():
        raise CellFileError(f"No device {name!r} for the demo", f"Choose one of {', '.join(variants())}")
    table = (BENCH_BLOCK / "variants" / f"{name}.toml").read_text()
    head = _HEAD.match(table)
    if head is None:
        raise CellFileError(
            f"Variant {name} begins with no table", "Begin it with [robot], [laser] or [probe]"
        )
    start = text.index(head[0])
    end = re.compile(r"^[#\[]", re.MULTILINE).search(text, start + len(head[0]))
    return text[:start] + table + "\n" + (text[end.start() :] if end else "")


def _on_free_ports(text: str) -> str:
    """Every TCP port of the text replaced by a free one of this computer."""
    sockets = list[socket.socket]()

    def free(match: re.Match[str]) -> str:
        sockets.append(socket.create_server(("127.0.0.1", 0)))  # kept open, so that no port comes twice
        return f"{match[1]}{sockets[-1].getsockname()[1]}"

    try:
        return _PORT.sub(free, text)
    finally:
        for used in sockets:
            used.close()
