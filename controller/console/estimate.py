"""`truecell estimate`: a calibration or localization from a data set."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from controller.console import options
from controller.console.exit_codes import ExitCode
from controller.console.options import JsonOption
from controller.offline.importers.names import Mounting, Program

if TYPE_CHECKING:
    from controller.offline.dataset_parts import Dataset
    from controller.offline.estimate_result import Estimate
    from controller.offline.importers.given import Given

_SAMPLES: Final = (".yaml", ".yml", ".samples", ".calib")


def estimate(
    dataset: Annotated[
        Path | None,
        typer.Argument(help="JSON after docs/datasets.md, or samples of others.", show_default=False),
    ] = None,
    csv: Annotated[
        Path | None,
        typer.Option("--csv", help="Joints and ranges as a table, for a data set that leaves them out."),
    ] = None,
    program: Annotated[
        Program | None,
        typer.Option("--from", help="Whose samples these are. Default: YAML is known by its content."),
    ] = None,
    mounting: Annotated[
        Mounting | None, typer.Option("--mounting", help="Of the sensor, where samples do not say it.")
    ] = None,
    arm_noise: Annotated[
        str | None,
        typer.Option("--arm-noise", help='Of poses of the arm in samples, "0.05 mm, 0.01 deg".'),
    ] = None,
    sensor_noise: Annotated[
        str | None,
        typer.Option("--sensor-noise", help='Of what the sensor saw: "0.3 mm, 0.05 deg"; points: "0.3 mm".'),
    ] = None,
    write: Annotated[
        Path | None, typer.Option("--write", help="Write samples as a data set in JSON, too.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--report", help="Write a page (HTML): table, residuals, budgets.")
    ] = None,
    schema: Annotated[
        str | None, typer.Option("--schema", help="Print the JSON schema of this task's data sets, and end.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Estimate where sensor, stylus or object are, with uncertainty. Opens no device.

    Example: truecell estimate docs/examples/hand-eye.json
    """
    from controller.offline.dataset import schema_of
    from controller.offline.estimate_result import USABLE, document
    from controller.offline.estimate_result import estimate as solved
    from controller.offline.importers.given import Given
    from controller.offline.refusal import BadInput

    if schema is not None:
        options.print_json(schema_of(schema))
        return
    if dataset is None:
        raise BadInput(
            "No data set is named", "Write for example truecell estimate docs/examples/hand-eye.json"
        )
    given = Given(mounting, arm_noise, sensor_noise)
    with options.working(f"reading {dataset.name}") as say:
        place = ""
        if program is not None or dataset.suffix.lower() in _SAMPLES:
            found = _imported(dataset, program, given, csv, write)
        else:
            found, place = _read(dataset, given, csv, write)
        say("estimating")
        answer = solved(found, place)
        if report is not None:
            from controller.offline.estimate_page import page

            say("drawing")
            options.write_file(report, page(answer, dataset.name), "--report")
    if as_json:
        options.print_json(document(answer))
    else:
        _print(answer)
    raise typer.Exit(ExitCode.OK if answer.status == USABLE else ExitCode.NOT_DECIDABLE)


def _imported(
    path: Path, program: Program | None, given: "Given", csv: Path | None, write: Path | None
) -> "Dataset":
    from controller.offline.dataset import as_text, dataset_of
    from controller.offline.importers.registry import imported
    from controller.offline.refusal import BadInput

    if csv is not None:
        raise BadInput("--csv goes with a data set, not with samples of another program", "Leave it out")
    content = imported(path, program, given)
    if write is not None:
        options.write_file(write, as_text(content), "--write")
    return dataset_of(content, path.name)


def _read(path: Path, given: "Given", csv: Path | None, write: Path | None) -> tuple["Dataset", str]:
    """The data set, and where its units stand."""
    from controller.offline.csv_columns import read_joints_and_ranges
    from controller.offline.dataset import read_dataset, units_at
    from controller.offline.refusal import BadInput

    if given != type(given)() or write is not None:
        raise BadInput(
            "--mounting, --arm-noise, --sensor-noise and --write go with samples of another program",
            f"{path.name} is read as a data set; give --from if it is none",
        )
    found = read_dataset(path, None if csv is None else read_joints_and_ranges(csv))
    return found, units_at(path, csv)


def _print(answer: "Estimate") -> None:
    from controller.console.show import console, table_of
    from controller.offline.estimate_result import COLUMNS, summary, table_rows

    if answer.update is not None:
        rows = [dict(zip(COLUMNS, row, strict=True)) for row in table_rows(answer)]
        console().print(table_of(rows))
        typer.echo(summary(answer))
    for note in answer.notes:
        typer.echo(f"Note: {note}")
    typer.echo(f"Status: {answer.status}{f': {answer.reason}' if answer.reason else ''}")
