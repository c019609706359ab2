"""The report as one HTML file that needs nothing else: no script, no style or picture from elsewhere."""

from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Final

from controller.report.view import Report

if TYPE_CHECKING:
    from jinja2 import Template

TEMPLATE: Final = "report.html.j2"


def html_of(report: Report, drawn: Mapping[str, str]) -> str:
    """`drawn`: the SVG of each picture by its key."""
    from markupsafe import Markup

    return _template().render(report=report, drawn={key: Markup(svg) for key, svg in drawn.items()})


@lru_cache(maxsize=1)
def _template() -> "Template":
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("controller.report", "."),
        autoescape=True,  # names and reasons come from cell files and people
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(TEMPLATE)
