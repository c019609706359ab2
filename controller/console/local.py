"""Commands that need no daemon: they start one, or look at a cell file, or simulate."""

import gc
import logging
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from controller.console import options
from controller.console.devices import devices
from controller.console.estimate import estimate
from controller.console.exit_codes import ExitCode
from controller.console.fit import fit
from controller.console.options import CellArgument, JsonOption, SocketOption, StateOption
from controller.console.plan_files import write_plan
from controller.console.verify import verify
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

    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(levelname)s %(message)s")
    logging.getLogger("controller").setLevel(logging.INFO)  # the audit trail; libraries tell of themselves
    folder, address = options.state_folder(cell, state_dir), socket or default_socket()
    engine, store = build_engine(cell, folder)
    gc.collect()
    gc.freeze()  # collections of garbage leave out what is there already: they would last longer than a SYNC

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
    """Find all mistakes in a cell file, each with its line, and limits that cannot be met. Opens no device.

    Example: truecell check cells/bench-block
    """
    from controller.cellfile import check_cell, format_mistakes
    from controller.planning.feasibility import limit_mistakes

    mistakes = check_cell(cell, feasibility=limit_mistakes)
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
    phase: Annotated[
        str | None, typer.Argument(metavar="[PHASE]", help="Show this phase only.", show_default=False)
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="List every step in order instead of a line for each phase."),
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            metavar="FOLDER",
            help="Write plan.json, plan.html (3-D, needs no network) and, where the robot has a language "
            "of its own, a program that drives through the poses.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Show what the job would measure, phase by phase, with the predicted uncertainty U. Opens no device.

    U is the expanded uncertainty (3-D, 95 %) at the worst gated point, in mm; "needs" is how many of the
    measurements meet the limit already, and "dominated by" what is left when all allowed ones are taken.
    Poses of later phases follow from what earlier ones find: here everything lies where the cell file says.
    A limit that cannot be met is named on standard error, with exit code 2.

    Example: truecell plan cells/bench-block localize --output plan
    """
    from controller.cellfile import CellFileMistakes, format_mistakes, load_cell
    from controller.dry_run import plan_job, rows_of, step_rows
    from controller.planning.feasibility import limit_mistakes
    from controller.robots import abilities_as_words, abilities_of

    loaded = load_cell(cell, feasibility=lambda part_is_right: [])
    mistakes = limit_mistakes(loaded)  # a limit that cannot be met is planned for all the same
    if any("limit" not in mistake.key for mistake in mistakes):  # nothing to plan: an object is out of reach
        raise CellFileMistakes(mistakes)
    phases = plan_job(loaded, phase)
    written = [] if output is None else write_plan(output, loaded, phases)
    rows = step_rows(phases) if dry_run else rows_of(phases)
    if as_json:
        files = {} if output is None else {"written": [str(path) for path in written]}
        robot = abilities_as_words(abilities_of(loaded.robot))
        options.print_json({"steps" if dry_run else "phases": rows, "robot": robot, **files})
    else:
        from controller.console import show

        show.console().print(show.table_of(rows))
        able = abilities_of(loaded.robot)
        typer.echo(f"Stop on request: {able.stop.value}; slows down within {able.stop_delay_s * 1e3:.0f} ms.")
        for path in written:
            typer.echo(f"Wrote {path}")
    if mistakes:
        typer.echo(format_mistakes(mistakes), err=True)
        raise typer.Exit(ExitCode.BAD_INPUT)


def simulate(
    arguments: Annotated[
        list[str] | None, typer.Argument(help="A cell, or --device NAME, or --list; and options of those.")
    ] = None,
) -> None:
    """Run the simulated devices of a cell, or one device, until Ctrl-C. Prints "ready" once it listens.

    A cell takes --seed N (another cell), --scenario NAME of world.toml, and --motion-speed FACTOR, which
    divides the time of free moves. A device alone takes --port, --set KEY=VALUE, --fault and --faults FILE;
    --list shows all devices, their settings and all faults.

    Example: truecell simulate cells/bench-block --seed 7 --motion-speed 20

    Example: truecell simulate --device optoncdt-1420 --port ./laser --fault late:0.3@5s
    """
    command = [sys.executable, "-m", "simulators", *(arguments or [])]
    os.execv(sys.executable, command)  # in place of this process, so that whoever ends one ends the other


def demo(
    seed: Annotated[
        int, typer.Option("--seed", min=0, help="Which simulated cell: all its errors are drawn from it.")
    ] = 1,
    scenario: Annotated[
        str,
        typer.Option(
            "--scenario",
            help="honest, bumped-laser, noisy-joint, cable-pulled, part-missing or tight-limit.",
        ),
    ] = "honest",
    folder: Annotated[
        Path | None,
        typer.Option(
            "--folder",
            help="Where each demo makes a folder for cell, store and report. Default: truecell-demo.",
        ),
    ] = None,
    devices: Annotated[
        list[str] | None,
        typer.Option(
            "--with",
            metavar="DEVICE",
            help="A robot, laser or probe in place of the cell's own, such as ur, keyence-il or "
            "robotiq-ft300: a file of cells/bench-block/variants. Can be repeated.",
            show_default=False,
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Run the whole job against simulated devices. The result is compared with the simulated truth.

    Example: truecell demo --seed 7 --scenario bumped-laser
    Example: truecell demo --with ur --with keyence-il --with robotiq-ft300
    """
    from controller.demo import run_demo

    raise typer.Exit(run_demo(seed, scenario, folder, as_json, devices=devices or ()))


def add_to(app: typer.Typer) -> None:
    """Register the commands above."""
    app.command()(demo)
    app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})(simulate)
    app.add_typer(devices, name="devices")
    for command in (check, plan, serve, verify, fit, estimate):
        app.command()(command)
