"""What the cell knows: named blocks, and one covariance kept as a sum of labelled contributions."""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import accumulate, compress
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from estimation.errors import EstimationError
from estimation.transform import FloatArray, Transform

POSE_FREEDOMS: Final = ("tx", "ty", "tz", "rx", "ry", "rz")
UNITS: Final = ("m", "rad", "rad/Nm")
Value = Transform | FloatArray
_ANGLES: Final = ("rx", "ry", "rz", "theta", "alpha", "beta", "tilt")  # labels that start so are in rad
_RATIOS: Final = ("scale",)
_LARGEST_NEGATIVE: Final = 1e-9  # of the largest eigenvalue of a correlation matrix: rounding, not a fault


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """One named quantity: a pose with some active freedoms, or a vector.

    The error of a pose is a right (body) perturbation xi = [t; phi] of its value (form A), of which
    `freedoms` are uncertain; the error of a vector adds to it. Of those in `flat` nothing is known yet:
    they have no prior, and the value is only where an estimator starts.
    """

    name: str
    value: Value
    freedoms: tuple[str, ...]
    units: tuple[str, ...]
    flat: tuple[str, ...] = ()

    @property
    def active(self) -> NDArray[np.intp]:
        """Places of the freedoms in the full perturbation (6,) of a pose, or in the vector."""
        if isinstance(self.value, Transform):
            return _places_in_pose(self.freedoms)
        return np.arange(len(self.freedoms), dtype=np.intp)


@dataclass(frozen=True, eq=False)
class Belief:
    """Blocks in order, and the covariance of their errors by source. Build it with `with_block`.

    `contributions[source]` is (n, n): what an error of that source puts into the covariance of the
    stacked freedoms (m, rad, or none). Their sum is the covariance, so they are the uncertainty budget.
    A flat freedom has zeros in each contribution, and a belief that has one has no covariance.
    """

    blocks: tuple[Block, ...] = ()
    contributions: Mapping[str, FloatArray] = ()  # type: ignore[assignment]  # replaced by {} below

    def __post_init__(self) -> None:
        if not self.contributions:
            object.__setattr__(self, "contributions", {})
            return
        size = self.size
        # Symmetric to the last bit, so that one triangle says everything.
        symmetric = {source: 0.5 * (matrix + matrix.T) for source, matrix in self.contributions.items()}
        for source, matrix in symmetric.items():
            if matrix.shape != (size, size) or not np.isfinite(matrix).all():
                raise EstimationError(
                    f"Contribution {source!r} is {matrix.shape} or not finite, state has {size} unknowns",
                    "Check the prior and the measurements of that source",
                )
            matrix.flags.writeable = False
        object.__setattr__(self, "contributions", symmetric)

    @cached_property
    def size(self) -> int:
        """Number of unknowns n."""
        return sum(len(block.freedoms) for block in self.blocks)

    @cached_property
    def covariance(self) -> FloatArray:
        """(n, n): the sum of the contributions. Raises EstimationError while a freedom is flat."""
        if self.flat.any():
            named = ", ".join(label for label, flat in zip(self.labels, self.flat, strict=True) if flat)
            raise EstimationError(f"Nothing is known yet of {named}", "Estimate it from measurements first")
        return self.prior_covariance

    @cached_property
    def flat(self) -> NDArray[np.bool_]:
        """(n,) True for freedoms without a prior."""
        return np.array([each in block.flat for block in self.blocks for each in block.freedoms], np.bool_)

    @cached_property
    def unit_codes(self) -> NDArray[np.intp]:
        """(n,) place of the unit of each freedom in `UNITS`, or behind them for another one."""
        units = [unit for block in self.blocks for unit in block.units]
        every = list(dict.fromkeys((*UNITS, *units)))
        return np.array([every.index(unit) for unit in units], dtype=np.intp)

    @cached_property
    def prior_covariance(self) -> FloatArray:
        """(n, n): as the covariance, with zeros for flat freedoms."""
        total = np.zeros((self.size, self.size))
        for matrix in self.contributions.values():
            total = total + matrix
        total.flags.writeable = False
        return total

    @cached_property
    def _places(self) -> dict[str, tuple[Block, slice]]:
        ends = accumulate(len(block.freedoms) for block in self.blocks)
        return {
            block.name: (block, slice(end - len(block.freedoms), end))
            for block, end in zip(self.blocks, ends, strict=True)
        }

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the blocks, in order."""
        return tuple(block.name for block in self.blocks)

    @property
    def labels(self) -> tuple[str, ...]:
        """ "block.freedom" of each unknown (n,)."""
        return tuple(f"{block.name}.{freedom}" for block in self.blocks for freedom in block.freedoms)

    def __contains__(self, name: str) -> bool:
        return name in self._places

    def block(self, name: str) -> Block:
        """The block; raises EstimationError when there is none of that name."""
        return self._place(name)[0]

    def index(self, name: str) -> slice:
        """Where the freedoms of the block stand in the state."""
        return self._place(name)[1]

    def columns(self, names: Iterable[str]) -> NDArray[np.intp]:
        """Places of all freedoms of some blocks in the state."""
        every = range(self.size)
        return np.array([column for name in names for column in every[self.index(name)]], dtype=np.intp)

    def value(self, name: str) -> Value:
        """Value of the block: a Transform, or a vector."""
        return self.block(name).value

    def transform(self, name: str) -> Transform:
        """Value of a pose block."""
        value = self.value(name)
        if not isinstance(value, Transform):
            raise EstimationError(f"Block {name!r} is not a pose", "Use vector() or scalar()")
        return value

    def vector(self, name: str) -> FloatArray:
        """Value of a vector block (k,)."""
        value = self.value(name)
        if isinstance(value, Transform):
            raise EstimationError(f"Block {name!r} is a pose", "Use transform()")
        return value

    def scalar(self, name: str) -> float:
        """Value of a vector block with one element."""
        return float(self.vector(name).item())

    def block_covariance(self, name: str) -> FloatArray:
        """Covariance (k, k) of the freedoms of one block."""
        place = self.index(name)
        return self.covariance[place, place]

    def std(self, name: str) -> FloatArray:
        """Standard uncertainties (k,) of the freedoms of one block."""
        return np.sqrt(np.diag(self.block_covariance(name)))

    def with_block(
        self,
        name: str,
        value: Value | float | Sequence[float],
        *,
        std: float | Sequence[float] | FloatArray | None = None,
        covariance: FloatArray | None = None,
        freedoms: Sequence[str] | None = None,
        units: Sequence[str] | None = None,
        source: str | None = None,
    ) -> "Belief":
        """This belief and a new block with a prior that is independent of all others.

        Parameters
        ----------
        std, covariance : one of them; std is a number for all freedoms or one for each. An infinite std
            leaves the freedom flat: without a prior.
        freedoms : active freedoms of a pose (all six by default), or names of the vector's elements.
        units : by default "rad" for names that start like an angle, "1" for a scale, otherwise "m".
        source : label of the prior in the budget; the block's name by default.
        """
        if name in self:
            raise EstimationError(f"Block {name!r} is there already", "Remove it first with without()")
        held: Value = value if isinstance(value, Transform) else np.array(value, dtype=np.float64).reshape(-1)
        if freedoms is None:
            freedoms = POSE_FREEDOMS if isinstance(held, Transform) else _element_names(name, held.size)
        if isinstance(held, Transform):
            if tuple(freedoms) != tuple(each for each in POSE_FREEDOMS if each in freedoms):
                raise EstimationError(
                    f"Freedoms {', '.join(freedoms)} of pose {name!r}",
                    f"Choose some of {', '.join(POSE_FREEDOMS)}, in that order",
                )
        elif len(freedoms) != held.size:
            raise EstimationError(
                f"{len(freedoms)} freedoms for the {held.size} elements of {name!r}", "Name each element"
            )
        if not np.isfinite(held.matrix if isinstance(held, Transform) else held).all():
            raise EstimationError(f"Value of {name!r} is not finite", "Check what it comes from")
        prior, unknown = _prior(name, len(freedoms), std, covariance)
        flat = tuple(compress(freedoms, unknown))
        units = tuple(units or [unit_of(label) for label in freedoms])
        block = Block(name, held, tuple(freedoms), units, flat)
        size, total = self.size, self.size + len(freedoms)
        contributions = {key: _padded(matrix, total) for key, matrix in self.contributions.items()}
        if len(flat) < len(freedoms):
            label = source or name
            added = contributions.get(label, np.zeros((total, total))).copy()
            added[size:, size:] += prior
            contributions[label] = added
        return Belief((*self.blocks, block), contributions)

    def marginal(self, names: Iterable[str]) -> "Belief":
        """Only these blocks, in the order given; the others stay in the covariance as what they caused."""
        chosen = tuple(names)
        order = self.columns(chosen)
        grid = np.ix_(order, order)
        kept = {source: matrix[grid] for source, matrix in self.contributions.items()}
        return Belief(
            tuple(self.block(name) for name in chosen),
            {source: matrix for source, matrix in kept.items() if matrix.any()},
        )

    def without(self, names: Iterable[str]) -> "Belief":
        """All but these blocks; names that are not there are ignored."""
        dropped = set(names)
        return self.marginal(name for name in self.names if name not in dropped)

    def replaced(self, values: Mapping[str, Value], contributions: Mapping[str, FloatArray]) -> "Belief":
        """The same blocks with other values and contributions, none flat; what an estimator returns."""
        blocks = tuple(
            Block(block.name, values.get(block.name, block.value), block.freedoms, block.units)
            for block in self.blocks
        )
        return Belief(blocks, contributions)

    def started(self, values: Mapping[str, Value]) -> "Belief":
        """The same belief with other values of its flat blocks: where an estimator starts."""
        for name in values:
            if self.block(name).flat != self.block(name).freedoms:
                raise EstimationError(
                    f"{name!r} has a prior", "Start from its value, or leave the block flat"
                )
        blocks = tuple(
            Block(each.name, values.get(each.name, each.value), each.freedoms, each.units, each.flat)
            for each in self.blocks
        )
        return Belief(blocks, self.contributions)

    def budget(self, jacobian: FloatArray) -> dict[str, FloatArray]:
        """Covariance G C_s G^T of quantities with jacobian G (..., k, n), source by source."""
        return {
            source: jacobian @ matrix @ np.swapaxes(jacobian, -1, -2)
            for source, matrix in self.contributions.items()
        }

    def digest(self) -> str:
        """SHA-256 (hex) of everything in here: equal beliefs have equal digests, on any machine."""
        digest = hashlib.sha256()
        for block in self.blocks:
            frames = (
                (block.value.target, block.value.source) if isinstance(block.value, Transform) else ("", "")
            )
            digest.update(repr((block.name, frames, block.freedoms, block.units, block.flat)).encode())
            digest.update(_bytes(_array(block.value)))
        for source in sorted(self.contributions):
            digest.update(repr(source).encode())
            digest.update(_bytes(self.contributions[source]))
        return digest.hexdigest()

    def to_dict(self) -> dict[str, Any]:
        """For JSON. Floats survive exactly; of each contribution the upper triangle is kept."""
        upper = np.triu_indices(self.size)
        return {
            "blocks": [
                {
                    "name": block.name,
                    "frames": [block.value.target, block.value.source]
                    if isinstance(block.value, Transform)
                    else None,
                    "value": _array(block.value).tolist(),
                    "freedoms": list(block.freedoms),
                    "units": list(block.units),
                    "flat": list(block.flat),
                }
                for block in self.blocks
            ],
            "contributions": {
                source: matrix[upper].tolist() for source, matrix in self.contributions.items()
            },
        }

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> "Belief":
        """The inverse of `to_dict`; raises EstimationError when the data are not a belief."""
        try:
            blocks = tuple(
                Block(
                    entry["name"],
                    _restored(entry["value"], entry["frames"]),
                    tuple(entry["freedoms"]),
                    tuple(entry["units"]),
                    tuple(entry["flat"]),
                )
                for entry in data["blocks"]
            )
            size = sum(len(block.freedoms) for block in blocks)
            upper = np.triu_indices(size)
            contributions = {}
            for source, triangle in data["contributions"].items():
                matrix = np.zeros((size, size))
                matrix[upper] = triangle
                matrix.T[upper] = triangle
                contributions[source] = matrix
        except (KeyError, TypeError, ValueError) as error:
            raise EstimationError(f"Not a stored belief: {error!r}", "Was the record damaged?") from error
        return Belief(blocks, contributions)

    def _place(self, name: str) -> tuple[Block, slice]:
        if name not in self._places:
            raise EstimationError(
                f"The belief has no block {name!r}, only {', '.join(self.names) or 'nothing'}",
                "Run the phase that adds it first",
            )
        return self._places[name]


@cache
def _places_in_pose(freedoms: tuple[str, ...]) -> NDArray[np.intp]:
    places = np.array([POSE_FREEDOMS.index(name) for name in freedoms], dtype=np.intp)
    places.flags.writeable = False
    return places


def unit_of(label: str) -> str:
    """Unit of a freedom by its label: "rad", "1" or "m"."""
    if label.startswith(_RATIOS):
        return "1"
    return "rad" if label.startswith(_ANGLES) else "m"


def _element_names(name: str, count: int) -> tuple[str, ...]:
    last = name.rpartition(".")[2]
    return (last,) if count == 1 else tuple(f"{last}[{i}]" for i in range(count))


def _prior(
    name: str, size: int, std: float | Sequence[float] | FloatArray | None, covariance: FloatArray | None
) -> tuple[FloatArray, Sequence[bool]]:
    """Covariance with zeros for the freedoms of which nothing is known, and which those are."""
    if (std is None) == (covariance is None):
        raise EstimationError(f"Prior of {name!r}", "Give either std or covariance")
    if std is not None:
        if isinstance(std, float) and std == np.inf:
            return np.zeros((size, size)), [True] * size
        spread = np.empty(size)
        spread[:] = std
        if not (spread >= 0.0).all():
            raise EstimationError(f"Prior std of {name!r} is {spread}", "Give numbers, not below zero")
        unknown = np.isinf(spread)
        spread[unknown] = 0.0
        return np.diag(spread**2), unknown.tolist()
    prior = np.asarray(covariance, dtype=np.float64)
    if prior.shape != (size, size) or not np.isfinite(prior).all() or not np.allclose(prior, prior.T):
        raise EstimationError(f"Prior of {name!r} is not a symmetric {size} x {size} matrix", "Check it")
    scale = np.sqrt(np.maximum(np.diag(prior), 0.0))
    scale[scale == 0.0] = 1.0
    if np.linalg.eigvalsh(prior / np.outer(scale, scale))[0] < -_LARGEST_NEGATIVE * size:
        raise EstimationError(f"Prior of {name!r} has a negative variance in some direction", "Check it")
    return prior, [False] * size


def _restored(value: Any, frames: Sequence[str] | None) -> Value:
    array: FloatArray = np.array(value, dtype=np.float64)
    if frames is None:
        return array.reshape(-1)
    target, source = frames
    return Transform(target, source, array.reshape(4, 4))


def _padded(matrix: FloatArray, size: int) -> FloatArray:
    padded = np.zeros((size, size))
    padded[: len(matrix), : len(matrix)] = matrix
    return padded


def _array(value: Value) -> FloatArray:
    return value.matrix if isinstance(value, Transform) else value


def _bytes(values: FloatArray) -> bytes:
    return np.ascontiguousarray(values, dtype="<f8").tobytes()
