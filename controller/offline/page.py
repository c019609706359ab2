"""One self-contained page of a fit or an estimate: table, what was done, pictures."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from jinja2 import Template

_TEMPLATE: Final = "page.html.j2"


@dataclass(frozen=True, slots=True)
class PageTable:
    """Headings, and rows of text."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class Figure:
    """A picture as SVG or as an image in the page itself."""

    title: str
    drawn: str
    caption: str


@dataclass(frozen=True, slots=True)
class Page:
    """What stands on it; everything but the drawings is text."""

    title: str
    status: str
    reason: str
    tables: Sequence[PageTable] = ()
    facts: Sequence[str] = ()
    notes: Sequence[str] = ()
    figures: Sequence[Figure] = ()

    def html(self) -> str:
        """One HTML document without references to anything outside."""
        from markupsafe import Markup

        figures: list[dict[str, Any]] = [
            {"title": each.title, "drawn": Markup(each.drawn), "caption": each.caption}
            for each in self.figures
        ]
        said = {
            name: getattr(self, name) for name in ("title", "status", "reason", "tables", "facts", "notes")
        }
        return _template().render(page={**said, "figures": figures})


@lru_cache(maxsize=1)
def _template() -> "Template":
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("controller.offline", "."),
        autoescape=True,  # names come from files
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(_TEMPLATE)
