"""The files of `truecell plan --output`."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from estimation.errors import CellFileError

if TYPE_CHECKING:
    from controller.cellfile import Cell
    from controller.dry_run import PlannedPhase


def write_plan(folder: Path, cell: "Cell", phases: Sequence["PlannedPhase"]) -> list[Path]:
    """Write plan.json, plan.html and the robot's program; returns what was written.

    Raises CellFileError where the folder cannot be written.
    """
    from controller.plan_page import page_of
    from controller.robot_programs import program_of
    from controller.robots import abilities_as_words, abilities_of

    document = {
        "cell": cell.name,
        "cell_digest": cell.digest,
        "simulated": cell.simulated,
        "robot": abilities_as_words(abilities_of(cell.robot)),
        "phases": [phase.to_dict() for phase in phases],
    }
    files = {"plan.json": json.dumps(document, indent=1) + "\n", "plan.html": page_of(cell, phases)}
    program = program_of(cell, [step for phase in phases for step in phase.plan.steps])
    if program is not None:
        name, text = program
        files[name] = text
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise CellFileError(
            f"The plan cannot be written to {folder}: {error.strerror}", "Name a folder that can be written"
        ) from None
    return [folder / name for name in files]
