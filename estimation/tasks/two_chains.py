"""Measurements of one object by two robots, as one model: two chains, and one pose between the bases."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from estimation.belief import Belief, Value
from estimation.covariance import adjoint
from estimation.model import Model, Rows
from estimation.tasks.closed_forms import inverse
from estimation.transform import FloatArray, Transform

OTHER_BASE: Final = "base2"  # block of base1_T_base2


@dataclass(frozen=True, slots=True)
class Names:
    """How names of one robot's task are called beside the other robot: laser becomes laser2, and so on.

    `shared` are blocks of the object, and of a sensor that both have used, which keep their names: the pose
    of the object only for the first robot; in the base of the second it is object2.
    """

    number: int
    sensor: str
    shared: frozenset[str]

    def __call__(self, name: str) -> str:
        """Of a block, or of a source of noise."""
        if name in self.shared:
            return name
        if name == self.sensor or name.startswith((f"{self.sensor}.", f"{self.sensor} ")):
            return f"{self.sensor}{self.number}{name.removeprefix(self.sensor)}"
        return f"{name}{' ' if ' ' in name else ''}{self.number}"

    def frame(self, name: str) -> str:
        """Of a frame: base, flange and sensor are of this robot, the object is of both."""
        return f"{name}{self.number}" if name in ("base", "flange", self.sensor) else name

    def value(self, value: Value) -> Value:
        """A pose between frames of this robot."""
        if not isinstance(value, Transform):
            return value
        return Transform(self.frame(value.target), self.frame(value.source), value.matrix)


def merged(first: Belief, second: Belief, names: tuple[Names, Names]) -> Belief:
    """What is known of both. Of a shared block the longer one counts."""
    belief = Belief()
    shared = names[0].shared & names[1].shared
    for name, own, other in ((names[0], first, second), (names[1], second, first)):
        for block in own.names:
            if name(block) in belief:
                continue
            both = block in shared and block in other
            longer = both and len(other.block(block).freedoms) > len(own.block(block).freedoms)
            belief = _added(belief, other if longer else own, block, name)
    return belief


def _added(belief: Belief, source: Belief, block: str, name: Names) -> Belief:
    """The belief and a block of another one; all blocks of a prior are independent of each other."""
    given, place = source.block(block), source.index(block)
    size, total = belief.size, belief.size + len(given.freedoms)
    contributions = {label: _padded(matrix, total) for label, matrix in belief.contributions.items()}
    for label, matrix in source.contributions.items():
        own = matrix[place, place]
        if own.any():
            called = label if name(block) == block else name(label)
            contributions.setdefault(called, np.zeros((total, total)))[size:, size:] += own
    held = replace(given, name=name(block), value=name.value(given.value))
    return Belief((*belief.blocks, held), contributions)


def _padded(matrix: FloatArray, total: int) -> FloatArray:
    padded = np.zeros((total, total))
    padded[: len(matrix), : len(matrix)] = matrix
    return padded


def with_base(belief: Belief, one: str, other: str) -> Belief:
    """The posterior with base1_T_base2 in the place of base2_T_object.

    one, other : the poses base1_T_object and base2_T_object, whose errors a and b move base1_T_base2 by the
        twist Ad(base2_T_object) (a - b). Only with these the search is well conditioned: about a base that
        stands far away, a turn and a shift look nearly the same.
    """
    first, second = belief.transform(one), belief.transform(other)
    turned, place = adjoint(second.matrix), belief.index(other)
    change = np.eye(belief.size)
    change[place] = 0.0
    change[place, place] = -turned
    change[place, belief.index(one)] = turned[:, belief.block(one).active]
    pose = Transform("base1", "base2", first.matrix @ inverse(second.matrix))
    blocks = [replace(b, name=OTHER_BASE, value=pose) if b.name == other else b for b in belief.blocks]
    return Belief(
        tuple(blocks), {source: change @ matrix @ change.T for source, matrix in belief.contributions.items()}
    )


@dataclass(frozen=True, slots=True, eq=False)
class TwoChains:
    """Rows of the first robot, then of the second.

    Attributes
    ----------
    models : of the two tasks, in their own names; both have rows in groups of the same size.
    blocks : of each, the size of every vector (0 of a pose) that its model depends on, by its own name.
    """

    models: tuple[Model, Model]
    names: tuple[Names, Names]
    blocks: tuple[Mapping[str, int], Mapping[str, int]]

    def __len__(self) -> int:
        return len(self.models[0]) + len(self.models[1])

    def weighed_at(self, values: Mapping[str, Value]) -> "TwoChains":
        """Both keep the whitening that they have here."""
        first, second = (self.models[i].weighed_at(self.local(values, i)) for i in (0, 1))
        return replace(self, models=(first, second))

    def local(self, values: Mapping[str, Value], robot: int) -> dict[str, Value]:
        """Values as the task of one robot (0 or 1) has them."""
        found: dict[str, Value] = {}
        for name, size in self.blocks[robot].items():
            if (called := self.names[robot](name)) in values:
                value = values[called]
                # Of markers that are not known, one robot may have seen fewer.
                found[name] = value if isinstance(value, Transform) else value[:size]
        return found

    def rows(self, values: Mapping[str, Value]) -> Rows:
        """Residuals and derivatives. Raises EstimationError when a block is missing."""
        found = [self.models[i].rows(self.local(values, i)) for i in (0, 1)]
        counts = [len(each.residual_m) for each in found]
        jacobian: dict[str, FloatArray] = {}
        noise: dict[str, FloatArray] = {}
        for robot, each in enumerate(found):
            place = slice(robot * counts[0], robot * counts[0] + counts[robot])
            for name, matrix in each.jacobian.items():
                value = values.get(called := self.names[robot](name))
                width = matrix.shape[1] if value is None or isinstance(value, Transform) else value.size
                whole = jacobian.setdefault(called, np.zeros((sum(counts), width)))
                whole[place, : matrix.shape[1]] = matrix
            for source, variance in each.noise.items():
                noise.setdefault(self.names[robot](source), np.zeros(sum(counts)))[place] = variance
        return Rows(np.concatenate([each.residual_m for each in found]), jacobian, noise, found[0].group)
