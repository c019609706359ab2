"""Which directions of the state the data determine, and in words which they do not."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from estimation.belief import POSE_FREEDOMS, UNITS, Belief
from estimation.errors import DegenerateGeometry
from estimation.transform import FloatArray, Transform

# Smallest over largest singular value. Hand-eye poses with a tilt up to 28 deg give 1e-2, up to 10 deg 2e-3
# (and a standard deviation of 0.8 mm), equal orientations with settling errors of 0.005 deg less than 1e-4.
RANK_TOLERANCE: Final = 1e-3
_SHORTEST_LEVER_M: Final = 1e-6  # between an angle and what it moves
_ROUNDING: Final = 1e-12  # of the smallest eigenvalue over the largest
_METRE, _RADIAN, _YIELD = (UNITS.index(unit) for unit in ("m", "rad", "rad/Nm"))
_SMALLEST: Final = float(np.finfo(float).tiny)
_LOADED: Final = 1e-6  # of the joint that is loaded most
_HELD_RATIO: Final = 0.9  # of posterior over prior std: the data say next to nothing
_NAMED_SHARE: Final = 0.1  # of the largest component: smaller ones are not worth a word


@dataclass(frozen=True, slots=True)
class Direction:
    """One direction of the state that the data leave open.

    `components` are (label, amount) in the unit of each freedom; only those worth naming.
    """

    components: tuple[tuple[str, float], ...]
    words: str
    remedy: str


@dataclass(frozen=True, slots=True, eq=False)
class RankReport:
    """Rank of the target blocks on the data alone, all other blocks held.

    Attributes
    ----------
    singular_values : (q,) of the whitened Jacobian, scaled by the largest column of each unit; largest first.
    missing : directions with no information in the data.
    held_by_prior : directions, with all blocks free, whose uncertainty is the prior's still.
    """

    rank: int
    unknowns: int
    singular_values: FloatArray
    missing: tuple[Direction, ...]
    held_by_prior: tuple[Direction, ...]

    @property
    def complete(self) -> bool:
        """The data alone determine every target."""
        return self.rank == self.unknowns

    def require(self) -> None:
        """Raise DegenerateGeometry, with the missing directions in words, unless complete."""
        if not self.complete:
            raise DegenerateGeometry(
                f"Rank {self.rank} of {self.unknowns}: "
                + "; ".join(direction.words for direction in self.missing),
                "; ".join(dict.fromkeys(direction.remedy for direction in self.missing)),
            )


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """Singular values of some whitened columns over their scale.

    Attributes
    ----------
    columns : (q,) of the state.
    singular_values : (q,) largest first.
    null : (k, q) directions below the tolerance; over the scale, in the unit of each freedom.
    scale : (q,).
    """

    columns: NDArray[np.intp]
    singular_values: FloatArray
    null: FloatArray
    scale: FloatArray

    @property
    def rank(self) -> int:
        """How many directions the data determine."""
        return len(self.columns) - len(self.null)


def rank_report(prior: Belief, posterior: Belief, spectrum: Spectrum) -> RankReport:
    """Scale-free rank test of the blocks whose columns the spectrum is of.

    Directions held only by the prior are sought among these as well.
    """
    columns, scale = spectrum.columns, spectrum.scale
    return RankReport(
        rank=spectrum.rank,
        unknowns=len(columns),
        singular_values=spectrum.singular_values,
        missing=_directions(prior, columns, spectrum.null, scale, False),
        held_by_prior=_held(prior, posterior, columns, scale),
    )


def require_determined(
    belief: Belief, jacobian: FloatArray, variance: FloatArray, tolerance: float = RANK_TOLERANCE
) -> None:
    """Raise DegenerateGeometry, with the directions in words, unless the data determine the flat freedoms.

    jacobian (m, n) by the state of the belief and variance (m,), m^2, as in `spectrum_of`.
    """
    columns = np.flatnonzero(belief.flat)
    if len(columns):
        found = spectrum_of(belief, jacobian, variance, columns, tolerance)
        missing = _directions(belief, columns, found.null, found.scale, False)
        RankReport(found.rank, len(columns), found.singular_values, missing, ()).require()


def spectrum_of(
    belief: Belief,
    jacobian: FloatArray,
    variance: FloatArray,
    columns: NDArray[np.intp],
    tolerance: float = RANK_TOLERANCE,
) -> Spectrum:
    """What independent rows say of some columns of the state.

    jacobian (m, n) by the state of the belief, variance (m,) m^2; `tolerance` is the smallest over the
    largest singular value that counts as information.
    """
    whitened = jacobian[:, columns] / np.sqrt(np.maximum(variance, _SMALLEST))[:, None]
    gram = whitened.T @ whitened
    scale = _scale(np.sqrt(np.diag(gram)), belief.unit_codes[columns])
    squares = np.linalg.eigvalsh(gram / (scale * scale[:, None]))
    if squares[0] > (tolerance**2 + _ROUNDING) * squares[-1]:  # clear without the dearer singular vectors
        return Spectrum(columns, np.sqrt(squares[::-1]), np.zeros((0, len(columns))), scale)
    scaled = whitened / scale
    # Zero rows make the factorisation square: with fewer rows than unknowns the rest is null as well.
    if len(scaled) < len(columns):
        scaled = np.vstack([scaled, np.zeros((len(columns) - len(scaled), len(columns)))])
    _, singular, right = np.linalg.svd(scaled, full_matrices=False)
    rank = int(np.sum(singular > tolerance * max(singular[0], _SMALLEST)))
    return Spectrum(columns, singular, right[rank:], scale)


def _scale(length: FloatArray, units: NDArray[np.intp]) -> FloatArray:
    """(q,) by which columns of these lengths and units are divided."""
    # One scale for all freedoms of a unit: with a length of its own, a freedom that is seen only through
    # settling errors would look as well determined as the others.
    longest = np.zeros(max(int(units.max()) + 1, len(UNITS)))
    np.maximum.at(longest, units, length)
    # Where all angles are next to nothing, rounding is not information.
    if longest[_RADIAN] < _SHORTEST_LEVER_M * longest[_METRE]:
        longest[_RADIAN] = longest[_METRE]
    scale = np.asarray(longest[units])
    # But joints yield as differently as their loads are: of these each has its own, if it has a load at all.
    if longest[_YIELD]:
        scale = np.where((units == _YIELD) & (length > _LOADED * scale), length, scale)
    scale[scale == 0.0] = 1.0
    return scale


def _held(
    prior: Belief, posterior: Belief, columns: NDArray[np.intp], worth: FloatArray
) -> tuple[Direction, ...]:
    """Directions in which the posterior is as wide as the prior."""
    if not prior.contributions:
        return ()
    std = np.sqrt(np.diag(prior.prior_covariance)[columns])
    known = std == 0.0  # exactly known, or flat: there is no prior to hold anything
    if known.all():
        return ()
    grid = np.ix_(columns, columns)
    free = ~known
    small = np.ix_(free, free)
    scale = std[free]
    before = prior.prior_covariance[grid][small] / np.outer(scale, scale)
    after = posterior.covariance[grid][small] / np.outer(scale, scale)
    try:
        root = np.linalg.cholesky(before)
    except np.linalg.LinAlgError:  # the prior itself ties directions together
        return ()
    ratio = np.linalg.solve(root, np.linalg.solve(root, after).T)
    values, vectors = np.linalg.eigh(0.5 * (ratio + ratio.T))
    chosen = vectors[:, values > _HELD_RATIO**2]
    directions = (root @ chosen).T * scale * worth[free]
    return _directions(prior, columns[free], directions, worth[free], True)


def _directions(
    belief: Belief, columns: NDArray[np.intp], basis: FloatArray, worth: FloatArray, held: bool
) -> tuple[Direction, ...]:
    """The rows of `basis` (k, q), in units of `worth`, as sparse directions in words."""
    if len(basis) == 0:
        return ()
    # Reduced echelon form: each direction has a freedom of its own, which makes the sentences short.
    _, _, pivots = qr(basis, pivoting=True, mode="economic")
    sparse = np.linalg.solve(basis[:, pivots[: len(basis)]], basis)
    labels = belief.labels
    found = []
    for row in sparse:
        size = np.abs(row)
        named = np.flatnonzero(size >= _NAMED_SHARE * size.max())
        named = named[np.argsort(-size[named], kind="stable")]
        amounts = row / worth
        components = tuple((labels[columns[i]], float(amounts[i])) for i in named)
        names = [label for label, _ in components]
        found.append(Direction(components, _words(belief, names, held), _remedy(belief, names)))
    return tuple(found)


def _words(belief: Belief, labels: Sequence[str], held: bool) -> str:
    names = [freedom_words(belief, label) for label in labels]
    if held:
        return f"{' with '.join(names)} is known from the prior only"
    if len(names) == 1:
        return f"{names[0]} is not seen by the measurements"
    return f"{', '.join(names[:-1])} and {names[-1]} cannot be told apart"


def freedom_words(belief: Belief, label: str) -> str:
    """A freedom, "block.freedom", as people say it."""
    block, _, freedom = label.rpartition(".")
    if isinstance(belief.value(block), Transform):
        motion = "translation" if freedom.startswith("t") else "rotation"
        return f"{motion} of the {block} {'along' if motion == 'translation' else 'about'} {freedom[-1]}"
    own = block.rpartition(".")[2] == freedom
    return f"{block.replace('.', ' ')}" if own else f"{freedom} of {block.replace('.', ' ')}"


def _remedy(belief: Belief, labels: Sequence[str]) -> str:
    blocks = {label.rpartition(".")[0] for label in labels}
    if "laser" in blocks:
        return "Tilt the tool by 20 deg or more in at least two directions, and turn it about the beam"
    if "kinematics" in blocks:
        return "Move every joint through a wider range, measure objects elsewhere too, or give a prior"
    if blocks & {"axis 1", "axis 2"}:
        return "Turn that axis further, and measure points farther away from it"
    if "probe" in blocks or "probe.radius" in blocks:
        return "Touch the sphere from more sides, with the tool turned"
    name = sorted(blocks)[0]
    if name in belief and isinstance(belief.value(name), Transform):
        split = [label.rpartition(".") for label in labels]
        freedoms = {freedom for block, _, freedom in split if block == name}
        axes = sorted({POSE_FREEDOMS[POSE_FREEDOMS.index(freedom)][-1] for freedom in freedoms})
        along = " and ".join(axes)
        if all(freedom.startswith("t") for freedom in freedoms):
            return f"Measure a surface of the {name} whose normal points along its {along}"
        return f"Spread the points further apart on the {name}, across its {along}, and on more surfaces"
    return f"Measure {name.replace('.', ' ')} itself, or give it a smaller prior uncertainty"
