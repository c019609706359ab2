"""The report says what the records say, in whole words and honest digits, whatever the state of the run."""

import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from lxml import etree
from lxml import html as lxml_html

from controller.report import ReportPaths, write_report
from controller.report.model import Records, report_of
from controller.report.view import Budget, Report
from controller.store import LINKS_EVENT, Store
from estimation.errors import StoreError
from tests.controller.report import runs

MADE_UTC_S = runs.STARTED_UTC_S + 9000.123456


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(tmp_path / "cell.db", durable=False, clock=runs.StepClock()) as store:
        yield store


def view(store: Store, run: int) -> Report:
    records = Records(
        run=store.run(run),
        results=store.results(run),
        samples=store.samples(run, include_excluded=True),
        events=store.events(),
        first_bad_event=store.verify_chain(),
    )
    return report_of(records, MADE_UTC_S)


def written(store: Store, run: int, folder: Path, pdf: bool = False) -> tuple[ReportPaths, str]:
    paths = write_report(store, run, folder, MADE_UTC_S, pdf=pdf)
    return paths, paths.html.read_text()


def words_of(page: str) -> str:
    root = lxml_html.document_fromstring(page)
    for style in root.iter("style"):
        style.text = ""
    return " ".join(" ".join(root.itertext()).split())


def mixed(store: Store) -> int:
    return runs.whole(store, runs.MIXED)


@pytest.mark.parametrize("make", [runs.whole, mixed, runs.held, runs.begin], ids=lambda make: make.__name__)
def test_page_needs_nothing_from_elsewhere(
    store: Store, tmp_path: Path, make: Callable[[Store], int]
) -> None:
    _, page = written(store, make(store), tmp_path)
    root = lxml_html.document_fromstring(page, parser=lxml_html.HTMLParser(recover=False))
    loaded = [
        value
        for element in root.iter(etree.Element)
        for name, value in element.attrib.items()
        if name.rpartition("}")[2].removeprefix("xlink:") in ("src", "href", "data", "action", "srcset")
    ]
    assert all(value.startswith("#") for value in loaded)
    assert "url(http" not in page and "@import" not in page
    assert not list(root.iter("script", "link", "iframe", "img", "object"))
    ids = [element.get("id") for element in root.iter(etree.Element) if element.get("id")]
    assert len(ids) == len(set(ids))
    for svg in re.findall(r"<svg.*?</svg>", page, re.DOTALL):
        etree.fromstring(svg)


def test_whole_run(store: Store, tmp_path: Path) -> None:
    paths, page = written(store, runs.whole(store), tmp_path / "new" / "folder")
    text = words_of(page)
    assert paths == ReportPaths(tmp_path / "new" / "folder" / "run-1.html", None)
    assert "All 6 phases passed, 5 characteristics proven to conform" in text
    badges = set(lxml_html.document_fromstring(page).xpath("//span[contains(@class,'badge')]/text()"))
    assert badges == {"OK"}
    assert "Hand-eye known to U = 0.262 mm, limit 0.400 mm." in text
    assert "no movement of the laser beyond its uncertainty" in text
    assert "method of ISO 14253-1" in text
    assert "Have that axis or sensor looked at" not in text  # remedy of a phase that passed


def test_simulated_banner_only_on_simulated_runs(store: Store, tmp_path: Path) -> None:
    _, simulated = written(store, runs.whole(store), tmp_path)
    _, real = written(store, runs.whole(store, simulated=False), tmp_path)
    assert "Simulated run: every reading came from a simulated cell." in words_of(simulated)
    assert "imulated" not in words_of(real)


def test_values_are_rounded_with_their_uncertainty(store: Store) -> None:
    report = view(store, runs.whole(store))
    hand_eye, inspect = report.phases[1], report.phases[5]
    laser = next(table for table in hand_eye.estimates if table.title == "Laser on the flange")
    assert laser.rows[0] == ("x", "81.23", "0.12", "0.25", "mm")
    assert laser.rows[1] == ("y", "\u22121.12", "0.10", "0.20", "mm")  # u = 0.0996
    assert laser.rows[3] == ("rx", "0.465", "0.012", "0.024", "deg")
    c1, c3 = inspect.characteristics[0], inspect.characteristics[2]
    assert (c1.nominal, c1.limits, c1.value, c1.expanded_u) == ("30.00", "29.90 … 30.10", "30.0126", "0.0196")
    assert (c3.datums, c3.limits, c3.value, c3.expanded_u) == (
        "top | left | front",
        "≤ 0.30",
        "0.142",
        "0.082",
    )
    assert c1.probability == "> 99.99 %"


def test_each_characteristic_has_its_own_verdict(store: Store, tmp_path: Path) -> None:
    run = mixed(store)
    report = view(store, run)
    assert report.outcome == "NotOK"
    assert report.headline == (
        "2 of 5 characteristics proven to conform; proven not to conform: C2, C4; not decidable: C3"
    )
    _, page = written(store, run, tmp_path)
    lines = lxml_html.document_fromstring(page).xpath("//div[contains(@class,'inspection')]//tbody/tr")
    verdicts = [line.xpath(".//span[contains(@class,'badge')]/text()")[0] for line in lines]
    assert verdicts == ["OK", "NotOK", "NotDecidable", "NotOK", "OK"]
    assert all(len(line.xpath(".//*[local-name()='svg']")) == 1 for line in lines)


def test_held_run_names_reason_and_remedy(store: Store, tmp_path: Path) -> None:
    run = runs.held(store)
    report = view(store, run)
    assert (report.outcome, report.headline) == (
        "NotDecidable",
        "Decided by phase hand-eye; 4 of 6 phases not performed",
    )
    assert [row[2] for row in report.overview.rows] == ["OK", "NotDecidable", "–", "–", "–", "–"]
    _, page = written(store, run, tmp_path)
    text = words_of(page)
    assert "Remedy: Reduce kinematics, or raise the limit." in text
    assert "Attempt 1, " in text and "0.52 mm" in text
    assert "Ended not ended" in text
    assert ("expanded uncertainty", "0.471", "0.400") in [row[:3] for row in report.phases[1].proofs.rows]  # type: ignore[union-attr]


def test_every_measurement_is_accounted_for(store: Store) -> None:
    report = view(store, runs.held(store))
    table = next(table for table in report.provenance if table.title == "Measurements")
    first = table.rows[1]
    assert first[:8] == ("hand-eye", "1", "80", "76", "1", "1", "2", "1")
    assert "1 excluded by metrologist mk: somebody leaned on the bench" in first[8]
    assert "1 retaken by operator: laser window was dirty" in first[8]
    assert "2 bad: no target in the beam" in first[8]


def test_provenance_holds_every_hash(store: Store, tmp_path: Path) -> None:
    run = runs.whole(store)
    _, page = written(store, run, tmp_path)
    text = words_of(page)
    for result in store.results(run):
        assert result.content_hash in text
    assert runs.CELL_DIGEST in text
    assert store.events()[-1].hash in text and "(intact)" in text
    assert "BAR-0417" in text


def test_incidents_are_those_of_this_run(store: Store) -> None:
    store.event("fault", "before the run", code="L4", remedy="Plug it in")
    run = runs.held(store)
    table = next(table for table in view(store, run).provenance if table.title.startswith("Faults"))
    assert [row[2] for row in table.rows] == ["Phase hand-eye: expanded uncertainty 0.52 mm, limit 0.4 mm"]


def test_links_are_those_of_the_end_of_this_run(store: Store) -> None:
    run = runs.begin(store)
    health = {"frames": 4321, "bad_frames": 7, "timeouts": 2, "reconnects": 1}
    seen = {
        "port": "COM3", "opened": 2, "broken": 1, "sent": 8, "received": 9, "late": 3,
        "answers": [0, 0, 99, 1, 0, 0, 0, 0, 0, 0, 0], "longest_answer_s": 0.0081,
    }  # fmt: skip
    store.event(LINKS_EVENT, "Links", run=run + 1, devices={"laser": health}, links={})
    store.event(LINKS_EVENT, "Links", run=run, devices={"laser": health}, links={"laser": seen})
    (table,) = (table for table in view(store, run).provenance if table.title == "Links")
    assert table.rows == (("laser", "4321", "7", "2", "1", "3", "5", "5", "8.1"),)


def test_largest_share_of_the_budget_comes_first(store: Store) -> None:
    """The store keeps keys in alphabetical order; a report orders by share."""
    phase = view(store, runs.whole(store)).phases[1]
    gated = phase.tables[0]
    assert gated.rows[0][-1] == "kinematics, 44 %"
    budget = next(picture for picture in phase.pictures if picture.key.endswith("budget")).drawing
    assert isinstance(budget, Budget)
    assert budget.bars[0] == ("kinematics", 0.44)
    assert sum(part for _, part in budget.bars) == pytest.approx(1.0)


def test_run_without_results(store: Store, tmp_path: Path) -> None:
    run = runs.begin(store)
    runs.take(store, run, "noise", 3)
    report = view(store, run)
    assert (report.outcome, report.headline) == ("Undefined", "No phase was concluded")
    assert report.overview.rows[0][3] == "Begun, 3 measurements taken, not concluded"
    paths, _ = written(store, run, tmp_path, pdf=True)
    assert paths.pdf is not None and paths.pdf.read_bytes().startswith(b"%PDF")


def test_unreadable_cell_copy_still_gives_a_report(store: Store, tmp_path: Path) -> None:
    run = runs.begin(store, text="[cell\nname = ")
    runs.noise(store, run)
    _, page = written(store, run, tmp_path)
    assert "Joints and laser repeat as declared." in words_of(page)


def test_stopped_run_is_never_a_success(store: Store) -> None:
    run = runs.begin(store)
    for phase in (runs.noise, runs.hand_eye, runs.bar_check, runs.localize, runs.part_check, runs.inspect):
        phase(store, run)
    store.close_run(run, "Stopped")
    report = view(store, run)
    assert (report.outcome, report.headline) == ("Undefined", "The run ended as Stopped, which is no success")


def test_names_and_reasons_cannot_become_markup(store: Store, tmp_path: Path) -> None:
    run = runs.begin(store, text=runs.CELL.replace("bench-block", "<script>#panic()$x^2$"))
    runs.noise(store, run)
    paths, page = written(store, run, tmp_path, pdf=True)
    assert "<script" not in page and "&lt;script&gt;#panic()$x^2$" in page
    assert paths.pdf is not None


def test_claims_nothing_that_it_must_not(store: Store, tmp_path: Path) -> None:
    _, page = written(store, runs.whole(store), tmp_path)
    text = words_of(page).lower()
    assert "what this report does not claim" in text
    assert "performs no safety function" in text
    assert "at the time of measurement only" in text
    for word in ("compliant", "certified to", "traceable", "emergency stop", "guarantee"):
        assert word not in text


def test_pdf(store: Store, tmp_path: Path) -> None:
    run = runs.whole(store)
    paths, _ = written(store, run, tmp_path, pdf=True)
    assert paths.pdf == tmp_path / "run-1.pdf"
    pdf = paths.pdf.read_bytes()
    assert pdf.startswith(b"%PDF")
    pages = max(int(count) for count in re.findall(rb"/Type\s*/Pages.*?/Count (\d+)", pdf, re.DOTALL))
    assert 2 <= pages <= 6
    again = write_report(store, run, tmp_path / "again", MADE_UTC_S)
    assert again.pdf is not None and again.pdf.read_bytes() == pdf
    assert again.html.read_bytes() == paths.html.read_bytes()
    assert not list(tmp_path.rglob("*.new"))


def test_unknown_run(store: Store, tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="No run 9"):
        write_report(store, 9, tmp_path, MADE_UTC_S)


def test_import_is_cheap() -> None:
    code = "import sys, controller.report; print({'matplotlib', 'typst', 'sqlalchemy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
