"""The record of the cell: one SQLite file that loses nothing it has acknowledged."""

from controller.store.records import Event, PhasePlan, Result, Run, Sample
from controller.store.store import Store

__all__ = ["Event", "PhasePlan", "Result", "Run", "Sample", "Store"]
