"""Data sets of the estimator: one JSON form, read as a whole, each mistake with its line."""

import json
import re
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError

from controller.cellfile.lines import KeyPath, LineIndex
from controller.cellfile.mistakes import Mistake, Source, format_mistakes, nearest
from controller.cellfile.translate import mistakes_of
from controller.offline.dataset_kinematics import KINEMATIC_DATASETS
from controller.offline.dataset_localization import LocalizationDataset
from controller.offline.dataset_pairs import PAIR_DATASETS
from controller.offline.dataset_parts import Dataset
from controller.offline.dataset_positioner import POSITIONER_DATASETS
from controller.offline.dataset_tasks import SENSOR_DATASETS
from controller.offline.dataset_two_robots import TwoRobotsDataset
from controller.offline.refusal import BadFile
from controller.quantities import shown
from estimation.localization.task import Localization
from estimation.tasks.two_robots import TwoRobots

DATASETS: Final[dict[str, type[Dataset]]] = {
    **SENSOR_DATASETS,
    **PAIR_DATASETS,
    **KINEMATIC_DATASETS,
    TwoRobots.task: TwoRobotsDataset,
    **POSITIONER_DATASETS,
    Localization.task: LocalizationDataset,
}
_MOST_SHOWN: Final = 10
_TOKEN: Final = re.compile(r'"(?:[^"\\]|\\.)*"|[{}\[\],:]|[^\s{}\[\],:"]+|\n')
_ROW: Final = re.compile(r"\[\s+([^\[\]{}]*?)\s+\]")
_SPACE: Final = re.compile(r"\s+")


def schema_of(task: str) -> dict[str, Any]:
    """JSON schema of the data set of a task. Raises BadFile for a task that there is not."""
    if task not in DATASETS:
        raise BadFile(f"There is no task {task!r}", _remedy(task))
    return DATASETS[task].model_json_schema(by_alias=True)


def read_dataset(path: Path, columns: dict[KeyPath, Any] | None = None) -> Dataset:
    """The data set of a file.

    columns : arrays that come from elsewhere, such as a CSV, by their place in the form.

    Raises BadFile with all mistakes of the file, each in one sentence with its line and key.
    """
    if not path.is_file():
        raise BadFile(f"{path}: there is no such file", "Name a data set in JSON")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise BadFile(f"{path}: cannot be read as text ({error})", "Name a data set in JSON") from error
    try:
        data = json.loads(text, object_pairs_hook=_distinct, parse_constant=_no_number)
    except json.JSONDecodeError as error:
        raise BadFile(f"{path.name}:{error.lineno}: not JSON, {error.msg}", "Correct this line") from error
    except _NoNumber as error:
        line = _line_of(text, error.word)
        raise BadFile(
            f"{path.name}:{line}: {error.word} is not a finite number", "Correct this line"
        ) from error
    except (ValueError, RecursionError) as error:
        raise BadFile(f"{path.name}: {error}", "Correct the file") from error
    if not isinstance(data, dict):
        raise BadFile(f"{path.name}:1: not an object", 'Write {"truecell_dataset": 1, "task": ...}')
    for place, values in (columns or {}).items():
        _put(data, place, values, path.name)
    task = data.get("task")
    if not isinstance(task, str) or task not in DATASETS:
        source = Source(path.name, text, LineIndex(_lines(text)), data)
        if "task" not in data:
            raise _refusal(source, [source.mistake(("task",), "key is missing", _remedy(""))])
        raise _refusal(source, [source.mistake(("task",), "unknown task", _remedy(str(task)))])
    return _validated(path.name, text, data, task)


def units_at(path: Path, csv: Path | None = None) -> str:
    """Where a data set that was read says how lengths are meant: file and line, of each part with units."""
    lines = _lines(path.read_text(encoding="utf-8-sig"))
    places = [f"{path.name}:{line}" for key, line in lines.items() if key[-2:] == ("units", "length")]
    return " and ".join(places) or f"the header of {csv.name if csv is not None else path.name}"


def dataset_of(content: dict[str, Any], name: str) -> Dataset:
    """The data set of content that was made from a file of that name. Raises BadFile."""
    return _validated(name, "", content, content["task"])


def as_text(content: dict[str, Any]) -> str:
    """Content as JSON, one row of numbers a line."""
    text = json.dumps(content, indent=1)
    return _ROW.sub(lambda match: "[" + _SPACE.sub(" ", match[1]) + "]", text) + "\n"


def _validated(name: str, text: str, data: dict[str, Any], task: str) -> Dataset:
    form = DATASETS[task]
    try:
        dataset = form.model_validate_json(json.dumps(data))
    except ValidationError as error:
        source = Source(name, text, LineIndex(_lines(text)), data, schema_of(task))
        raise _refusal(source, mistakes_of(error.errors(include_url=False), source)) from error
    if wrong := list(dataset.wrong()):
        source = Source(name, text, LineIndex(_lines(text)), data, schema_of(task))
        raise _refusal(source, [source.mistake(*each) for each in wrong])
    return dataset


def _refusal(source: Source, mistakes: list[Mistake]) -> BadFile:
    first = sorted(mistakes, key=lambda mistake: mistake.line)[:_MOST_SHOWN]
    more = f"\nand {len(mistakes) - len(first)} more" if len(mistakes) > len(first) else ""
    return BadFile(format_mistakes(first) + more, "Correct the file; docs/datasets.md has every key")


def _remedy(task: str) -> str:
    return nearest(task, list(DATASETS))


def _put(data: dict[str, Any], place: KeyPath, values: object, name: str) -> None:
    """Raises BadFile where the file has other values there itself."""
    here: Any = data
    for step in place[:-1]:
        here = here.setdefault(step, {}) if isinstance(here, dict) else {}
    if here.setdefault(place[-1], values) != values:
        key = ".".join(map(str, place))
        raise BadFile(
            f"{name}: {key} is {shown(here[place[-1]])}, in the table it is {shown(values)}",
            "Take it out of the data set, or make them agree",
        )


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    names = [name for name, _ in pairs]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {twice!r} stands twice in one object")
    return dict(pairs)


class _NoNumber(Exception):
    """NaN or Infinity, which JSON does not have and many write; never leaves this file."""

    def __init__(self, word: str) -> None:
        super().__init__(word)
        self.word = word


def _no_number(word: str) -> float:
    raise _NoNumber(word)


def _line_of(text: str, word: str) -> int:
    """The line on which the word first stands, not in quotes."""
    line = 1
    for match in _TOKEN.finditer(text):
        if match[0] == word:
            break
        line += match[0] == "\n"
    return line


def _lines(text: str) -> dict[KeyPath, int]:
    """The line on which each value of a sound JSON text begins."""
    lines: dict[KeyPath, int] = {}
    path: list[str | int] = []  # of the value that comes next
    open_in: list[str] = []
    line, wants_key = 1, False
    for match in _TOKEN.finditer(text):
        token = match[0]
        if token == "\n":
            line += 1
        elif token in "}]":
            open_in.pop()
            path.pop()
        elif token == ",":
            wants_key = open_in[-1] == "{"
            if not wants_key:
                path[-1] = int(path[-1]) + 1
        elif token == ":":
            wants_key = False
        elif wants_key:
            path[-1] = json.loads(token)
        else:
            lines[tuple(path)] = line
            if token in "{[":
                open_in.append(token)
                path.append("" if token == "{" else 0)
                wants_key = token == "{"
    return lines
