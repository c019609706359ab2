"""The record of the cell: one SQLite file that loses nothing it has acknowledged."""

from controller.store.records import (
    LINKS_EVENT,
    Event,
    PhasePlan,
    RecordNotFound,
    RecordRefused,
    Result,
    Run,
    Sample,
)
from controller.store.store import Store

__all__ = [
    "LINKS_EVENT",
    "Event",
    "PhasePlan",
    "RecordNotFound",
    "RecordRefused",
    "Result",
    "Run",
    "Sample",
    "Store",
]
