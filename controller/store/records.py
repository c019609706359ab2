"""What the store keeps, as plain data, and the one text form in which it is kept and hashed."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from typing import Any, Final

from estimation.errors import StoreError

JsonObject = dict[str, Any]


class RecordNotFound(StoreError):
    """Asked for something that the store does not hold."""


class RecordRefused(StoreError):
    """The store is well, but this must not be recorded."""


LINKS_EVENT: Final = "links"  # kind of the event with what the links have seen when a run ends


@dataclass(frozen=True, slots=True)
class Run:
    """One job from Start to its end. Times are UTC seconds since 1970."""

    id: int
    cell_digest: str  # SHA-256 of `cell_text`
    cell_text: str  # frozen copy of the cell file
    software_version: str
    simulated: bool
    seed: int | None
    started_utc_s: float
    ended_utc_s: float | None
    end_state: str | None
    clean_close: bool | None  # None while open; False if closed after a crash


@dataclass(frozen=True, slots=True)
class PhasePlan:
    """The newest plan of one attempt at a phase; earlier revisions stay in the store."""

    run: int
    index: int  # position in the job, from 0
    name: str
    attempt: int
    revision: int  # from 1; grows when the plan is extended
    plan: JsonObject


@dataclass(frozen=True, slots=True)
class Sample:
    """One measurement as taken. `payload` holds values, scatter, source and receive time, quality, device."""

    id: int
    run: int
    phase: str
    attempt: int
    step: int
    kind: str
    payload: JsonObject
    digest: str  # SHA-256 over all of the above but the id
    utc_s: float
    mark: str | None  # None, "excluded" or "retake"; a marked sample enters no estimate
    mark_reason: str | None
    mark_who: str | None


@dataclass(frozen=True, slots=True)
class Result:
    """The outcome of one attempt at a phase, with what it came from."""

    id: int
    run: int
    phase: str
    attempt: int
    verdict: str
    result: JsonObject
    belief: JsonObject | None
    sample_ids: tuple[int, ...]
    samples_digest: str  # SHA-256 over the digests of those samples, in that order
    calibration: str | None  # content hash of the result that served as calibration
    content_hash: str  # SHA-256 over all of the above but the id
    utc_s: float


@dataclass(frozen=True, slots=True)
class Event:
    """One line of the audit trail; `hash` covers the line and the hash of the line before."""

    sequence: int  # from 1, without gaps
    utc_s: float
    kind: str
    text: str
    data: JsonObject
    previous_hash: str
    hash: str


def _plain(value: object) -> object:
    """Arrays and their scalars as lists and numbers."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__}")


def _path_of_non_finite(value: object, path: str) -> str | None:
    if isinstance(value, float):
        return None if math.isfinite(value) else f"{path} = {value}"
    if hasattr(value, "tolist"):
        return _path_of_non_finite(value.tolist(), path)
    if isinstance(value, Mapping):
        found = (_path_of_non_finite(v, f"{path}.{k}" if path else str(k)) for k, v in value.items())
    elif isinstance(value, list | tuple):
        found = (_path_of_non_finite(v, f"{path}[{i}]") for i, v in enumerate(value))
    else:
        return None
    return next((p for p in found if p), None)


def to_text(value: object) -> str:
    """Canonical JSON: sorted keys, no spaces. NaN and infinities are refused with their place."""
    try:
        return json.dumps(value, default=_plain, allow_nan=False, sort_keys=True, separators=(",", ":"))
    except ValueError:
        place = _path_of_non_finite(value, "") or "a value"
        raise RecordRefused(
            f"{place} is not finite", "Only finite numbers are recorded; mark the sample bad instead"
        ) from None
    except TypeError as error:
        raise RecordRefused(
            f"A record cannot hold this: {error}", "Give numbers, text, lists and maps"
        ) from None


def digest_of(*parts: object) -> str:
    """SHA-256 over the canonical text of the parts."""
    return sha256(to_text(parts).encode()).hexdigest()
