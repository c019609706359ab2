"""The record of the cell: one SQLite file that loses nothing it has acknowledged."""

from controller.store.records import Event, PhasePlan, RecordNotFound, RecordRefused, Result, Run, Sample
from controller.store.store import Store

__all__ = ["Event", "PhasePlan", "RecordNotFound", "RecordRefused", "Result", "Run", "Sample", "Store"]
