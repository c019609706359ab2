"""The cell file: what stands in the cell and what it shall do."""

from controller.cellfile.cell import Cell
from controller.cellfile.loading import Feasibility, check_cell, load_cell
from controller.cellfile.mistakes import CellFileMistakes, Mistake, format_mistakes

__all__ = ["Cell", "CellFileMistakes", "Feasibility", "Mistake", "check_cell", "format_mistakes", "load_cell"]
