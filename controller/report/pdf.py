"""The report as PDF, typeset by typst from the same view with fonts of the libraries, none of the system."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.resources import files
from typing import Any, Final

from controller.report.pictures import COLOURS, font_folder
from controller.report.view import Report

TEMPLATE: Final = "report.typ"
HEAD_ROWS: Final = 2  # height of a table's title and headings, in rows


def in_columns(tables: Sequence[dict[str, Any]], count: int = 3) -> list[list[dict[str, Any]]]:
    """Tables side by side in about equal columns, in their order; typst would fill the first column alone."""
    heights = [len(table["rows"]) + HEAD_ROWS for table in tables]
    columns: list[list[dict[str, Any]]] = [[] for _ in range(count)]
    total, above = sum(heights), 0
    for table, height in zip(tables, heights, strict=True):
        columns[min(count - 1, count * above // total)].append(table)
        above += height
    return columns


def pdf_of(report: Report, drawn: Mapping[str, str], clock_utc_s: float) -> bytes:
    """`drawn`: the SVG of each picture by its key. Same input, same bytes."""
    import typst

    view = asdict(report)
    for phase in view["phases"]:
        phase["estimates"] = in_columns(phase["estimates"])
    content = json.dumps({"report": view, "drawn": dict(drawn), "colours": COLOURS})
    return typst.compile(
        (files("controller.report") / TEMPLATE).read_bytes(),
        format="pdf",
        font_paths=typst.Fonts(include_system_fonts=False, font_paths=[font_folder()]),
        sys_inputs={"content": content},
        timestamp=datetime.fromtimestamp(int(clock_utc_s), UTC),  # typst refuses fractions
    )
