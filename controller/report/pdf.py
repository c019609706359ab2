"""The report as PDF, typeset by typst from the same view; its fonts come with the libraries, none from the system."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.resources import files
from typing import Final

from controller.report.pictures import COLOURS, font_folder
from controller.report.view import Report

TEMPLATE: Final = "report.typ"


def pdf_of(report: Report, drawn: Mapping[str, str], clock_utc_s: float) -> bytes:
    """`drawn`: the SVG of each picture by its key. Same input, same bytes."""
    import typst

    content = json.dumps({"report": asdict(report), "drawn": dict(drawn), "colours": COLOURS})
    pdf: bytes = typst.compile(
        (files("controller.report") / TEMPLATE).read_bytes(),
        format="pdf",
        font_paths=[font_folder()],
        ignore_system_fonts=True,
        sys_inputs={"content": content},
        timestamp=datetime.fromtimestamp(clock_utc_s, UTC),
    )
    return pdf
