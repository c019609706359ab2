"""`truecell devices`: what stands at the other end of the wires."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer

from controller.console import options
from controller.console.exit_codes import ExitCode
from controller.console.options import CellArgument, JsonOption, StateOption
from estimation.errors import StoreError

devices = typer.Typer(no_args_is_help=True, help="Look at the devices of a cell.")


@devices.command()
def probe(cell: CellArgument, state_dir: StateOption = None, as_json: JsonOption = False) -> None:
    """Connect to each device and show identity, live values and link; nothing moves, motors stay as they are.

    Not while a daemon serves the cell: the devices are its own. Exit code 7 if one is missing or not well.

    Example: truecell devices probe cells/bench-block
    """
    from controller.cellfile import load_cell
    from controller.devices import make_devices
    from controller.probing import probe_devices
    from controller.service import STORE_NAME
    from drivers.clock import RealClock
    from drivers.links.ports import RealPorts

    loaded, clock = load_cell(cell), RealClock()
    ports = RealPorts(loaded.directory, clock)
    made = make_devices(loaded, ports, clock, keep_alive_thread=True)
    tables = {"robot": loaded.robot, "laser": loaded.laser, "probe": loaded.probe}
    places = {role: (table.driver, _place(table)) for role, table in tables.items()}
    store = options.state_folder(cell, state_dir) / STORE_NAME
    with _alone(store), options.working("connecting") as tell:
        found = list(probe_devices(made, places, tell))
    links = made.counters()
    if as_json:
        options.print_json({"devices": [seen.as_json() for seen in found], "links": links["links"]})
    else:
        _show(found, links)
    raise typer.Exit(ExitCode.OK if all(seen.is_well for seen in found) else ExitCode.FAULT)


@contextmanager
def _alone(store: Path) -> Iterator[None]:
    """No daemon serves the cell of this store meanwhile. Raises ConsoleError naming the one that does."""
    from controller.console.client import ConsoleError
    from controller.store.lock import OwnerLock, lock_of

    if not store.parent.is_dir():  # it has never been served
        yield
        return
    try:
        lock = OwnerLock(lock_of(store), f"process {os.getpid()}, which looks at the devices")
    except StoreError as error:
        raise ConsoleError(
            ExitCode.REFUSED,
            f"A daemon has the devices of this cell: {error.problem}",
            "Ask that daemon with `truecell status --links`, or stop it",
        ) from error
    try:
        yield
    finally:
        lock.release()


def _place(table: Any) -> str:
    host = getattr(table, "host", None)
    return str(table.port) if host is None else f"{host}:{table.port}"


def _show(found: list[Any], links: Mapping[str, Any]) -> None:
    from controller.console import show

    for seen in found:
        typer.echo(f"{seen.role}: {seen.driver} at {seen.port}")
        if seen.identity is not None:
            identity = seen.identity
            told = [identity.model]
            told += [f"serial number {identity.serial_number}"] if identity.serial_number else []
            told += [f"firmware {identity.firmware}"] if identity.firmware else []
            typer.echo(f"  {', '.join(told)}")
        for name, value in seen.values.items():
            if value not in (None, ""):
                typer.echo(f"  {name.replace('_', ' ')}: {value}")
        if not seen.is_well:
            typer.echo(f"  {seen.problem}. {seen.remedy}.")
    typer.echo()
    show.console().print(show.links_table(links))
