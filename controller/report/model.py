"""From the records of one run to the report's view: no file, no clock, no picture is made here."""

import tomllib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from controller.gates import worst
from controller.link_rows import COLUMNS, NOTE, link_rows
from controller.report import words
from controller.report.phase_view import outcome_of, phase_of
from controller.report.rounding import NOTHING
from controller.report.view import Phase, Report, Table
from controller.store.records import LINKS_EVENT, Event, Result, Run, Sample
from estimation.statistics import Outcome

SHORT = 12  # leading digits by which a table refers to a hash that is printed in full elsewhere


@dataclass(frozen=True, slots=True)
class Records:
    """What the store holds about one run; samples with the excluded ones."""

    run: Run
    results: Sequence[Result]
    samples: Sequence[Sample]
    events: Sequence[Event]
    first_bad_event: int | None


def report_of(records: Records, clock_utc_s: float) -> Report:
    """The view of one run, whatever its state."""
    run, results = records.run, records.results
    cell = _cell_of(run.cell_text)
    phases = _phases(records, cell)
    outcome, headline = _overall(run, phases)
    name = str(cell.get("cell", {}).get("name", "unnamed"))
    part = str(cell.get("part", {}).get("name", NOTHING))
    return Report(
        title=f"Measurement report, run {run.id}",
        run=str(run.id),
        cell=name,
        part=part,
        outcome=outcome.value,
        headline=headline,
        simulated=words.SIMULATED + (f" Seed {run.seed}." if run.seed is not None else "")
        if run.simulated
        else "",
        header=_header(run, name, part),
        summary=_summary(records, phases, name, part),
        overview=_overview(phases),
        phases=phases,
        provenance=tuple(
            table
            for table in (
                _measurements(records),
                _results(results),
                _incidents(records),
                _links(records),
                _artefacts(cell),
            )
            if table.rows
        ),
        fingerprints=_fingerprints(records),
        disclaimers=((words.SIMULATED_DISCLAIMER,) if run.simulated else ()) + words.DISCLAIMERS,
        made=words.utc(clock_utc_s),
        notes=words.READING_NOTES,
    )


def _cell_of(text: str) -> dict[str, Any]:
    """The frozen copy of the cell file; for names only, so a copy that cannot be read is no error here."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return {}


def _phases(records: Records, cell: dict[str, Any]) -> tuple[Phase, ...]:
    """The phases of the job in order, then any that have records but do not stand in the cell file."""
    kinds = {
        str(spec.get("name")): str(spec.get("kind", "")) for spec in cell.get("job", {}).get("phases", [])
    }
    for result in records.results:
        kinds.setdefault(result.phase, str(result.result.get("kind", "")))
    for sample in records.samples:
        kinds.setdefault(sample.phase, "")
    by_phase = {name: [result for result in records.results if result.phase == name] for name in kinds}
    taken = Counter(sample.phase for sample in records.samples)
    return tuple(
        phase_of(i + 1, name, kind, by_phase[name], taken[name])
        for i, (name, kind) in enumerate(kinds.items())
    )


def _overall(run: Run, phases: Sequence[Phase]) -> tuple[Outcome, str]:
    """The worst of what was judged; a run that is not whole is never OK."""
    judged = [phase for phase in phases if phase.attempt]
    missing = len(phases) - len(judged)
    outcome = worst(outcome_of(phase.outcome) for phase in judged)
    rest = f"{missing} of {words.counted(len(phases), 'phase')} not performed" if missing else ""
    if not judged:
        return Outcome.UNDEFINED, "No phase was concluded"
    if outcome is not Outcome.OK:
        first = next(phase for phase in judged if phase.outcome == outcome.value)
        why = _of_characteristics(first) if first.characteristics else f"Decided by phase {first.name}"
        return outcome, why + (f"; {rest}" if rest else "")
    if missing:
        return Outcome.UNDEFINED, f"Not finished: {rest}"
    if run.end_state is not None and outcome_of(run.end_state) is not Outcome.OK:
        return Outcome.UNDEFINED, f"The run ended as {run.end_state}, which is no success"
    lines = [line for phase in phases for line in phase.characteristics]
    tail = f", {words.counted(len(lines), 'characteristic')} proven to conform" if lines else ""
    return Outcome.OK, f"All {words.counted(len(phases), 'phase')} passed{tail}"


def _header(run: Run, cell: str, part: str) -> tuple[tuple[str, str], ...]:
    if run.ended_utc_s is None:
        ended = "not ended"
    else:
        ended = words.utc(run.ended_utc_s) + (" (closed after a crash)" if run.clean_close is False else "")
    return (
        ("Cell", cell),
        ("Part", part),
        ("Run", str(run.id)),
        ("Started", words.utc(run.started_utc_s)),
        ("Ended", ended),
        ("End state", run.end_state or "open"),
        ("Software", f"truecell {run.software_version}"),
        ("Cell file", f"SHA-256 {run.cell_digest[:SHORT]}…"),
    )


def _summary(records: Records, phases: Sequence[Phase], cell: str, part: str) -> str:
    run = records.run
    about = "simulated part" if run.simulated else "part"
    lasted = (
        "has not ended"
        if run.ended_utc_s is None
        else f"lasted {words.lasting(run.ended_utc_s - run.started_utc_s)}"
    )
    sentences = [
        f"Run {run.id} of cell {cell} on {about} {part} began {words.utc(run.started_utc_s)} and {lasted}; "
        f"it took {words.counted(len(records.samples), 'measurement')}."
    ]
    for phase in phases:
        if phase.attempt and not phase.characteristics:
            sentences.append(f"{phase.name.capitalize()} ({phase.outcome}): {phase.message}")
    for phase in phases:
        if phase.characteristics:
            sentences.append(f"{phase.name.capitalize()} ({phase.outcome}): {_of_characteristics(phase)}.")
    if missing := [phase.name for phase in phases if not phase.attempt]:
        sentences.append(f"Not concluded: {', '.join(missing)}.")
    if remedy := next((phase.remedy for phase in phases if phase.remedy and not phase.characteristics), ""):
        sentences.append(f"Remedy: {remedy}")
    return " ".join(sentences)


def _of_characteristics(phase: Phase) -> str:
    by_outcome: dict[str, list[str]] = {}
    for line in phase.characteristics:
        by_outcome.setdefault(line.outcome, []).append(line.id)
    total = words.counted(len(phase.characteristics), "characteristic")
    conforming = by_outcome.pop(Outcome.OK.value, [])
    verbs = {
        Outcome.NOT_OK.value: "proven not to conform",
        Outcome.NOT_DECIDABLE.value: "not decidable",
    }
    others = "".join(
        f"; {verbs.get(outcome, 'undefined')}: {', '.join(ids)}" for outcome, ids in by_outcome.items()
    )
    return f"{len(conforming)} of {total} proven to conform{others}"


def _overview(phases: Sequence[Phase]) -> Table:
    rows = tuple(
        (
            str(phase.number),
            phase.name,
            phase.outcome if phase.attempt else NOTHING,
            phase.message,
            phase.measurements,
            str(phase.attempt or NOTHING),
        )
        for phase in phases
    )
    columns = ("", "Phase", "Verdict", "Finding", "Measurements", "Attempts")
    return Table("Results at a glance", columns, rows, numeric=(0, 4, 5), outcome=2)


def _measurements(records: Records) -> Table:
    groups: dict[tuple[str, int], list[Sample]] = {}
    for sample in records.samples:
        groups.setdefault((sample.phase, sample.attempt), []).append(sample)
    used = {(result.phase, result.attempt): set(result.sample_ids) for result in records.results}
    fits = {(r.phase, r.attempt): r.result.get("estimate", {}).get("fit") or {} for r in records.results}
    rows = []
    for (phase, attempt), samples in groups.items():
        ids = used.get((phase, attempt), set())
        bad = [sample for sample in samples if sample.payload.get("quality", "good") != "good"]
        without = {sample.id for sample in bad}
        rejected = fits.get((phase, attempt), {}).get("rejected")
        rows.append(
            (
                phase,
                str(attempt),
                str(len(samples)),
                str(len(ids - without)) if (phase, attempt) in used else NOTHING,
                str(sum(sample.mark == "excluded" for sample in samples)),
                str(sum(sample.mark == "retake" for sample in samples)),
                str(len(bad)),
                NOTHING if rejected is None else str(rejected),
                _reasons(samples, bad),
            )
        )
    columns = ("Phase", "Attempt", "Taken", "Usable", "Excluded", "Retaken", "Bad", "Outliers", "Reasons")
    note = (
        "Every measurement stays in the store. Usable: good and unmarked; points that only search for the "
        "part are usable but not fitted."
    )
    return Table("Measurements", columns, tuple(rows), numeric=(1, 2, 3, 4, 5, 6, 7), note=note)


def _reasons(samples: Sequence[Sample], bad: Sequence[Sample]) -> str:
    marked = [
        f"{'retaken' if sample.mark == 'retake' else sample.mark} by {sample.mark_who}: {sample.mark_reason}"
        for sample in samples
        if sample.mark
    ]
    seen = [
        f"bad: {sample.payload['why']}" for sample in bad if not sample.mark and sample.payload.get("why")
    ]
    counts = Counter([*marked, *seen])
    return "; ".join(f"{count} {reason}" for reason, count in counts.items()) or NOTHING


def _results(results: Sequence[Result]) -> Table:
    rows = tuple(
        (
            result.phase,
            str(result.attempt),
            result.verdict,
            words.utc(result.utc_s),
            result.content_hash[:SHORT],
            result.samples_digest[:SHORT],
            NOTHING if result.calibration is None else result.calibration[:SHORT],
        )
        for result in results
    )
    columns = ("Phase", "Attempt", "Verdict", "Concluded", "Result", "Samples", "Rests on calibration")
    note = "First digits of SHA-256; in full below."
    return Table("Results and what they came from", columns, rows, numeric=(1,), outcome=2, note=note)


def _incidents(records: Records) -> Table:
    """Faults and overrides between the begin and the end of the run, from the audit trail."""
    rows, inside = [], False
    for event in records.events:
        if event.kind == "run" and event.data.get("run") == records.run.id:
            inside = not inside
        elif inside and event.kind in ("fault", "override", "resumed"):
            rows.append(
                (words.utc(event.utc_s), event.kind, event.text, str(event.data.get("remedy") or NOTHING))
            )
    return Table("Faults, overrides and resumptions", ("Time", "Kind", "What", "Remedy"), tuple(rows))


def _links(records: Records) -> Table:
    """As recorded when the run ended last."""
    run = records.run.id
    told = [event.data for event in records.events if event.kind == LINKS_EVENT and event.data["run"] == run]
    rows = tuple(link_rows(told[-1])) if told else ()
    return Table(
        "Links", COLUMNS, rows, tuple(range(1, len(COLUMNS))), note=f"Since the daemon began. {NOTE}"
    )


def _artefacts(cell: dict[str, Any]) -> Table:
    rows = tuple(
        (
            title,
            str(table["certificate"]),
            str(table.get("certified", NOTHING)),
            str(table.get("valid_to", NOTHING)),
        )
        for title, table in (("Sphere bar", cell.get("bar", {})), ("Stylus sphere", cell.get("sphere", {})))
        if "certificate" in table
    )
    note = "As declared in the cell file."
    return Table("Artefacts", ("Artefact", "Certificate", "Certified", "Valid to"), rows, note=note)


def _fingerprints(records: Records) -> tuple[tuple[str, str], ...]:
    head = records.events[-1] if records.events else None
    trail = "intact" if records.first_bad_event is None else f"ALTERED at entry {records.first_bad_event}"
    return (
        ("Cell file", records.run.cell_digest),
        *(
            (f"Result of {result.phase}, attempt {result.attempt}", result.content_hash)
            for result in records.results
        ),
        (
            f"Audit trail, entry {head.sequence} ({trail})" if head else "Audit trail",
            head.hash if head else "empty",
        ),
    )
