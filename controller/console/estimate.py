"""`truecell estimate`: a calibration or localization from a data set."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from controller.console import options
from controller.console.exit_codes import ExitCode
from controller.console.options import JsonOption

if TYPE_CHECKING:
    from controller.offline.estimate_result import Estimate


def estimate(
    dataset: Annotated[
        Path | None, typer.Argument(help="JSON after docs/datasets.md.", show_default=False)
    ] = None,
    csv: Annotated[
        Path | None,
        typer.Option("--csv", help="Joints and ranges as a table, for a data set that leaves them out."),
    ] = None,
    schema: Annotated[
        str | None, typer.Option("--schema", help="Print the JSON schema of this task's data sets, and end.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Estimate where sensor, stylus or object are, with uncertainty. Opens no device.

    Example: truecell estimate docs/examples/hand-eye.json
    """
    from controller.offline.csv_columns import read_joints_and_ranges
    from controller.offline.dataset import read_dataset, schema_of
    from controller.offline.estimate_result import USABLE, document
    from controller.offline.estimate_result import estimate as solved
    from controller.offline.refusal import BadInput

    if schema is not None:
        options.print_json(schema_of(schema))
        return
    if dataset is None:
        raise BadInput(
            "No data set is named", "Write for example truecell estimate docs/examples/hand-eye.json"
        )
    table = None if csv is None else read_joints_and_ranges(csv)
    found = read_dataset(dataset, table)
    with _working(as_json):
        answer = solved(found)
    if as_json:
        options.print_json(document(answer))
    else:
        _print(answer)
    raise typer.Exit(ExitCode.OK if answer.status == USABLE else ExitCode.NOT_DECIDABLE)


@contextmanager
def _working(quiet: bool) -> Iterator[None]:
    """A sign of life on a terminal, for what takes over a second."""
    from rich.console import Console

    console = Console(stderr=True)
    if quiet or not console.is_terminal:
        yield
        return
    with console.status("estimating"):
        yield


def _print(answer: "Estimate") -> None:
    from controller.console.show import console, table_of
    from controller.offline.estimate_result import document, table_rows

    said = document(answer)
    if answer.update is not None:
        keys = ("parameter", "value", "u", "U (95 %)", "unit", "budget")
        console().print(table_of([dict(zip(keys, row, strict=True)) for row in table_rows(answer)]))
        checks = said["diagnostics"]
        typer.echo(
            f"{answer.task}: {checks['rows']} rows, {len(checks['rejected_rows'])} left out, rms "
            f"{said['rms_mm']:.4g} mm, {said['dof']} degrees of freedom, variance factor "
            f"{checks['variance_factor']:.3g}"
        )
    for note in answer.notes:
        typer.echo(f"Note: {note}")
    typer.echo(f"Status: {answer.status}{f': {answer.reason}' if answer.reason else ''}")
