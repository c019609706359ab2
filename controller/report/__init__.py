"""The report of one run: the same view of the records as HTML and as PDF."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from controller.store import Store


@dataclass(frozen=True, slots=True)
class ReportPaths:
    """Where the report was written."""

    html: Path
    pdf: Path | None


def write_report(
    store: "Store", run_id: int, folder: Path, clock_utc_s: float, pdf: bool = True
) -> ReportPaths:
    """Write the report of a run, ended or not, into `folder`; an older one of the same run is replaced.

    `clock_utc_s` is printed as the time of making. Raises StoreError when there is no such run, or one of its
    records was altered; OSError when the folder cannot be written.
    """
    from controller.report.html import html_of
    from controller.report.model import Records, report_of
    from controller.report.pictures import draw

    records = Records(
        run=store.run(run_id),
        results=store.results(run_id),
        samples=store.samples(run_id, include_excluded=True),
        events=store.events(),
        first_bad_event=store.verify_chain(),
    )
    report = report_of(records, clock_utc_s)
    drawn = {picture.key: draw(picture) for picture in report.pictures()}
    folder.mkdir(parents=True, exist_ok=True)
    html_path = folder / f"run-{run_id}.html"
    _replace(html_path, html_of(report, drawn).encode())
    if not pdf:
        return ReportPaths(html_path, None)
    from controller.report.pdf import pdf_of

    pdf_path = html_path.with_suffix(".pdf")
    _replace(pdf_path, pdf_of(report, drawn, clock_utc_s))
    return ReportPaths(html_path, pdf_path)


def _replace(path: Path, content: bytes) -> None:
    """Whole or not at all: a reader never meets half a report."""
    draft = path.with_name(path.name + ".new")
    draft.write_bytes(content)
    draft.replace(path)
