"""The page of a fit."""

import base64
import io
from typing import Final

import numpy as np

from controller.offline.fit_result import status_of, table_rows
from controller.offline.page import Figure, Page, PageTable
from estimation.shapes.automatic import Choice
from estimation.shapes.result import SurfaceFit

_MOST_DOTS: Final = 20_000


def page(fit: SurfaceFit, choice: Choice | None, source: str) -> str:
    """One HTML document without references to anything outside."""
    status, reason = status_of(fit)
    columns = ("parameter", "value", "standard uncertainty", "expanded (95 %)", "unit")
    chosen = [] if choice is None else [choice.reason, *choice.others]
    return Page(
        title=f"{fit.surface} through {fit.points} points of {source}",
        status=status,
        reason=reason,
        tables=[PageTable("Parameters", columns, table_rows(fit))],
        facts=[
            f"rms {fit.rms_m * 1e3:.4g} mm, {fit.redundancy} degrees of freedom, "
            f"{len(fit.rejected)} points left out"
        ],
        notes=[*(flag.text for flag in fit.flags if not flag.spoils), *chosen],
        figures=[Figure("Residuals", _residual_plot(fit), "Distance of each point; crosses were left out.")],
    ).html()


def _residual_plot(fit: SurfaceFit) -> str:
    from matplotlib.figure import Figure as Plot

    residual_mm = fit.residuals() * 1e3
    places = np.arange(0, len(residual_mm), max(1, len(residual_mm) // _MOST_DOTS))
    plot = Plot(figsize=(9, 3.2), layout="constrained")
    left, right = plot.subplots(1, 2, width_ratios=[3, 1], sharey=True)
    left.plot(places + 1, residual_mm[places], ".", markersize=2)
    left.plot(fit.rejected + 1, residual_mm[fit.rejected], "rx")
    left.set(xlabel="point", ylabel="distance from the surface / mm")
    right.hist(residual_mm, bins=60, orientation="horizontal")
    right.set(xlabel="points")
    image = io.BytesIO()
    plot.savefig(image, format="png", dpi=110)
    encoded = base64.b64encode(image.getvalue()).decode()
    return f'<img alt="residuals" src="data:image/png;base64,{encoded}">'
