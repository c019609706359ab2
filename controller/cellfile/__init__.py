"""The cell file: what stands in the cell and what it shall do."""

from controller.cellfile.cell import Cell
from controller.cellfile.job import CheckPhase, HandEyePhase, InspectPhase, LocalizePhase, NoisePhase, Phase
from controller.cellfile.loading import Feasibility, check_cell, load_cell
from controller.cellfile.mistakes import CellFileMistakes, Mistake, format_mistakes
from controller.cellfile.objects import Characteristic, Diameter, Flatness, Position

__all__ = [
    "Cell",
    "CellFileMistakes",
    "Characteristic",
    "CheckPhase",
    "Diameter",
    "Feasibility",
    "Flatness",
    "HandEyePhase",
    "InspectPhase",
    "LocalizePhase",
    "Mistake",
    "NoisePhase",
    "Phase",
    "Position",
    "check_cell",
    "format_mistakes",
    "load_cell",
]
