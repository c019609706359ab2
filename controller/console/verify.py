"""`truecell verify`: does the estimator claim what it can keep?"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from controller.console import options
from controller.console.exit_codes import ExitCode
from controller.console.options import JsonOption

if TYPE_CHECKING:
    from controller.verify.replicas import Proof
    from estimation.proof.coverage import Coverage

_LEGEND: Final = """\
inside: share of cells whose truth lies in the stated 95 % region. proven: what the count
proves of it, with 95 %. NEES/m: mean squared error over covariance and freedoms. honest:
where that of an honest estimator lies, with 99.9 %."""
_REPLICAS_LEGEND: Final = """\
u: predicted along the axis known worst. ends off: the 95 % interval of the replicas against
that of the linear result. The stopping rule is that of JCGM 101, 7.9.4, for one digit of u;
a block is {block} replicas of the whole estimator, not the guide's 10,000."""


def verify(
    cell: Annotated[
        Path | None,
        typer.Argument(help="A cell file or its folder. Without it, random cells.", show_default=False),
    ] = None,
    cells: Annotated[int, typer.Option("--cells", min=20, help="How many random cells.")] = 500,
    most: Annotated[
        int, typer.Option("--most", min=400, help="Most replicas of CELL, if they do not settle before.")
    ] = 20_000,
    seed: Annotated[int, typer.Option("--seed", min=0, help="First random cell, or seed of replicas.")] = 1,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, help="Processes. Default: one for each core.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", help="A Dask cluster instead of this computer: tcp://host:8786."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Count how often the stated 95 % regions hold the simulated truth. Opens no device.

    Without CELL: over random cells, each with its own geometry, uncertainties, poses and errors. With CELL:
    over replicas of its own plan, with every error drawn from what the cell file declares, until the figures
    settle; errors that it does not declare are not in them. Exit code 5 if more is claimed than is kept.

    Example: truecell verify --cells 5000, or truecell verify cells/bench-block
    """
    from controller.verify.executor import open_executor

    with open_executor(scheduler, workers) as executor, _progress(as_json) as show:
        if cell is None:
            from controller.verify.random_cells import cover

            tasks = cover(executor, seed, cells, lambda done: show(done, f"{done} of {cells} cells", cells))
            proofs: Sequence[Proof] = ()
        else:
            from controller.verify.replicas import prove

            proofs = prove(
                cell.resolve(),
                executor,
                seed,
                most,
                lambda done, left: show(
                    done, f"{done} replicas, unsettled by {left:.1f} of the tolerance", None
                ),
            )
            tasks = {f"{proof.quantity.phase}, {proof.quantity.point}": proof.coverage for proof in proofs}
    if as_json:
        options.print_json(_document(seed, tasks, proofs))
    else:
        _print_tables(tasks, proofs)
    too_much = any(coverage.verdict == "claims too much" for coverage in tasks.values())
    raise typer.Exit(ExitCode.NOT_OK if too_much else ExitCode.OK)


def coverage_rows(tasks: dict[str, "Coverage"]) -> list[dict[str, str]]:
    """One row for each task, as people read it."""
    rows = []
    for name, coverage in tasks.items():
        low_share, high_share = coverage.bounds()
        low, high = coverage.band()
        rows.append(
            {
                "estimate": name,
                "cells": str(coverage.cells),
                "refused": str(coverage.refused),
                "inside %": f"{100 * coverage.share:.1f}",
                "proven %": f"{100 * low_share:.1f}-{100 * high_share:.1f}",
                "NEES/m": f"{coverage.mean_over_dimension:.3f}",
                "honest": f"{low:.3f}-{high:.3f}",
                "verdict": coverage.verdict,
            }
        )
    return rows


def _proof_rows(proofs: Sequence["Proof"]) -> list[dict[str, Any]]:
    return [
        {
            "estimate": f"{proof.quantity.phase}, {proof.quantity.point}",
            "u (mm)": f"{1e3 * proof.quantity.u_m:.4f}",
            "achieved/u": f"{proof.ratio:.3f}",
            "replicas": proof.monte_carlo.trials,
            "settled": "yes" if proof.monte_carlo.stable else "no",
            "ends off (mm)": f"{1e3 * max(proof.validation.d_low, proof.validation.d_high):.4f}",
            "allowed": f"{1e3 * proof.validation.tolerance:.4f}",
            "linear U": "validated" if proof.validation.passed else "not validated",
        }
        for proof in proofs
    ]


def _print_tables(tasks: dict[str, "Coverage"], proofs: Sequence["Proof"]) -> None:
    from controller.console.show import console, table_of

    console().print(table_of(coverage_rows(tasks)))
    typer.echo(_LEGEND)
    if proofs:
        block = proofs[0].monte_carlo.block
        typer.echo()
        console().print(table_of(_proof_rows(proofs)))
        typer.echo(_REPLICAS_LEGEND.format(block=block))


def _document(seed: int, tasks: dict[str, "Coverage"], proofs: Sequence["Proof"]) -> dict[str, Any]:
    return {
        "seed": seed,
        "estimates": [
            {
                "estimate": name,
                "freedoms": coverage.dimension,
                "cells": coverage.cells,
                "refused": coverage.refused,
                "inside": coverage.inside,
                "share": coverage.share,
                "share_bounds_95": coverage.bounds(),
                "mean_nees_over_m": coverage.mean_over_dimension,
                "band_999": coverage.band(),
                "verdict": coverage.verdict,
                "accepted": coverage.accepted,
            }
            for name, coverage in tasks.items()
        ],
        "linear_results": [
            {
                "phase": proof.quantity.phase,
                "point": proof.quantity.point,
                "predicted_u_mm": 1e3 * proof.quantity.u_m,
                "achieved_over_predicted": proof.ratio,
                "replicas": proof.monte_carlo.trials,
                "block": proof.monte_carlo.block,
                "settled": proof.monte_carlo.stable,
                "d_low_mm": 1e3 * proof.validation.d_low,
                "d_high_mm": 1e3 * proof.validation.d_high,
                "tolerance_mm": 1e3 * proof.validation.tolerance,
                "validated": proof.validation.passed,
            }
            for proof in proofs
        ],
    }


@contextmanager
def _progress(quiet: bool) -> Iterator[Callable[[int, str, int | None], None]]:
    """A bar on standard error while it is a terminal: (done, text, total or None)."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=quiet or not console.is_terminal) as bar:
        task = bar.add_task("starting", total=None)
        yield lambda done, text, total: bar.update(task, completed=done, description=text, total=total)
