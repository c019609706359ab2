"""The page of an estimate."""

from typing import Final

import numpy as np

from controller.offline.estimate_result import COLUMNS, Estimate, budget_shares, summary, table_rows
from controller.offline.page import Figure, Page, PageTable
from controller.report.pictures import draw
from controller.report.view import Budget, Picture, Residuals
from estimation.solver import Update

_MOST_ROWS: Final = 1_500  # drawn; a picture with more says no more, and the page grows
_MOST_BARS: Final = 8


def page(found: Estimate, source: str) -> str:
    """One HTML document without references to anything outside."""
    title = f"{found.task} from {source}"
    if found.update is None:
        return Page(title=title, status=found.status, reason=found.reason).html()
    return Page(
        title=title,
        status=found.status,
        reason=found.reason,
        tables=[PageTable("Parameters", COLUMNS, table_rows(found))],
        facts=[summary(found)],
        notes=found.notes,
        figures=[_residuals(found.update), *_budgets(found)],
    ).html()


def _residuals(update: Update) -> Figure:
    values, rows = update.standardised, np.arange(len(update.standardised))
    if len(values) > _MOST_ROWS:  # the largest, and a sample of the others
        worst = np.argsort(np.abs(values))[-_MOST_ROWS // 10 :]
        spread = np.linspace(0, len(values) - 1, _MOST_ROWS - len(worst)).astype(np.intp)
        rows = np.union1d(worst, spread)
    drawn = draw(Picture("residuals", Residuals(tuple(values[rows].tolist())), "Residuals", ""))
    left_out = int(update.rejected.sum())
    caption = (
        f"Residual of each row over its standard deviation, in the order of the file; {left_out} left out."
    )
    if len(rows) < len(values):
        caption += f" {len(rows)} of {len(values)} rows are drawn, the largest among them."
    return Figure("Residuals", drawn, caption)


def _budgets(found: Estimate) -> list[Figure]:
    figures: list[Figure] = []
    for name, shares in budget_shares(found).items():
        bars = sorted(shares.items(), key=lambda item: -item[1])
        rest = sum(share for _, share in bars[_MOST_BARS:])
        drawn = tuple(bars[:_MOST_BARS]) + ((("others", rest),) if rest else ())
        picture = Picture(f"budget{len(figures)}", Budget(drawn), f"Budget of {name}", "")
        figures.append(Figure(f"Budget of {name}", draw(picture), "Share of the variance by source."))
    return figures
