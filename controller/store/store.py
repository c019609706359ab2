"""The store: every method that writes returns only after the record is durable."""

import json
import logging
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from os import getpid
from pathlib import Path
from typing import Final, Self

import sqlalchemy as sa

from controller.store import audit, database, rows, schema
from controller.store.lock import OwnerLock, lock_of
from controller.store.records import (
    Event,
    JsonObject,
    PhasePlan,
    RecordNotFound,
    RecordRefused,
    Result,
    Run,
    Sample,
    digest_of,
    to_text,
)
from drivers.clock import Clock, RealClock
from estimation.errors import StoreError

log = logging.getLogger(__name__)

_RUNS: Final = schema.RUNS
_PHASES: Final = schema.PHASES
_SAMPLES: Final = schema.SAMPLES
_MARKS: Final = schema.SAMPLE_MARKS
_RESULTS: Final = schema.RESULTS
_INSERT: Final = {table: table.insert() for table in (_RUNS, _PHASES, _SAMPLES, _MARKS, _RESULTS)}
_SELECT_SAMPLES: Final = (
    sa.select(_SAMPLES, _MARKS.c.mark, _MARKS.c.reason, _MARKS.c.who)
    .outerjoin(_MARKS)
    .order_by(_SAMPLES.c.id)
)


class Store:
    """One SQLite file with one writer. Methods may be called from any thread."""

    def __init__(
        self, path: Path, connection: sa.Connection, clock: Clock, lock: OwnerLock | None, read_only: bool
    ) -> None:
        """Use `open`."""
        self.path = path
        self._connection, self._clock, self._owner_lock = connection, clock, lock
        self._read_only = read_only
        self._mutex = threading.RLock()
        self._failed = ""  # why nothing more may be written
        self._closed = False
        self._anchor_path = path.with_name(path.name + ".anchor")
        with self._read():
            self._head = audit.read_head(connection)
        open_run = self.last_open_run()
        self._open_run = None if open_run is None else open_run.id

    @classmethod
    def open(
        cls,
        path: Path | str = database.MEMORY,
        *,
        durable: bool = True,
        read_only: bool = False,
        clock: Clock | None = None,
    ) -> Self:
        """Open or create a store, as its only owner unless `read_only`.

        `durable=False` is for simulation alone: fast, and lost with the power. ":memory:" keeps nothing.

        Raises StoreError: in use by another daemon, not durable on this disk, not a store, of newer
        software, or its audit trail was altered.
        """
        path, clock = Path(path), clock or RealClock()
        in_memory = path == database.MEMORY
        lock = None
        if not in_memory and not read_only:
            path.parent.mkdir(parents=True, exist_ok=True)
            since = datetime.fromtimestamp(clock.utc_s(), UTC).isoformat(timespec="seconds")
            lock = OwnerLock(lock_of(path), f"process {getpid()} since {since}")
        try:
            connection = database.connect(path, durable and not in_memory, read_only)
            store = cls(path, connection, clock, lock, read_only)
            store._require_intact_trail()
        except BaseException:
            if lock is not None:
                lock.release()
            raise
        return store

    def close(self) -> None:
        """Release the file; safe twice. An open run stays open, as after a crash."""
        with self._mutex:
            if self._closed:
                return
            self._closed = True
            if not self._read_only and not self._failed:
                self._write_anchor()
            self._connection.close()
            self._connection.engine.dispose()
            if self._owner_lock is not None:
                self._owner_lock.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Runs

    def begin_run(
        self,
        cell_text: str,
        cell_digest: str,
        software_version: str,
        *,
        simulated: bool,
        seed: int | None = None,
    ) -> Run:
        """Open a run with its frozen copy of the cell file. One run at a time."""
        if self._open_run is not None:
            raise RecordRefused(f"Run {self._open_run} is still open", "Close it first")
        values: JsonObject = {
            "cell_text": cell_text,
            "cell_digest": cell_digest,
            "software_version": software_version,
        }
        values |= {"simulated": simulated, "seed": seed, "started_utc_s": self._clock.utc_s()}
        with self._write("Run not begun") as connection:
            run = _insert(connection, _RUNS, values)
            self._append(connection, "run", f"Run {run} begun", {"run": run, "cell_digest": cell_digest})
        self._open_run = run
        self._write_anchor()
        return self.run(run)

    def close_run(self, run: int, state: str, *, clean: bool = True) -> None:
        """End a run in `state`; `clean=False` if it was found open after a crash."""
        self._require_open(run)
        state = str(state)
        values = {"ended_utc_s": self._clock.utc_s(), "end_state": state, "clean_close": clean}
        with self._write(f"Run {run} not closed") as connection:
            connection.execute(sa.update(_RUNS).where(_RUNS.c.id == run), values)
            data = {"run": run, "state": state, "clean": clean}
            self._append(connection, "run", f"Run {run} ended: {state}", data)
        self._open_run = None
        self._write_anchor()

    def last_open_run(self) -> Run | None:
        """The run that never ended: the present one, or one that a crash cut off."""
        query = sa.select(_RUNS).where(_RUNS.c.ended_utc_s.is_(None)).order_by(_RUNS.c.id.desc()).limit(1)
        with self._read() as connection:
            row = connection.execute(query).one_or_none()
        return None if row is None else rows.run_of(row)

    def run(self, run: int) -> Run:
        """One run. Raises StoreError if there is none with this id."""
        with self._read() as connection:
            row = connection.execute(sa.select(_RUNS).where(_RUNS.c.id == run)).one_or_none()
        if row is None:
            raise RecordNotFound(f"No run {run}", "`truecell history` lists the runs")
        return rows.run_of(row)

    def runs(self, limit: int = 100) -> list[Run]:
        """The newest runs, newest first."""
        query = sa.select(_RUNS).order_by(_RUNS.c.id.desc()).limit(limit)
        with self._read() as connection:
            return [rows.run_of(row) for row in connection.execute(query)]

    # Plans

    def save_plan(
        self, run: int, index: int, phase: str, attempt: int, plan: Mapping[str, object]
    ) -> PhasePlan:
        """Record the plan of an attempt at a phase; saving again adds a revision."""
        self._require_open(run)
        previous = self.plan(run, phase, attempt)
        revision = 1 if previous is None else previous.revision + 1
        key = {"run": run, "index": index, "name": phase, "attempt": attempt, "revision": revision}
        text = to_text(plan)
        with self._write(f"Plan of {phase} not stored") as connection:
            _insert(connection, _PHASES, {**key, "plan": text, "utc_s": self._clock.utc_s()})
        return PhasePlan(run, index, phase, attempt, revision, json.loads(text))

    def plan(self, run: int, phase: str, attempt: int) -> PhasePlan | None:
        """The newest plan of an attempt, or None."""
        this = (_PHASES.c.run == run) & (_PHASES.c.name == phase) & (_PHASES.c.attempt == attempt)
        query = sa.select(_PHASES).where(this).order_by(_PHASES.c.revision.desc()).limit(1)
        with self._read() as connection:
            row = connection.execute(query).one_or_none()
        return None if row is None else rows.plan_of(row)

    def plans(self, run: int) -> list[PhasePlan]:
        """The newest plan of every attempt at every phase, in the order in which they were first saved."""
        query = sa.select(_PHASES).where(_PHASES.c.run == run).order_by(_PHASES.c.id)
        with self._read() as connection:
            plans = [rows.plan_of(row) for row in connection.execute(query)]
        return list({(plan.name, plan.attempt): plan for plan in plans}.values())

    # Samples

    def add_sample(
        self, run: int, phase: str, attempt: int, step: int, kind: str, payload: Mapping[str, object]
    ) -> int:
        """Record one measurement of the open run; returns its id once it is durable.

        Raises StoreError: not finite, run not open, medium failed. Then nothing was stored.
        """
        self._require_open(run)
        text, utc_s = to_text(payload), self._clock.utc_s()
        values = {"run": run, "phase": phase, "attempt": attempt, "step": step, "kind": kind, "payload": text}
        digest = rows.sample_digest(run, phase, attempt, step, kind, text, utc_s)
        with self._write("Sample not stored") as connection:
            return _insert(connection, _SAMPLES, {**values, "digest": digest, "utc_s": utc_s})

    def samples(
        self,
        run: int,
        phase: str | None = None,
        attempt: int | None = None,
        *,
        include_excluded: bool = False,
    ) -> list[Sample]:
        """Measurements in the order in which they were taken, by default only the unmarked ones.

        Raises StoreError if one was altered since it was stored.
        """
        query = _SELECT_SAMPLES.where(_SAMPLES.c.run == run)
        if phase is not None:
            query = query.where(_SAMPLES.c.phase == phase)
        if attempt is not None:
            query = query.where(_SAMPLES.c.attempt == attempt)
        if not include_excluded:
            query = query.where(_MARKS.c.mark.is_(None))
        with self._read() as connection:
            return [rows.sample_of(row) for row in connection.execute(query)]

    def exclude(self, sample: int, reason: str, who: str) -> None:
        """Keep a sample out of every later estimate. Marks cannot be taken back."""
        self._mark(sample, "excluded", reason, who)

    def retake(self, sample: int, reason: str, who: str) -> None:
        """As `exclude`, and ask for a new measurement at the same step."""
        self._mark(sample, "retake", reason, who)

    def _mark(self, sample: int, mark: str, reason: str, who: str) -> None:
        if not reason.strip() or not who.strip():
            raise RecordRefused(f"Sample {sample} marked without reason or name", "Say why and who decides")
        data = {"sample": sample, "mark": mark, "reason": reason, "who": who}
        with self._write(f"Sample {sample} not marked") as connection:
            row = connection.execute(_SELECT_SAMPLES.where(_SAMPLES.c.id == sample)).one_or_none()
            if row is None:
                raise RecordNotFound(f"No sample {sample}", "`truecell samples list` shows them")
            if row.mark is not None:
                raise RecordRefused(f"Sample {sample} was marked {row.mark} by {row.who}", "Marks are final")
            _insert(connection, _MARKS, {**data, "utc_s": self._clock.utc_s()})
            self._append(connection, "sample", f"Sample {sample} {mark}: {reason}", data)

    # Results

    def save_result(
        self,
        run: int,
        phase: str,
        attempt: int,
        verdict: str,
        result: Mapping[str, object],
        *,
        belief: Mapping[str, object] | None = None,
        sample_ids: Sequence[int] = (),
        calibration: str | None = None,
    ) -> Result:
        """Record the outcome of a phase with the samples that it came from; also an audit event.

        Raises StoreError when a sample is missing, excluded or altered.
        """
        ids = tuple(int(i) for i in sample_ids)
        row: JsonObject = {"run": run, "phase": phase, "attempt": attempt, "verdict": str(verdict)}
        row |= {"result": to_text(result), "belief": None if belief is None else to_text(belief)}
        row |= {"sample_ids": to_text(ids), "calibration": calibration, "utc_s": self._clock.utc_s()}
        with self._write(f"Result of {phase} not stored") as connection:
            row["samples_digest"] = _digest_of_samples(connection, ids)
            row["content_hash"] = rows.result_hash(row)
            row["id"] = _insert(connection, _RESULTS, row)
            keys = ("run", "phase", "attempt", "verdict", "content_hash", "samples_digest")
            text = f"{phase}, attempt {attempt}: {verdict}"
            self._append(connection, "result", text, {key: row[key] for key in keys})
        return rows.result_of(row)

    def results(self, run: int) -> list[Result]:
        """All results of a run, oldest first. Raises StoreError if one was altered."""
        query = sa.select(_RESULTS).where(_RESULTS.c.run == run).order_by(_RESULTS.c.id)
        with self._read() as connection:
            return [rows.result_of(rows.columns(row)) for row in connection.execute(query)]

    def latest_results(self) -> list[Result]:
        """The newest result of each phase in the newest run that has any, in job order."""
        with self._read() as connection:
            run = connection.scalar(sa.select(sa.func.max(_RESULTS.c.run)))
        return [] if run is None else list({r.phase: r for r in self.results(run)}.values())

    # Audit trail

    def event(self, kind: str, text: str, /, **data: object) -> Event:
        """Append one line to the audit trail."""
        with self._write("Event not stored") as connection:
            return self._append(connection, kind, text, data)

    def events(self, since: int = 0) -> list[Event]:
        """The lines after sequence number `since`, oldest first."""
        with self._read() as connection:
            return audit.read(connection, since)

    def verify_chain(self) -> int | None:
        """Check the whole trail; sequence number of the first altered or missing line, or None."""
        with self._read() as connection:
            return audit.first_bad(connection, audit.read_anchor(self._anchor_path))

    def _append(self, connection: sa.Connection, kind: str, text: str, data: JsonObject) -> Event:
        event = audit.append(connection, self._head, self._clock.utc_s(), kind, text, data)
        self._head = audit.Head(event.sequence, event.hash)
        log.info("%s: %s", kind, text)
        return event

    def _write_anchor(self) -> None:
        if self.path != database.MEMORY:
            audit.write_anchor(self._anchor_path, self._head)

    def _require_intact_trail(self) -> None:
        if self._read_only:
            return  # somebody is analysing; `verify_chain` is for them
        with self._read() as connection:
            intact = audit.end_is_intact(connection, audit.read_anchor(self._anchor_path))
        if not intact:
            raise StoreError(
                f"Audit trail of {self.path} is altered or cut at entry {self.verify_chain()}",
                "Keep the file for analysis and restore a backup together with its .anchor file",
            )

    # Transactions

    @contextmanager
    def _read(self) -> Iterator[sa.Connection]:
        with self._mutex, database.in_our_words("Store cannot be read"):
            if self._closed:
                raise StoreError("Store is closed", "Open it again")
            with self._connection.begin():
                yield self._connection

    @contextmanager
    def _write(self, what: str) -> Iterator[sa.Connection]:
        with self._mutex:
            if self._closed or self._read_only or self._failed:
                why = self._failed or (
                    "store is closed" if self._closed else "store is open for reading only"
                )
                raise StoreError(f"{what}: {why}", "Restart the daemon once the cause is removed")
            head = self._head
            try:
                with database.in_our_words(what), self._connection.begin():
                    yield self._connection
            except BaseException as error:
                self._head = head
                if error.__cause__ is not None and database.is_fatal(error.__cause__):
                    # A failed fsync may have dropped the data and then report success: never try again.
                    self._failed = f"storage failed earlier ({error})"
                raise

    def _require_open(self, run: int) -> None:
        if run != self._open_run:
            raise RecordRefused(f"Run {run} is not open", "Only the open run takes samples and plans")


def _insert(connection: sa.Connection, table: sa.Table, values: Mapping[str, object]) -> int:
    """Add a row; returns its id."""
    key = connection.execute(_INSERT[table], values).inserted_primary_key
    return 0 if key is None else int(key[0])


def _digest_of_samples(connection: sa.Connection, ids: tuple[int, ...]) -> str:
    query = _SELECT_SAMPLES.where(_SAMPLES.c.id.in_(ids))
    found = {sample.id: sample for sample in map(rows.sample_of, connection.execute(query))}
    if bad := [i for i in ids if i not in found or found[i].mark is not None]:
        raise RecordRefused(f"Result rests on missing or excluded samples {bad}", "Estimate without them")
    return digest_of([found[i].digest for i in ids])
