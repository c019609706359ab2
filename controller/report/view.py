"""What a report shows, as plain data: texts are already formatted, numbers are only for pictures.

HTML and PDF are made from the same `Report`, so that they cannot differ in what they say.
"""

from dataclasses import dataclass, field

Vector = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Ellipsoid:
    """A 95 % ellipsoid: half axes (3,) in mm along the rows of `directions` (3, 3)."""

    name: str
    axes_mm: Vector
    directions: tuple[Vector, ...]
    worst: bool


@dataclass(frozen=True, slots=True)
class Ellipsoids:
    """The ellipsoids of the gated points, all drawn about one centre, with the limit as a circle."""

    points: tuple[Ellipsoid, ...]
    limit_mm: float
    frame: str


@dataclass(frozen=True, slots=True)
class Budget:
    """Shares of the variance at one point, largest first; they add up to 1."""

    bars: tuple[tuple[str, float], ...]


@dataclass(frozen=True, slots=True)
class Residuals:
    """Residuals over their standard deviations, in the order of measurement."""

    standardised: Vector


@dataclass(frozen=True, slots=True)
class ToleranceBar:
    """A value in its tolerance zone, which runs from 0 to 1; guard and U in the same scale."""

    value: float
    expanded_u: float
    guard: float | None  # None: no value can be accepted
    two_sided: bool
    outcome: str


Drawing = Ellipsoids | Budget | Residuals | ToleranceBar


@dataclass(frozen=True, slots=True)
class Picture:
    """A drawing with its place in the report (`key`, unique) and its words."""

    key: str
    drawing: Drawing
    title: str
    caption: str
    wide: bool = False


@dataclass(frozen=True, slots=True)
class Table:
    """Headings and rows of text; `numeric` columns are set flush right, `mono` ones as code."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: tuple[int, ...] = ()
    outcome: int | None = None  # the column that holds a verdict
    note: str = ""


@dataclass(frozen=True, slots=True)
class Characteristic:
    """One line of the inspection report."""

    id: str
    what: str
    datums: str
    nominal: str
    limits: str
    value: str
    expanded_u: str
    guard_band: str
    probability: str
    outcome: str
    points: str
    method: str
    bar: Picture


@dataclass(frozen=True, slots=True)
class Phase:
    """One phase: its newest result, and a line about each earlier attempt."""

    number: int
    name: str
    purpose: str
    outcome: str
    message: str
    remedy: str
    measurements: str
    attempt: int
    earlier: tuple[str, ...] = ()
    proofs: Table | None = None
    facts: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    estimates: tuple[Table, ...] = ()  # small tables of values, set side by side
    estimates_note: str = ""
    pictures: tuple[Picture, ...] = ()
    characteristics: tuple[Characteristic, ...] = ()
    rule: str = ""


@dataclass(frozen=True, slots=True)
class Report:
    """Everything that stands in the report of one run."""

    title: str
    run: str
    cell: str
    part: str
    outcome: str
    headline: str
    simulated: str  # the words of the banner; empty for a real cell
    header: tuple[tuple[str, str], ...]
    summary: str
    overview: Table
    phases: tuple[Phase, ...]
    provenance: tuple[Table, ...]
    fingerprints: tuple[tuple[str, str], ...]
    disclaimers: tuple[str, ...]
    made: str
    notes: tuple[str, ...] = field(default=())  # how to read the numbers

    def pictures(self) -> tuple[Picture, ...]:
        """Every picture once, in the order of the report."""
        return tuple(
            picture
            for phase in self.phases
            for picture in (*phase.pictures, *(line.bar for line in phase.characteristics))
        )
