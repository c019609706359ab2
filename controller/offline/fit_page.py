"""The page of a fit: table, residuals as a picture, and what was done."""

import base64
import html
import io
from typing import Final

import numpy as np

from controller.offline.fit_result import status_of, table_rows
from estimation.shapes.automatic import Choice
from estimation.shapes.result import SurfaceFit

_MOST_DOTS: Final = 20_000


def page(fit: SurfaceFit, choice: Choice | None, source: str) -> str:
    """One HTML document without references to anything outside."""
    status, reason = status_of(fit)
    head = "<tr><th>parameter</th><th>value</th><th>standard</th><th>expanded 95 %</th><th>unit</th></tr>"
    rows = "".join(
        "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in table_rows(fit)
    )
    notes = [flag.text for flag in fit.flags] + ([] if choice is None else [choice.reason, *choice.others])
    return (
        "<!doctype html><html lang=en><meta charset=utf-8>"
        f"<title>{html.escape(source)}: {fit.surface}</title>"
        "<style>body{font-family:sans-serif;max-width:60rem;margin:2rem auto}"
        "td,th{padding:.2rem .8rem;text-align:left}</style>"
        f"<h1>{html.escape(fit.surface)} through {fit.points} points of {html.escape(source)}</h1>"
        f"<p>Status: {status}{'. ' + html.escape(reason) if reason else ''}</p><table>{head}{rows}</table>"
        f"<p>rms {fit.rms_m * 1e3:.4g} mm, {fit.redundancy} degrees of freedom, "
        f"{len(fit.rejected)} left out</p>"
        + "".join(f"<p>{html.escape(note)}</p>" for note in notes)
        + f'<img alt="residuals" src="data:image/png;base64,{_residual_plot(fit)}">'
    )


def _residual_plot(fit: SurfaceFit) -> str:
    from matplotlib.figure import Figure

    residual_mm = fit.residuals() * 1e3
    places = np.arange(0, len(residual_mm), max(1, len(residual_mm) // _MOST_DOTS))
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[3, 1], sharey=True)
    left.plot(places + 1, residual_mm[places], ".", markersize=2)
    left.plot(fit.rejected + 1, residual_mm[fit.rejected], "rx")
    left.set(xlabel="point", ylabel="distance from the surface / mm")
    right.hist(residual_mm, bins=60, orientation="horizontal")
    right.set(xlabel="points")
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=110)
    return base64.b64encode(image.getvalue()).decode()
