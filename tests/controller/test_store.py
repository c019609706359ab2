"""What the record promises: nothing acknowledged is lost, nothing altered unseen, nothing false goes in."""

import math
import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.store import Store, schema
from controller.store.database import migrate
from estimation.errors import StoreError

DIGEST = "d" * 64


class FixedClock:
    """Time that moves by a second at every look."""

    def __init__(self) -> None:
        self._utc_s = 1_800_000_000.0

    def now_s(self) -> float:
        return self._utc_s

    def sleep(self, duration_s: float) -> None:
        self._utc_s += duration_s

    def utc_s(self) -> float:
        self._utc_s += 1.0
        return self._utc_s


def begin(store: Store) -> int:
    return store.begin_run("[cell]", DIGEST, "0.1.0", simulated=True, seed=7).id


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "cell.db"


@pytest.fixture
def memory() -> Iterator[Store]:
    with Store.open() as store:
        yield store


def edit(path: Path, statement: str, *values: object) -> None:
    """What somebody with an SQL prompt can do: the guards are dropped first."""
    with sqlite3.connect(path) as connection:
        for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
            connection.execute(f"DROP TRIGGER {name}")
        connection.execute(statement, values)
    connection.close()


def test_everything_comes_back_after_reopening(path: Path) -> None:
    with Store.open(path) as store:
        run = begin(store)
        store.save_plan(run, 0, "hand-eye", 1, {"steps": [1, 2]})
        store.save_plan(run, 0, "hand-eye", 1, {"steps": [1, 2, 3]})
        payload = {"joints_rad": np.array([0.1, -1 / 3]), "quality": "good", "device": "ILD1420 1420100"}
        ids = [store.add_sample(run, "hand-eye", 1, step, "laser", payload) for step in range(3)]
        saved = store.save_result(
            run,
            "hand-eye",
            1,
            "OK",
            {"u_m": 1e-4},
            belief={"mean": [1.0]},
            sample_ids=ids,
            calibration=DIGEST,
        )
        store.close_run(run, "Completed")
    with Store.open(path) as store:
        (record,) = store.runs()
        assert (record.cell_text, record.seed, record.end_state, record.clean_close) == (
            "[cell]", 7, "Completed", True
        )  # fmt: skip
        plan = store.plan(run, "hand-eye", 1)
        assert plan is not None and plan.revision == 2 and plan.plan == {"steps": [1, 2, 3]}
        samples = store.samples(run, "hand-eye", 1)
        assert [(s.id, s.step) for s in samples] == list(zip(ids, range(3), strict=True))
        assert samples[0].payload["joints_rad"] == [0.1, -1 / 3]
        assert store.results(run) == store.latest_results() == [saved]
        assert store.last_open_run() is None
        assert store.verify_chain() is None


CHILD = """
import sys
from pathlib import Path
from controller.store import Store
store = Store.open(Path(sys.argv[1]))
run = store.begin_run("[cell]", "d" * 64, "0.1.0", simulated=True).id
step = 0
while True:
    print(store.add_sample(run, "hand-eye", 1, step, "laser", {"reading_m": step * 1e-3}), step, flush=True)
    step += 1
"""


@pytest.mark.wire
@pytest.mark.parametrize("acknowledged", [1, 7, 40])
def test_no_acknowledged_sample_is_lost_when_the_daemon_is_killed(path: Path, acknowledged: int) -> None:
    child = subprocess.Popen([sys.executable, "-c", CHILD, path], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    lines = [child.stdout.readline() for _ in range(acknowledged)]
    child.send_signal(signal.SIGKILL)
    lines += child.stdout.readlines()
    child.wait()
    journal = [tuple(map(int, line.split())) for line in lines if line.endswith("\n")]
    with Store.open(path) as store:
        run = store.last_open_run()
        assert run is not None and run.clean_close is None
        kept = [(s.id, s.step) for s in store.samples(run.id, "hand-eye", 1)]
        assert kept[: len(journal)] == journal
        assert len(kept) <= len(journal) + 1  # one may have been durable but not yet acknowledged
        assert all(s.payload == {"reading_m": s.step * 1e-3} for s in store.samples(run.id))
        assert store.verify_chain() is None
        store.add_sample(run.id, "hand-eye", 1, len(kept), "laser", {})  # and the run goes on
        store.close_run(run.id, "Aborted", clean=False)


@pytest.mark.wire
def test_a_second_owner_is_refused_with_the_first_ones_process(path: Path) -> None:
    child = subprocess.Popen([sys.executable, "-c", CHILD, path], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    try:
        child.stdout.readline()
        with pytest.raises(StoreError, match=f"in use by process {child.pid} since 20"):
            Store.open(path)
        with Store.open(path, read_only=True) as reader:
            assert reader.last_open_run() is not None
            with pytest.raises(StoreError, match="reading only"):
                reader.event("note", "not allowed")
    finally:
        child.kill()
        child.wait()
        child.stdout.close()
    Store.open(path).close()


def test_a_store_is_free_again_after_close_and_after_a_failed_open(path: Path) -> None:
    Store.open(path).close()
    path.write_text("this is no database, but long enough to be read as one" * 100)
    for _ in range(2):
        with pytest.raises(StoreError, match="cannot be opened"):
            Store.open(path)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, np.float64("nan")])
def test_what_is_not_finite_is_refused_with_its_place(memory: Store, bad: float) -> None:
    run = begin(memory)
    with pytest.raises(StoreError, match=r"range\.readings_m\[1\] = -?(nan|inf) is not finite"):
        memory.add_sample(run, "p", 1, 0, "laser", {"range": {"readings_m": [0.1, bad]}})
    with pytest.raises(StoreError, match="not finite"):
        memory.save_result(run, "p", 1, "OK", {"u_m": np.array([bad])})
    with pytest.raises(StoreError, match="not finite"):
        memory.event("note", "x", value=bad)
    assert memory.samples(run) == [] == memory.results(run)
    assert memory.verify_chain() is None


def test_a_payload_that_is_no_json_is_refused(memory: Store) -> None:
    with pytest.raises(StoreError, match="cannot hold"):
        memory.add_sample(begin(memory), "p", 1, 0, "laser", {"when": object()})


def test_marked_samples_stay_but_enter_nothing(memory: Store) -> None:
    run = begin(memory)
    first, second, third = (memory.add_sample(run, "p", 1, step, "laser", {}) for step in range(3))
    memory.exclude(first, "chip on the face", "Kim")
    memory.retake(second, "part moved", "Kim")
    assert [s.id for s in memory.samples(run, "p", 1)] == [third]
    every = memory.samples(run, "p", 1, include_excluded=True)
    assert [(s.mark, s.mark_reason, s.mark_who) for s in every] == [
        ("excluded", "chip on the face", "Kim"),
        ("retake", "part moved", "Kim"),
        (None, None, None),
    ]
    with pytest.raises(StoreError, match="missing or excluded samples \\[1\\]"):
        memory.save_result(run, "p", 1, "OK", {}, sample_ids=[third, first])
    assert [e.data["who"] for e in memory.events() if e.kind == "sample"] == ["Kim", "Kim"]


def test_marks_that_make_no_sense_are_refused(memory: Store) -> None:
    sample = memory.add_sample(begin(memory), "p", 1, 0, "laser", {})
    with pytest.raises(StoreError, match="No sample 99"):
        memory.exclude(99, "reason", "Kim")
    with pytest.raises(StoreError, match="without reason"):
        memory.exclude(sample, "  ", "Kim")
    memory.exclude(sample, "reason", "Kim")
    with pytest.raises(StoreError, match="marked excluded by Kim"):
        memory.retake(sample, "again", "Lee")


def test_samples_belong_to_the_open_run(memory: Store) -> None:
    with pytest.raises(StoreError, match="not open"):
        memory.add_sample(1, "p", 1, 0, "laser", {})
    run = begin(memory)
    with pytest.raises(StoreError, match="still open"):
        begin(memory)
    memory.close_run(run, "Stopped")
    with pytest.raises(StoreError, match="not open"):
        memory.add_sample(run, "p", 1, 0, "laser", {})
    with pytest.raises(StoreError, match="No run 5"):
        memory.run(5)


def test_latest_results_are_the_newest_of_each_phase(memory: Store) -> None:
    first = begin(memory)
    memory.save_result(first, "hand-eye", 1, "OK", {})
    memory.close_run(first, "Stopped")
    run = begin(memory)
    for phase, attempt, verdict in [("hand-eye", 1, "NotOK"), ("hand-eye", 2, "OK"), ("check", 1, "OK")]:
        memory.save_result(run, phase, attempt, verdict, {})
    assert [(r.run, r.phase, r.attempt) for r in memory.latest_results()] == [
        (run, "hand-eye", 2),
        (run, "check", 1),
    ]
    assert len(memory.results(run)) == 3  # every attempt is kept


def test_a_result_names_its_samples_by_content(memory: Store) -> None:
    run = begin(memory)
    ids = [memory.add_sample(run, "p", 1, step, "laser", {"reading_m": 0.1 * step}) for step in range(2)]
    results = [memory.save_result(run, "p", 1, "OK", {}, sample_ids=used) for used in (ids, ids[:1], ids)]
    assert results[0].samples_digest == results[2].samples_digest != results[1].samples_digest
    assert len({r.content_hash for r in results}) == 3


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE samples SET payload = '{}'",
        "DELETE FROM samples",
        "UPDATE events SET text = 'nothing happened'",
        "DELETE FROM events",
        "UPDATE results SET verdict = 'OK'",
        "DELETE FROM sample_marks",
    ],
)
def test_the_database_itself_refuses_to_change_records(path: Path, statement: str) -> None:
    with Store.open(path) as store:
        run = begin(store)
        store.exclude(store.add_sample(run, "p", 1, 0, "laser", {}), "reason", "Kim")
        store.save_result(run, "p", 1, "NotOK", {})
    with sqlite3.connect(path) as connection, pytest.raises(sqlite3.IntegrityError, match="append-only"):
        connection.execute(statement)
    connection.close()


@pytest.mark.parametrize(
    ("statement", "first_bad"),
    [
        ("UPDATE events SET text = 'harmless' WHERE sequence = 3", 3),
        ("UPDATE events SET utc_s = utc_s + 1 WHERE sequence = 1", 1),
        ("UPDATE events SET data = '{}' WHERE sequence = 4", 4),
        ("UPDATE events SET hash = previous_hash WHERE sequence = 5", 5),
        ("DELETE FROM events WHERE sequence = 2", 2),
        ("DELETE FROM events WHERE sequence >= 5", 5),
        ("DELETE FROM events", 1),
        ("DELETE FROM audit_head", 6),
        ("UPDATE audit_head SET sequence = 4", 6),
    ],
)
def test_an_edited_or_cut_trail_is_found(path: Path, statement: str, first_bad: int) -> None:
    with Store.open(path) as store:
        for number in range(6):
            store.event("note", f"event {number}", number=number)
    edit(path, statement)
    with Store.open(path, read_only=True) as store:
        assert store.verify_chain() == first_bad


def test_a_trail_cut_together_with_its_head_is_found_by_the_anchor(path: Path) -> None:
    with Store.open(path) as store:
        for number in range(6):
            store.event("note", f"event {number}")
        fourth = store.events()[3]
    edit(path, "DELETE FROM events WHERE sequence > 4")
    edit(path, "UPDATE audit_head SET sequence = ?, hash = ?", fourth.sequence, fourth.hash)
    with pytest.raises(StoreError, match="altered or cut at entry 5"):
        Store.open(path)


def test_altered_samples_and_results_are_not_handed_out(path: Path) -> None:
    with Store.open(path) as store:
        run = begin(store)
        sample = store.add_sample(run, "p", 1, 0, "laser", {"reading_m": 0.1})
        store.save_result(run, "p", 1, "NotOK", {"u_m": 1e-3}, sample_ids=[sample])
    edit(path, "UPDATE samples SET payload = ?", '{"reading_m":0.2}')
    edit(path, "UPDATE results SET verdict = 'OK'")
    with Store.open(path) as store:
        with pytest.raises(StoreError, match="Sample 1 of run 1 was altered"):
            store.samples(run)
        with pytest.raises(StoreError, match="Result 1 of run 1 was altered"):
            store.results(run)


def test_the_same_actions_leave_the_same_bytes_of_record() -> None:
    def trail() -> list[object]:
        with Store.open(clock=FixedClock()) as store:
            run = begin(store)
            store.add_sample(run, "p", 1, 0, "laser", {"reading_m": 0.1})
            store.save_result(run, "p", 1, "OK", {}, sample_ids=[1])
            store.close_run(run, "Completed")
            return [store.events(), store.results(run)]

    assert trail() == trail()


def test_a_full_disk_refuses_the_sample_and_the_store_lives_on(path: Path) -> None:
    with Store.open(path) as store:
        run = begin(store)
        pages = store._connection.exec_driver_sql("PRAGMA page_count").scalar_one()
        store._connection.commit()
        store._connection.exec_driver_sql(f"PRAGMA max_page_count = {pages}")
        store._connection.commit()
        with pytest.raises(StoreError, match="Sample not stored: database or disk is full"):
            for step in range(1000):
                store.add_sample(run, "p", 1, step, "laser", {"text": "x" * 500})
        count = len(store.samples(run))
        store._connection.exec_driver_sql(f"PRAGMA max_page_count = {pages * 100}")
        store._connection.commit()
        store.add_sample(run, "p", 1, 0, "laser", {})
        assert len(store.samples(run)) == count + 1
        assert store.verify_chain() is None


def test_after_a_failed_medium_nothing_is_written_again(
    memory: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = begin(memory)

    def fail(_connection: sa.Connection) -> None:
        raise sa.exc.OperationalError("COMMIT", {}, sqlite3.OperationalError("disk I/O error"))

    sa.event.listen(memory._connection.engine, "commit", fail)
    with pytest.raises(StoreError, match="disk I/O error"):
        memory.add_sample(run, "p", 1, 0, "laser", {})
    sa.event.remove(memory._connection.engine, "commit", fail)
    with pytest.raises(StoreError, match="storage failed earlier"):
        memory.add_sample(run, "p", 1, 0, "laser", {})


def test_a_disk_that_gives_no_durability_is_refused(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = sqlite3.connect

    class WithoutWal(sqlite3.Connection):
        def execute(self, sql: str, *args: object) -> sqlite3.Cursor:
            return super().execute(sql.replace("journal_mode = WAL", "journal_mode = DELETE"), *args)  # type: ignore[arg-type]

    monkeypatch.setattr(sqlite3, "connect", lambda *a, **k: real(*a, **k, factory=WithoutWal))
    with pytest.raises(StoreError, match="journal mode delete, synchronous 2 instead of wal, 2"):
        Store.open(path)


def test_other_databases_and_newer_stores_are_refused(path: Path, tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "other.db") as other:
        other.execute("CREATE TABLE t (x)")
    other.close()
    with pytest.raises(StoreError, match="not a truecell store"):
        Store.open(tmp_path / "other.db")
    Store.open(path).close()
    edit(path, "UPDATE alembic_version SET version_num = '9999'")
    with pytest.raises(StoreError, match="schema 9999, this software reads"):
        Store.open(path)
    with pytest.raises(StoreError, match="cannot be opened"):
        Store.open(tmp_path / "missing.db", read_only=True)


def test_migrations_lead_to_the_present_schema(path: Path) -> None:
    def shape(connection: sa.Connection) -> object:
        found = sa.inspect(connection)
        tables = sorted(found.get_table_names())
        triggers = connection.exec_driver_sql("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'")
        columns = [
            (t, c["name"], str(c["type"]), c["nullable"]) for t in tables for c in found.get_columns(t)
        ]
        keys = [
            (t, found.get_pk_constraint(t), found.get_indexes(t), found.get_unique_constraints(t))
            for t in tables
        ]
        foreign = [
            (t, f["constrained_columns"], f["referred_table"])
            for t in tables
            for f in found.get_foreign_keys(t)
        ]
        version = connection.exec_driver_sql("SELECT version_num FROM alembic_version").scalar_one()
        return columns, keys, foreign, sorted(map(tuple, triggers)), version

    sa.create_engine(f"sqlite:///{path}").connect().close()
    with sa.create_engine(f"sqlite:///{path}").connect() as migrated:
        migrate(migrated, path)
        with sa.create_engine("sqlite://").connect() as created:
            schema.create(created)
            assert shape(migrated) == shape(created)
    assert path.with_name("cell.db.before-0001").exists()


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.dictionaries(st.text(), json_values, max_size=4), max_size=5))
def test_every_payload_comes_back_exactly(payloads: list[dict[str, object]]) -> None:
    with Store.open() as store:
        run = begin(store)
        for step, payload in enumerate(payloads):
            store.add_sample(run, "p", 1, step, "laser", payload)
            store.event("note", "payload", payload=payload)
        assert [s.payload for s in store.samples(run)] == payloads
        assert [e.data["payload"] for e in store.events() if e.kind == "note"] == payloads
        assert store.verify_chain() is None


def test_the_lock_file_names_this_process(path: Path) -> None:
    with Store.open(path), pytest.raises(StoreError, match=f"process {os.getpid()} "):
        Store.open(path)
