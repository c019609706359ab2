"""A YAML file as a tree whose every refusal names file, line and key."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from controller.offline.refusal import BadFile
from controller.quantities import shown
from estimation.tasks.checks import LARGEST_LENGTH_M
from estimation.transform import FloatArray

# More than YAML 1.1 calls a number: yaml-cpp writes 1e-05, without a point.
_NUMBER: Final = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_LARGEST_QUATERNION_ERROR: Final = 1e-3  # of its length from 1: quaternions written with four digits pass
_LOADER: Final = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True, slots=True)
class Tree:
    """One value of the file: `key` is how people find it."""

    file: str
    key: str
    node: yaml.Node

    @property
    def line(self) -> int:
        """From 1."""
        return int(self.node.start_mark.line) + 1

    def refusal(self, problem: str, remedy: str) -> BadFile:
        """What is wrong here, to be raised."""
        place = f"{self.file}:{self.line}: " + (f"{self.key}: " if self.key else "")
        return BadFile(place + problem, remedy)

    def table(self) -> dict[str, "Tree"]:
        """Values by their keys. Raises BadFile for anything but a mapping, and for keys that stand twice."""
        if not isinstance(self.node, yaml.MappingNode):
            raise self.refusal("not a table of keys and values", "Check the file against its program")
        found: dict[str, Tree] = {}
        for name, value in self.node.value:
            key = str(name.value)
            if key in found:
                line = int(name.start_mark.line) + 1
                raise BadFile(f"{self.file}:{line}: the key {key!r} stands twice", "Take one out")
            found[key] = Tree(self.file, f"{self.key}.{key}" if self.key else key, value)
        return found

    def __getitem__(self, key: str) -> "Tree":
        """Raises BadFile where it is missing."""
        table = self.table()
        if key not in table:
            has = ", ".join(table) or "nothing"
            raise self.refusal(f"the key {key!r} is missing, here are {has}", "Check the file")
        return table[key]

    def has(self, *keys: str) -> bool:
        """Whether this is a table with all these keys."""
        if not isinstance(self.node, yaml.MappingNode):
            return False
        return set(keys) <= {str(name.value) for name, _ in self.node.value}

    def rows(self) -> list["Tree"]:
        """Values of a list. Raises BadFile for anything else, and for a list without any."""
        if not isinstance(self.node, yaml.SequenceNode) or not self.node.value:
            raise self.refusal("not a list with something in it", "Check the file against its program")
        return [Tree(self.file, f"{self.key}[{i}]", each) for i, each in enumerate(self.node.value, 1)]

    def is_list(self) -> bool:
        """Whether this is a list."""
        return isinstance(self.node, yaml.SequenceNode)

    def text(self) -> str:
        """Raises BadFile for a table or a list."""
        if not isinstance(self.node, yaml.ScalarNode):
            raise self.refusal("not a single value", "Check the file against its program")
        return str(self.node.value)

    def number(self) -> float:
        """Raises BadFile for anything but a finite number."""
        text = self.text().strip()
        if not _NUMBER.fullmatch(text):
            remedy = "Write decimal points" if re.fullmatch(r"[-+]?\d+,\d+", text) else "Mend it"
            raise self.refusal(f"{shown(text)} is not a finite number", remedy)
        value = float(text)
        if not np.isfinite(value):
            raise self.refusal(f"{shown(text)} is not a finite number", "Mend it")
        return value

    def length_m(self) -> float:
        """A coordinate. Raises BadFile for one that cannot be in metres."""
        value = self.number()
        if abs(value) > LARGEST_LENGTH_M:
            raise self.refusal(
                f"{value:g} m, limit {LARGEST_LENGTH_M:g} m: these files are in metres",
                "If this one is in millimetres, divide its coordinates by 1000",
            )
        return value


def read_tree(path: Path) -> Tree:
    """The root of a file. Raises BadFile where it is empty, no text, or no YAML."""
    if not path.is_file():
        raise BadFile(f"{path}: there is no such file", "Name a YAML file")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise BadFile(f"{path}: cannot be read as text ({error})", "Name a YAML file") from error
    try:
        root = yaml.compose(text, Loader=_LOADER)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = 1 if mark is None else mark.line + 1
        raise BadFile(f"{path.name}:{line}: not YAML, {error.problem}", "Correct this line") from error
    except (yaml.YAMLError, RecursionError) as error:
        raise BadFile(f"{path.name}: not YAML ({type(error).__name__})", "Check the file") from error
    if root is None:
        raise BadFile(f"{path.name}: the file is empty", "Save the samples again")
    return Tree(path.name, "", root)


def point_of(place: Tree) -> list[float]:
    """x, y, z, metres."""
    return [place[axis].length_m() for axis in "xyz"]


def pose_of(position: Tree, rotation: Tree, names: Sequence[str] = ("x", "y", "z", "w")) -> FloatArray:
    """(4, 4) of a position and a quaternion with these names of x, y, z and w, metres."""
    quaternion = np.array([rotation[name].number() for name in names])
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > _LARGEST_QUATERNION_ERROR:
        raise rotation.refusal(
            f"a quaternion of length {length:.4g}, must be 1 to {_LARGEST_QUATERNION_ERROR:g}",
            "Check its four numbers",
        )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), point_of(position)
    return pose
