"""The plan as one HTML file that needs nothing else: table, poses in the cell, curves, budgets."""

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from controller.cellfile import Cell
from controller.dry_run import PlannedPhase, rows_of
from controller.plan_scene import scene_of

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

LEAST_SHARE: Final = 0.01  # of the variance; what is smaller is added up
DECADE: Final = np.array([1.0, 2.0, 5.0])  # ticks of a logarithmic axis
LINE: Final = "#1d5b8f"
LIMIT: Final = "#b3261e"
HEADINGS: Final = {
    "phase": "Phase",
    "measures": "Measures",
    "limit_mm": "Limit (mm)",
    "U_mm": "U predicted (mm)",
    "needs": "Measurements that meet the limit",
    "dominated_by": "With all it may take, dominated by",
    "about_s": "About (s)",
}
STYLE: Final = (
    "body{font-family:sans-serif;max-width:75rem;margin:2rem auto;padding:0 1rem;color:#1f2933}"
    "table{border-collapse:collapse;margin:1rem 0}"
    "th,td{text-align:left;padding:.3rem .8rem;border-bottom:1px solid #d5dae0;vertical-align:top}"
)


def page_of(cell: Cell, phases: Sequence[PlannedPhase]) -> str:
    """The page; it holds its own copy of the drawing library, so that it opens without a network."""
    scene, magnified = scene_of(cell, phases)
    figures = [scene]
    for phase in phases:
        figures += [_curve(phase)] if phase.plan.curve_U_m else []
        figures += [_budget(phase)] if phase.plan.worst is not None else []
    parts = [
        figure.to_html(full_html=False, include_plotlyjs=number == 0, config={"displaylogo": False})
        for number, figure in enumerate(figures)
    ]
    title = escape(f"Plan of {cell.name}{', simulated' if cell.simulated else ''}")
    ellipsoids = f" Ellipsoids are 95 %, {magnified:.0f} times enlarged." if magnified else ""
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f"<style>{STYLE}</style></head><body><h1>{title}</h1>"
        f"<p>Cell file {cell.digest[:12]}. Nothing has moved: everything lies where the cell file says. "
        f"U is the expanded uncertainty (3-D, 95 %) at the worst gated point.{ellipsoids}</p>"
        f"{_table(phases)}{''.join(parts)}</body></html>\n"
    )


def _table(phases: Sequence[PlannedPhase]) -> str:
    def row(cells: Sequence[object], tag: str) -> str:
        texts = ("" if cell is None else escape(str(cell)) for cell in cells)
        return "<tr>" + "".join(f"<{tag}>{text}</{tag}>" for text in texts) + "</tr>"

    rows = [row([line.get(key) for key in HEADINGS], "td") for line in rows_of(tuple(phases))]
    return f"<table>{row(list(HEADINGS.values()), 'th')}{''.join(rows)}</table>"


def _curve(phase: PlannedPhase) -> "Figure":
    import plotly.graph_objects as go

    values = np.array(phase.plan.curve_U_m) * 1e3
    figure = go.Figure(
        go.Scatter(
            x=np.arange(len(values)), y=values, line={"color": LINE}, name="U at the worst gated point"
        )
    )
    ends = [values.min(), values.max()]
    if phase.limit_m is not None:
        limit_mm = phase.limit_m * 1e3
        ends.append(limit_mm)
        figure.add_scatter(
            x=[0, len(values) - 1],
            y=[limit_mm, limit_mm],
            mode="lines",
            line={"color": LIMIT, "dash": "dash"},
            name=f"limit, {limit_mm:.2f} mm",
        )
    decades = 10.0 ** np.arange(np.floor(np.log10(min(ends))), np.ceil(np.log10(max(ends))) + 1)
    figure.update_layout(
        title=f"{phase.name}: uncertainty against the number of measurements",
        xaxis_title="measurements, in the order of choice",
        yaxis={"title": "U (mm, 95 %)", "type": "log", "tickvals": np.outer(decades, DECADE).ravel()},
        height=380,
        **_LOOK,
    )
    return figure


def _budget(phase: PlannedPhase) -> "Figure":
    import plotly.graph_objects as go

    worst = phase.plan.worst
    every: dict[str, float] = {} if worst is None else dict(worst.shares)
    shares = {source: share for source, share in every.items() if share >= LEAST_SHARE}
    if (others := sum(every.values()) - sum(shares.values())) >= LEAST_SHARE:
        shares["all others"] = others
    figure = go.Figure(
        go.Bar(
            x=[100.0 * share for share in shares.values()],
            y=list(shares),
            orientation="h",
            marker_color=LINE,
            text=[f"{share:.0%}" for share in shares.values()],
            textposition="outside",
            cliponaxis=False,
        )
    )
    point = "" if worst is None else f" at {worst.name}, U = {worst.U_m * 1e3:.3f} mm"
    figure.update_layout(
        title=f"{phase.name}: what makes the uncertainty{point}",
        xaxis_title="share of the variance (%)",
        yaxis={"autorange": "reversed", "automargin": True, "dtick": 1},
        height=140 + 32 * len(shares),
        **_LOOK,
    )
    return figure


_LOOK: Final[dict[str, Any]] = {
    "template": "plotly_white",
    "margin": {"l": 70, "r": 40, "t": 60, "b": 60},
    "legend": {"orientation": "h", "y": 1.08, "x": 1.0, "xanchor": "right"},
}
