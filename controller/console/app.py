"""`truecell`: every command, and the one place where errors become messages and exit codes."""

import json
import os
import sys
import traceback
from typing import Annotated, NoReturn

import typer

from controller.console import commands, local
from controller.console.exit_codes import ExitCode
from estimation.errors import CellError, CellFileError, IllegalTransition

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # plain help comes in half the time
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"truecell {version('truecell')}")
        raise typer.Exit


@app.callback()
def _main(
    _version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Show the version.")
    ] = False,
) -> None:
    """Calibrate, localize and inspect with a robot cell, and go on only when the accuracy is proven.

    This software claims no safety function: its stop is a request. Exit codes: docs/console.md.
    """


local.add_to(app)
commands.add_to(app)


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run one command and end the process with its exit code (an ExitCode)."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        app(args=arguments, prog_name="truecell")
    except CellError as error:
        _refuse(error, _code_of(error), "--json" in arguments)
    except KeyboardInterrupt:
        sys.exit(ExitCode.INTERRUPTED)
    except BrokenPipeError:  # the reader, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(ExitCode.OK)
    except Exception as error:
        if os.environ.get("TRUECELL_DEBUG"):
            traceback.print_exc()
        problem = f"Unexpected defect: {type(error).__name__}: {error}"
        remedy = "Set TRUECELL_DEBUG=1, run it again and report what it prints"
        _refuse(CellError(problem, remedy), ExitCode.DEFECT, "--json" in arguments)
    sys.exit(ExitCode.OK)


def _code_of(error: CellError) -> ExitCode:
    match getattr(error, "code", None), error:
        case ExitCode() as code, _:
            return code
        case _, CellFileError():
            return ExitCode.BAD_INPUT
        case _, IllegalTransition():
            return ExitCode.REFUSED
        case _:
            return ExitCode.FAULT


def _refuse(error: CellError, code: ExitCode, as_json: bool) -> NoReturn:
    if as_json:
        typer.echo(json.dumps({"problem": error.problem, "remedy": error.remedy, "exit_code": int(code)}))
    else:
        typer.echo(str(error), err=True)
    sys.exit(code)
