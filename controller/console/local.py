"""Commands that need no daemon: they start one, or look at a cell file, or simulate."""

import logging
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from controller.console import options
from controller.console.exit_codes import ExitCode
from controller.console.options import CellArgument, JsonOption, SocketOption, StateOption
from controller.daemon.address import default_socket


def serve(
    cell: CellArgument,
    state_dir: StateOption = None,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Run the daemon that owns the cell, until Ctrl-C or SIGTERM. Nothing moves before Start.

    Example: truecell serve cells/bench-block
    """
    from controller.daemon.reports import reporter
    from controller.daemon.serve import serve as serve_engine
    from controller.service import build_engine

    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    folder, address = options.state_folder(cell, state_dir), socket or default_socket()
    engine, store = build_engine(cell, folder)

    def ready() -> None:
        state = engine.status()["state"]
        if as_json:
            options.print_json({"socket": str(address), "state_dir": str(folder), "state": state})
        else:
            typer.echo(f"Serving {cell} at {address}, now {state}. Ctrl-C ends it.")
        sys.stdout.flush()

    with store:
        ended_well = serve_engine(engine, store, address, reporter(store, folder / "reports"), ready)
    raise typer.Exit(ExitCode.OK if ended_well else ExitCode.DEFECT)


def check(cell: CellArgument, as_json: JsonOption = False) -> None:
    """Find all mistakes in a cell file, each with its line. Opens no device.

    Example: truecell check cells/bench-block
    """
    from controller.cellfile import check_cell, format_mistakes

    mistakes = check_cell(cell)
    if as_json:
        keys = ("file", "line", "key", "value", "problem", "remedy")
        found = [{key: getattr(mistake, key) for key in keys} for mistake in mistakes]
        options.print_json({"mistakes": found})
    elif mistakes:
        typer.echo(format_mistakes(mistakes), err=True)
    else:
        typer.echo(f"{cell}: no mistakes")
    raise typer.Exit(ExitCode.BAD_INPUT if mistakes else ExitCode.OK)


def plan(
    cell: CellArgument,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Also predict the uncertainty that each plan would reach.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Show what the job would measure, phase by phase. Opens no device.

    Example: truecell plan cells/bench-block --dry-run
    """
    from controller.dry_run import plan_job

    phases: list[dict[str, Any]] = plan_job(cell, predict=dry_run)
    if as_json:
        options.print_json({"phases": phases})
        return
    from rich.table import Table

    from controller.console import show

    columns = list(phases[0]) if phases else []
    table = Table(*(column.replace("_", " ") for column in columns), box=None, pad_edge=False)
    for phase in phases:
        table.add_row(*("" if phase[column] is None else str(phase[column]) for column in columns))
    show.console().print(table)


def simulate(context: typer.Context, cell: CellArgument) -> None:
    """Run the simulated devices of a cell, until Ctrl-C. Further options go to the simulators.

    Example: truecell simulate cells/bench-block --seed 7
    """
    folder = cell if cell.is_dir() else cell.parent
    command = [sys.executable, "-m", "simulators", str(folder), *context.args]
    with subprocess.Popen(command) as simulators:
        try:
            code = simulators.wait()
        except KeyboardInterrupt:  # the terminal has sent it to the simulators as well
            code = simulators.wait()
    raise typer.Exit(code if code >= 0 else ExitCode.INTERRUPTED)


def demo(
    seed: Annotated[int, typer.Option("--seed", min=0, help="Which simulated cell.")] = 1,
    scenario: Annotated[
        str,
        typer.Option(
            "--scenario",
            help="honest, bumped-laser, noisy-joint, cable-pulled, part-missing or tight-limit.",
        ),
    ] = "honest",
    folder: Annotated[
        Path | None,
        typer.Option("--folder", help="Where to keep cell, store and report. Default: truecell-demo."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Run the whole job against simulated devices. The result is compared with the simulated truth.

    Example: truecell demo --seed 7 --scenario bumped-laser
    """
    from controller.demo import run_demo

    raise typer.Exit(run_demo(seed, scenario, folder, as_json))


def add_to(app: typer.Typer) -> None:
    """Register the commands above."""
    app.command()(demo)
    app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})(simulate)
    for command in (check, plan, serve):
        app.command()(command)
