"""`truecell fit`: a surface through the points of a file."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from controller.console import options
from controller.console.exit_codes import ExitCode
from controller.console.options import JsonOption

if TYPE_CHECKING:
    from estimation.shapes.automatic import Choice
    from estimation.shapes.refusals import FitRefused
    from estimation.shapes.result import SurfaceFit


class SurfaceName(StrEnum):
    """What `--surface` takes."""

    PLANE = "plane"
    CYLINDER = "cylinder"
    SPHERE = "sphere"
    CONE = "cone"
    TORUS = "torus"
    AUTO = "auto"


class UnitName(StrEnum):
    """What `--unit` takes."""

    MM = "mm"
    M = "m"
    INCH = "inch"


def fit(
    points: Annotated[
        Path, typer.Argument(help="CSV, TXT, XYZ, PLY, or STL (its vertices).", show_default=False)
    ],
    surface: Annotated[
        SurfaceName, typer.Option("--surface", help="The kind of surface; auto tries all and says why.")
    ],
    unit: Annotated[UnitName, typer.Option("--unit", help="Of the numbers in the file; never guessed.")],
    sigma: Annotated[
        str | None,
        typer.Option(
            "--sigma",
            help='Standard deviation of a point along the normal, "0.01 mm". Default: from the residuals.',
        ),
    ] = None,
    size: Annotated[
        str | None,
        typer.Option("--size", help='Rough extent of the piece, "150 mm": a wrong unit is then refused.'),
    ] = None,
    robust: Annotated[
        bool, typer.Option("--robust", help="Leave out outliers, at most 10 % of the points.")
    ] = False,
    report: Annotated[
        Path | None, typer.Option("--report", help="Write a page (HTML) with a plot of the residuals.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Fit a surface to points by least squares of the distances, with its uncertainty. Opens no device.

    Example: truecell fit docs/examples/cylinder.csv --surface cylinder --unit mm
    """
    from controller.offline.fit_result import document, status_of
    from controller.offline.points import read_points
    from estimation.shapes.automatic import fit_any
    from estimation.shapes.fit import fit_surface
    from estimation.shapes.refusals import FitRefused

    sigma_m = None if sigma is None else _positive(sigma, "--sigma")
    size_m = None if size is None else _positive(size, "--size")
    choice = None
    with options.working(f"reading {points.name}") as say:
        points_m = read_points(points, unit.value, size_m)
        say(f"fitting {len(points_m)} points")
        try:
            if surface is SurfaceName.AUTO:
                choice = fit_any(points_m, sigma_m, robust)
                found = choice.fit
            else:
                found = fit_surface(surface.value, points_m, sigma_m, robust)
        except FitRefused as refusal:
            _refuse(refusal, surface.value, as_json)
        if report is not None:
            from controller.offline.fit_page import page

            say("drawing")
            options.write_file(report, page(found, choice, points.name), "--report")
    if as_json:
        options.print_json(document(found, choice))
    else:
        _print(found, choice)
    status, _ = status_of(found)
    raise typer.Exit(ExitCode.OK if status == "usable" else ExitCode.NOT_DECIDABLE)


def _positive(text: str, option: str) -> float:
    """Metres. Raises BadInput for a bare number, another dimension, or nothing positive."""
    from controller import quantities
    from controller.offline.refusal import BadInput

    try:
        value = quantities.parse(text, quantities.LENGTH)
    except quantities.QuantityError as error:
        raise BadInput(f"{option}: {error.problem}", error.remedy) from error
    if value <= 0.0:
        raise BadInput(f"{option}: {text} is not above zero", 'Write for example "0.01 mm"')
    return value


def _refuse(refusal: "FitRefused", surface: str, as_json: bool) -> NoReturn:
    if as_json:
        content = {
            "surface": surface,
            "status": "refused",
            "reason": str(refusal),
            "cause": str(refusal.cause),
            "problem": refusal.problem,
            "remedy": refusal.remedy,
            "exit_code": int(ExitCode.NOT_DECIDABLE),
        }
        options.print_json(content)
    else:
        typer.echo(str(refusal), err=True)
    raise typer.Exit(ExitCode.NOT_DECIDABLE)


def _print(found: "SurfaceFit", choice: "Choice | None") -> None:
    import numpy as np

    from controller.console.show import console, table_of
    from controller.offline.fit_result import status_of, table_rows

    keys = ("parameter", "value", "u", "U (95 %)", "unit")
    console().print(table_of([dict(zip(keys, row, strict=True)) for row in table_rows(found)]))
    origin = "stated" if np.isinf(found.dof) else "of the residuals"
    sigma = "" if found.sigma_m is None else f", sigma {found.sigma_m * 1e3:.4g} mm ({origin})"
    typer.echo(
        f"{found.surface}: {found.points} points, rms {found.rms_m * 1e3:.4g} mm, "
        f"{found.redundancy} degrees of freedom{sigma}"
    )
    if choice is not None:
        typer.echo(f"Chosen: {choice.reason}. Not chosen: {'; '.join(choice.others)}.")
    status, reason = status_of(found)
    for flag in (flag for flag in found.flags if not flag.spoils):  # the others are the status
        typer.echo(f"Note: {flag.text}.")
    typer.echo(f"Status: {status}{f': {reason}' if reason else ''}")
