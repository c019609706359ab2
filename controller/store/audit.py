"""The audit trail: a chain of hashes in the database, its end anchored in a file of its own."""

import json
import os
from pathlib import Path
from typing import Final, NamedTuple

import sqlalchemy as sa

from controller.store import schema
from controller.store.records import Event, JsonObject, digest_of, to_text

_EVENTS: Final = schema.EVENTS
_HEAD: Final = schema.AUDIT_HEAD
_INSERT: Final = sa.insert(_EVENTS)
_SET_HEAD: Final = sa.update(_HEAD).where(_HEAD.c.id == 1)


class Head(NamedTuple):
    """The end of the chain: the newest sequence number and its hash."""

    sequence: int
    hash: str


EMPTY: Final = Head(0, "0" * 64)


def append(
    connection: sa.Connection, head: Head, utc_s: float, kind: str, text: str, data: JsonObject
) -> Event:
    """Write the event after `head`, in the caller's transaction."""
    data_text = to_text(data)
    sequence = head.sequence + 1
    digest = digest_of(head.hash, sequence, utc_s, kind, text, data_text)
    connection.execute(
        _INSERT,
        {
            "sequence": sequence,
            "utc_s": utc_s,
            "kind": kind,
            "text": text,
            "data": data_text,
            "previous_hash": head.hash,
            "hash": digest,
        },
    )
    if head == EMPTY:
        connection.execute(sa.insert(_HEAD), {"id": 1, "sequence": sequence, "hash": digest})
    else:
        connection.execute(_SET_HEAD, {"sequence": sequence, "hash": digest})
    return Event(sequence, utc_s, kind, text, json.loads(data_text), head.hash, digest)


def read(connection: sa.Connection, since: int) -> list[Event]:
    """The events after sequence number `since`, oldest first."""
    rows = connection.execute(
        sa.select(_EVENTS).where(_EVENTS.c.sequence > since).order_by(_EVENTS.c.sequence)
    )
    return [
        Event(r.sequence, r.utc_s, r.kind, r.text, json.loads(r.data), r.previous_hash, r.hash) for r in rows
    ]


def read_head(connection: sa.Connection) -> Head:
    """The end of the chain as the database notes it."""
    row = connection.execute(sa.select(_HEAD.c.sequence, _HEAD.c.hash)).one_or_none()
    return Head(row.sequence, row.hash) if row else EMPTY


def end_is_intact(connection: sa.Connection, anchor: Head) -> bool:
    """Quick check for every start: the last event is the noted one, none is missing, the anchor holds."""
    head = read_head(connection)
    count, last = connection.execute(sa.select(sa.func.count(), sa.func.max(_EVENTS.c.sequence))).one()
    if count != head.sequence or (last or 0) != head.sequence or anchor.sequence > head.sequence:
        return False
    return all(_hash_at(connection, known.sequence) == known.hash for known in (head, anchor))


def _hash_at(connection: sa.Connection, sequence: int) -> str | None:
    """Hash of one event, computed afresh from its line."""
    if sequence == 0:
        return EMPTY.hash
    row = connection.execute(sa.select(_EVENTS).where(_EVENTS.c.sequence == sequence)).one_or_none()
    return None if row is None else _row_hash(row)


def _row_hash(row: sa.Row[tuple[object, ...]]) -> str:
    return digest_of(row.previous_hash, row.sequence, row.utc_s, row.kind, row.text, row.data)


def first_bad(connection: sa.Connection, anchor: Head) -> int | None:
    """Walk the whole chain; sequence number of the first line that is altered or missing, or None."""
    previous, expected = EMPTY.hash, 0
    for row in connection.execute(sa.select(_EVENTS).order_by(_EVENTS.c.sequence)):
        expected += 1
        if row.sequence != expected or row.previous_hash != previous or row.hash != _row_hash(row):
            return expected
        if expected == anchor.sequence and row.hash != anchor.hash:
            return expected
        previous = row.hash
    head = read_head(connection)
    if max(head.sequence, anchor.sequence) > expected:
        return expected + 1
    return None if head == Head(expected, previous) else expected


def read_anchor(path: Path) -> Head:
    """The end of the chain as last noted outside the database; EMPTY if it never was."""
    try:
        content = json.loads(path.read_text())
        return Head(int(content["sequence"]), str(content["hash"]))
    except FileNotFoundError:
        return EMPTY
    except (ValueError, KeyError, TypeError):
        return Head(0, "unreadable")  # matches no chain


def write_anchor(path: Path, head: Head) -> None:
    """Note the end of the chain outside the database, whole or not at all."""
    draft = path.with_name(path.name + ".new")
    with draft.open("w") as file:
        file.write(to_text({"sequence": head.sequence, "hash": head.hash}) + "\n")
        file.flush()
        os.fsync(file.fileno())
    draft.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
