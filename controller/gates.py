"""Gates: proofs in, one of four outcomes out. Nothing here measures or decides what to do next."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from estimation.statistics import Outcome


@dataclass(frozen=True, slots=True)
class Proof:
    """One condition of a gate: a value held against its limit, in the unit that people read."""

    name: str
    value: float
    limit: float
    unit: str
    outcome: Outcome
    detail: str = ""  # in words: what the number means, where it comes from

    @staticmethod
    def at_most(name: str, value: float, limit: float, unit: str, detail: str = "") -> "Proof":
        """OK when value <= limit (the limit itself belongs to conformity), else NotDecidable.

        For uncertainties and test statistics: exceeding them proves nothing wrong with the part,
        only that nothing can be claimed.
        """
        outcome = Outcome.OK if value <= limit else Outcome.NOT_DECIDABLE
        return Proof(name, value, limit, unit, outcome, detail)


SEVERITY = (Outcome.OK, Outcome.NOT_DECIDABLE, Outcome.NOT_OK, Outcome.UNDEFINED)


def worst(outcomes: Iterable[Outcome]) -> Outcome:
    """The outcome that rules: Undefined over NotOK over NotDecidable over OK. Nothing proven is Undefined."""
    return max(outcomes, key=SEVERITY.index, default=Outcome.UNDEFINED)


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a gate says, with everything that it rests on."""

    proofs: tuple[Proof, ...]
    message: str  # one sentence: what was found, against which limit
    remedy: str = ""  # what would cure it; empty when passed
    curable: bool = False  # more measurements of this phase can cure it

    @property
    def outcome(self) -> Outcome:
        return worst(proof.outcome for proof in self.proofs)

    @property
    def passed(self) -> bool:
        return self.outcome is Outcome.OK

    def to_dict(self) -> dict[str, Any]:
        """For the store and the report."""
        return {
            "outcome": self.outcome.value,
            "message": self.message,
            "remedy": self.remedy,
            "proofs": [{**asdict(proof), "outcome": proof.outcome.value} for proof in self.proofs],
        }
