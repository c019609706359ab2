"""Gauge freedoms: parameters that a kind of measurement cannot tell apart, and which of them are held."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.belief import Belief
from estimation.observability import RANK_TOLERANCE, freedom_words, spectrum_of
from estimation.transform import FloatArray, Transform

_TAKES_PART: Final = 0.02  # of a unit direction: smaller components are other directions leaking in
_NAMED_SHARE: Final = 5e-3  # of the held parameter's own effect


@dataclass(frozen=True, slots=True, eq=False)
class Effect:
    """What directions of the state do where nothing was measured.

    `matrix` (e, n) by the state, with a gauge having no effect; `size` (n,) of each freedom's own effect.
    """

    matrix: FloatArray
    size: FloatArray


@dataclass(frozen=True, slots=True)
class Gauge:
    """A freedom with no effect on any measurement of a kind, and the parameter that is held for it.

    Attributes
    ----------
    held : label of the parameter that keeps its nominal value, "block.freedom".
    partners : (label, amount) of what takes over for it: one unit of the held parameter together with these
        amounts changes no measurement; m, rad, or as their units are.
    words : the same as a sentence.
    """

    held: str
    partners: tuple[tuple[str, float], ...]
    words: str


def gauges(
    belief: Belief,
    jacobian: FloatArray,
    variance: FloatArray,
    order: Sequence[str],
    effect: Effect,
    tolerance: float = RANK_TOLERANCE,
) -> tuple[Gauge, ...]:
    """Freedoms of the flat part of a belief that no measurement sees, whatever else is measured.

    Parameters
    ----------
    jacobian, variance : (m, n) by the state and (m,), m^2, of the measurements.
    order : labels of what may be held. For each freedom the first that takes part in it is.
    effect : what would matter elsewhere. A direction that the measurements do not see and that has such an
        effect is no gauge: better measurements would see it.
    tolerance : smallest over largest singular value that counts as seen, or as an effect.

    Returns
    -------
    One gauge for each freedom that a label of `order` can fix; others remain, for the estimator to refuse.
    """
    columns = np.flatnonzero(belief.flat)
    if not len(columns):
        return ()
    seen = spectrum_of(belief, jacobian, variance, columns, tolerance)
    scale = seen.scale
    whole = _harmless(seen.null, scale, columns, effect, tolerance)
    labels = [belief.labels[column] for column in columns]
    places = {label: place for place, label in enumerate(labels)}
    held: list[int] = []
    open_ = whole
    for label in order:
        if not len(open_):
            break
        if label in places and np.linalg.norm(open_[:, places[label]]) > _TAKES_PART:
            held.append(places[label])
            open_ = _without(open_, places[label])
    if not held:
        return ()
    # Each direction with one of the held parameters alone; what is left open has none of them.
    closed = _complement(whole, open_)
    single = np.linalg.solve(closed[:, held], closed)
    rows = zip(held, single, strict=True)
    return tuple(_gauge(belief, labels, held, place, row, scale) for place, row in rows)


def _harmless(
    basis: FloatArray, scale: FloatArray, columns: NDArray[np.intp], effect: Effect, tolerance: float
) -> FloatArray:
    """Orthonormal basis of the directions of `basis` (k, q) that have no effect."""
    if not len(basis):
        return basis
    directions = (basis / scale).T
    largest = float(np.max(effect.size[columns] / scale))
    _, strength, turned = np.linalg.svd(effect.matrix[:, columns] @ directions)
    strength = np.append(strength, np.zeros(len(basis) - len(strength)))
    return np.asarray(turned[strength <= tolerance * largest] @ basis)


def _without(basis: FloatArray, place: int) -> FloatArray:
    """Orthonormal basis (k - 1, q) of the directions of `basis` (k, q) that leave one freedom at rest."""
    turned = np.linalg.svd(basis[:, place : place + 1])[0]
    return np.asarray(turned[:, 1:].T @ basis)


def _complement(basis: FloatArray, part: FloatArray) -> FloatArray:
    """Orthonormal basis of what `basis` spans and `part`, within it, does not."""
    if not len(part):
        return basis
    inside = basis @ part.T
    turned = np.linalg.svd(inside)[0]
    return np.asarray(turned[:, len(part) :].T @ basis)


def _gauge(
    belief: Belief, labels: Sequence[str], held: Sequence[int], place: int, row: FloatArray, scale: FloatArray
) -> Gauge:
    amounts = row * scale[place] / scale
    shares = np.abs(row)
    shares[list(held)] = 0.0
    named = np.flatnonzero(shares > _NAMED_SHARE * np.abs(row).max())
    named = named[np.argsort(-shares[named], kind="stable")]
    partners = tuple((labels[i], float(amounts[i])) for i in named.tolist())
    return Gauge(labels[place], partners, _words(belief, labels[place], [label for label, _ in partners]))


def _words(belief: Belief, held: str, partners: Sequence[str]) -> str:
    name = freedom_words(belief, held)
    if not partners:
        return f"{name} is not seen by such measurements"
    others = list(dict.fromkeys(_partner(belief, held, label) for label in partners))
    listed = others[0] if len(others) == 1 else f"{', '.join(others[:-1])} and {others[-1]}"
    return f"{name} cannot be told apart from {listed}"


def _partner(belief: Belief, held: str, label: str) -> str:
    """Poses and other vectors as a whole: which of their numbers take part depends on the frame."""
    block, own = label.rpartition(".")[0], held.rpartition(".")[0]
    if isinstance(belief.value(block), Transform):
        return f"the pose of the {block}"
    if block != own and len(belief.block(block).freedoms) > 1:
        return f"the {block}"
    return freedom_words(belief, label)
