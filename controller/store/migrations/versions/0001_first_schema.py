"""The first schema. It is written out, not taken from schema.py, which will move on."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None


def upgrade() -> None:
    op.create_table(
        "runs",
        sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("cell_digest", sa.String(64), nullable=False),
        sa.Column("cell_text", sa.Text, nullable=False),
        sa.Column("software_version", sa.String, nullable=False),
        sa.Column("simulated", sa.Boolean, nullable=False),
        sa.Column("seed", sa.Integer),
        sa.Column("started_utc_s", sa.Float, nullable=False),
        sa.Column("ended_utc_s", sa.Float),
        sa.Column("end_state", sa.String),
        sa.Column("clean_close", sa.Boolean),
    )
    op.create_table(
        "phases",
        sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("run", sa.Integer, sa.ForeignKey("runs.id"), nullable=False),
        sa.Column("index", sa.Integer, nullable=False),
        sa.Column("name", sa.String, nullable=False),
        sa.Column("attempt", sa.Integer, nullable=False),
        sa.Column("revision", sa.Integer, nullable=False),
        sa.Column("plan", sa.Text, nullable=False),
        sa.Column("utc_s", sa.Float, nullable=False),
        sa.UniqueConstraint("run", "name", "attempt", "revision"),
    )
    op.create_table(
        "samples",
        sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("run", sa.Integer, sa.ForeignKey("runs.id"), nullable=False),
        sa.Column("phase", sa.String, nullable=False),
        sa.Column("attempt", sa.Integer, nullable=False),
        sa.Column("step", sa.Integer, nullable=False),
        sa.Column("kind", sa.String, nullable=False),
        sa.Column("payload", sa.Text, nullable=False),
        sa.Column("digest", sa.String(64), nullable=False),
        sa.Column("utc_s", sa.Float, nullable=False),
    )
    op.create_index("samples_of_phase", "samples", ["run", "phase", "attempt"])
    op.create_table(
        "sample_marks",
        sa.Column("sample", sa.Integer, sa.ForeignKey("samples.id"), primary_key=True),
        sa.Column("mark", sa.String, nullable=False),
        sa.Column("reason", sa.Text, nullable=False),
        sa.Column("who", sa.String, nullable=False),
        sa.Column("utc_s", sa.Float, nullable=False),
    )
    op.create_table(
        "results",
        sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("run", sa.Integer, sa.ForeignKey("runs.id"), nullable=False),
        sa.Column("phase", sa.String, nullable=False),
        sa.Column("attempt", sa.Integer, nullable=False),
        sa.Column("verdict", sa.String, nullable=False),
        sa.Column("result", sa.Text, nullable=False),
        sa.Column("belief", sa.Text),
        sa.Column("sample_ids", sa.Text, nullable=False),
        sa.Column("samples_digest", sa.String(64), nullable=False),
        sa.Column("calibration", sa.String(64)),
        sa.Column("content_hash", sa.String(64), nullable=False),
        sa.Column("utc_s", sa.Float, nullable=False),
    )
    op.create_index("results_of_run", "results", ["run"])
    op.create_table(
        "events",
        sa.Column("sequence", sa.Integer, primary_key=True),
        sa.Column("utc_s", sa.Float, nullable=False),
        sa.Column("kind", sa.String, nullable=False),
        sa.Column("text", sa.Text, nullable=False),
        sa.Column("data", sa.Text, nullable=False),
        sa.Column("previous_hash", sa.String(64), nullable=False),
        sa.Column("hash", sa.String(64), nullable=False),
    )
    op.create_table(
        "audit_head",
        sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("sequence", sa.Integer, nullable=False),
        sa.Column("hash", sa.String(64), nullable=False),
    )
    for table in ("phases", "samples", "sample_marks", "results", "events"):
        for verb in ("UPDATE", "DELETE"):
            op.execute(
                f"CREATE TRIGGER {table}_no_{verb.lower()} BEFORE {verb} ON {table} "
                f"BEGIN SELECT RAISE(ABORT, '{table} is append-only'); END"
            )
