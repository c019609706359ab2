"""The importer of each program, and which one a file is for."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from controller.offline.importers import easy_handeye, moveit, robot_cal_tools
from controller.offline.importers.given import Given
from controller.offline.importers.names import Program
from controller.offline.importers.yaml_tree import Tree, read_tree


@dataclass(frozen=True, slots=True)
class _Importer:
    recognises: Callable[[Tree], bool]
    read: Callable[[Tree, Given], dict[str, Any]]


_IMPORTERS: Final = {
    Program.EASY_HANDEYE: _Importer(easy_handeye.recognises, easy_handeye.read),
    Program.MOVEIT: _Importer(moveit.recognises, moveit.read),
    Program.ROBOT_CAL_TOOLS: _Importer(robot_cal_tools.recognises, robot_cal_tools.read),
}


def imported(path: Path, program: Program | None, given: Given) -> dict[str, Any]:
    """The content of a data set (docs/datasets.md) from a file of this program, or of the one it looks like.

    Raises BadFile with the line for what cannot be read, BadInput for what the file does not say.
    """
    root = read_tree(path)
    if program is None:
        program = next((name for name, each in _IMPORTERS.items() if each.recognises(root)), None)
    if program is None:
        raise root.refusal(
            f"not recognised as a file of {', '.join(_IMPORTERS)}",
            "Say whose it is with --from, or write a data set (docs/datasets.md)",
        )
    return _IMPORTERS[program].read(root, given)
