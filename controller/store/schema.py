"""The tables of the store as they are now; `migrations/` leads here from every older form."""

from typing import Final

from sqlalchemy import (
    Boolean,
    Column,
    Connection,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    Text,
    UniqueConstraint,
)

HEAD: Final = "0001"  # the newest revision in migrations/versions

METADATA: Final = MetaData()

RUNS = Table(
    "runs",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("cell_digest", String(64), nullable=False),
    Column("cell_text", Text, nullable=False),
    Column("software_version", String, nullable=False),
    Column("simulated", Boolean, nullable=False),
    Column("seed", Integer),
    Column("started_utc_s", Float, nullable=False),
    Column("ended_utc_s", Float),
    Column("end_state", String),
    Column("clean_close", Boolean),
)

PHASES = Table(
    "phases",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("run", ForeignKey("runs.id"), nullable=False),
    Column("index", Integer, nullable=False),
    Column("name", String, nullable=False),
    Column("attempt", Integer, nullable=False),
    Column("revision", Integer, nullable=False),
    Column("plan", Text, nullable=False),
    Column("utc_s", Float, nullable=False),
    UniqueConstraint("run", "name", "attempt", "revision"),
)

SAMPLES = Table(
    "samples",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("run", ForeignKey("runs.id"), nullable=False),
    Column("phase", String, nullable=False),
    Column("attempt", Integer, nullable=False),
    Column("step", Integer, nullable=False),
    Column("kind", String, nullable=False),
    Column("payload", Text, nullable=False),
    Column("digest", String(64), nullable=False),
    Column("utc_s", Float, nullable=False),
    Index("samples_of_phase", "run", "phase", "attempt"),
)

SAMPLE_MARKS = Table(
    "sample_marks",
    METADATA,
    Column("sample", ForeignKey("samples.id"), primary_key=True),
    Column("mark", String, nullable=False),
    Column("reason", Text, nullable=False),
    Column("who", String, nullable=False),
    Column("utc_s", Float, nullable=False),
)

RESULTS = Table(
    "results",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("run", ForeignKey("runs.id"), nullable=False),
    Column("phase", String, nullable=False),
    Column("attempt", Integer, nullable=False),
    Column("verdict", String, nullable=False),
    Column("result", Text, nullable=False),
    Column("belief", Text),
    Column("sample_ids", Text, nullable=False),
    Column("samples_digest", String(64), nullable=False),
    Column("calibration", String(64)),
    Column("content_hash", String(64), nullable=False),
    Column("utc_s", Float, nullable=False),
    Index("results_of_run", "run"),
)

EVENTS = Table(
    "events",
    METADATA,
    Column("sequence", Integer, primary_key=True),
    Column("utc_s", Float, nullable=False),
    Column("kind", String, nullable=False),
    Column("text", Text, nullable=False),
    Column("data", Text, nullable=False),
    Column("previous_hash", String(64), nullable=False),
    Column("hash", String(64), nullable=False),
)

# One row: the end of the audit trail, so that cutting off its tail shows.
AUDIT_HEAD = Table(
    "audit_head",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("sequence", Integer, nullable=False),
    Column("hash", String(64), nullable=False),
)

APPEND_ONLY: Final = (PHASES, SAMPLES, SAMPLE_MARKS, RESULTS, EVENTS)


def guard_statements() -> list[str]:
    """SQL that makes the database itself refuse to change or delete a record."""
    return [
        f"CREATE TRIGGER {table.name}_no_{verb.lower()} BEFORE {verb} ON {table.name} "
        f"BEGIN SELECT RAISE(ABORT, '{table.name} is append-only'); END"
        for table in APPEND_ONLY
        for verb in ("UPDATE", "DELETE")
    ]


def create(connection: Connection) -> None:
    """Make a new, empty store in the present form (the same as running all migrations)."""
    METADATA.create_all(connection, checkfirst=False)
    for statement in guard_statements():
        connection.exec_driver_sql(statement)
    connection.exec_driver_sql(
        "CREATE TABLE alembic_version (version_num VARCHAR(32) NOT NULL, "
        "CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num))"
    )
    connection.exec_driver_sql("INSERT INTO alembic_version VALUES (?)", (HEAD,))
