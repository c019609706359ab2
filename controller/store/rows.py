"""From rows of the tables to records, each checked against its digest."""

import json
from hashlib import sha256
from typing import Any

import sqlalchemy as sa

from controller.store.records import JsonObject, PhasePlan, Result, Run, Sample, digest_of, to_text
from estimation.errors import StoreError

Row = sa.Row[Any]


def columns(row: Row) -> dict[str, Any]:
    """The columns of a row by name."""
    return dict(row._mapping)


def run_of(row: Row) -> Run:
    """A run."""
    return Run(**columns(row))


def plan_of(row: Row) -> PhasePlan:
    """One revision of a plan."""
    r = columns(row)  # `row.index` would be the tuple's method
    return PhasePlan(r["run"], r["index"], r["name"], r["attempt"], r["revision"], json.loads(r["plan"]))


def sample_digest(
    run: int, phase: str, attempt: int, step: int, kind: str, payload_text: str, utc_s: float
) -> str:
    """SHA-256 over a sample as stored."""
    head = to_text((run, phase, attempt, step, kind, utc_s))
    return sha256(f"{head}\n{payload_text}".encode()).hexdigest()


def sample_of(row: Row) -> Sample:
    """A sample with its mark. Raises StoreError if it is not as it was stored."""
    digest = sample_digest(row.run, row.phase, row.attempt, row.step, row.kind, row.payload, row.utc_s)
    if row.digest != digest:
        raise StoreError(
            f"Sample {row.id} of run {row.run} was altered after it was stored", "Restore a backup"
        )
    return Sample(
        id=row.id,
        run=row.run,
        phase=row.phase,
        attempt=row.attempt,
        step=row.step,
        kind=row.kind,
        payload=json.loads(row.payload),
        digest=digest,
        utc_s=row.utc_s,
        mark=row.mark,
        mark_reason=row.reason,
        mark_who=row.who,
    )


def result_hash(row: JsonObject) -> str:
    """SHA-256 over a result as stored."""
    return digest_of({key: value for key, value in row.items() if key not in ("id", "content_hash")})


def result_of(row: JsonObject) -> Result:
    """A result. Raises StoreError if it is not as it was stored."""
    if row["content_hash"] != result_hash(row):
        raise StoreError(
            f"Result {row['id']} of run {row['run']} was altered after it was stored", "Restore a backup"
        )
    return Result(
        **{
            **row,
            "result": json.loads(row["result"]),
            "belief": None if row["belief"] is None else json.loads(row["belief"]),
            "sample_ids": tuple(json.loads(row["sample_ids"])),
        }
    )
