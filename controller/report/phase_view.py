"""One phase for the report: verdict, proofs, estimate, pictures; what a result does not hold is left out."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

from controller.gates import SEVERITY
from controller.report import words
from controller.report.inspection_view import characteristic
from controller.report.rounding import (
    NOTHING,
    against_limit,
    fixed,
    plain,
    share,
    shown_unit,
    with_uncertainty,
)
from controller.report.view import Budget, Ellipsoid, Ellipsoids, Phase, Picture, Residuals, Table
from controller.store.records import Result
from estimation.statistics import Outcome

Estimate = Mapping[str, Any]
K: Final = 2.0  # coverage factor of single values
MOST_BARS: Final = 8
MOST_ROWS: Final = 10  # of a table of values, so that such tables fill columns evenly
BUMP_FREEDOMS: Final = (("x", "m"), ("y", "m"), ("z", "m"), ("rx", "rad"), ("ry", "rad"))


def phase_of(number: int, name: str, kind: str, results: Sequence[Result], taken: int) -> Phase:
    """The view of a phase with its results, oldest first; without any it was begun or not performed."""
    purpose = words.PURPOSE.get(kind, kind)
    if not results:
        message = (
            f"Begun, {words.counted(taken, 'measurement')} taken, not concluded" if taken else "Not performed"
        )
        return Phase(number, name, purpose, Outcome.UNDEFINED.value, message, "", str(taken or NOTHING), 0)
    last = results[-1]
    verdict, estimate = last.result.get("verdict", {}), last.result.get("estimate", {})
    outcome, key = outcome_of(last.verdict), f"phase{number}"
    own = {row["id"] for row in estimate.get("characteristics", ())}  # these have a table of their own
    return Phase(
        number=number,
        name=name,
        purpose=purpose,
        outcome=outcome.value,
        message=words.sentence(verdict.get("message", "")),
        remedy="" if outcome is Outcome.OK else words.sentence(verdict.get("remedy", "")),
        measurements=str(taken),
        attempt=last.attempt,
        earlier=tuple(
            f"Attempt {result.attempt}, {words.utc(result.utc_s)}: {result.verdict}. "
            + words.sentence(result.result.get("verdict", {}).get("message", ""))
            for result in results[:-1]
        ),
        proofs=_proofs([proof for proof in verdict.get("proofs", ()) if proof["name"] not in own]),
        facts=tuple(_fit_facts(estimate.get("fit"))),
        tables=tuple(_tables(estimate)),
        estimates=tuple(_estimates(estimate)),
        estimates_note=words.POSE_NOTE if estimate.get("pose") or estimate.get("characteristics") else "",
        pictures=tuple(_pictures(estimate, key)),
        characteristics=tuple(
            characteristic(row, f"{key}-characteristic{i}")
            for i, row in enumerate(estimate.get("characteristics", ()))
        ),
        rule=_rule(estimate),
    )


def outcome_of(text: str) -> Outcome:
    """A verdict as stored; one that this version does not know is Undefined."""
    return Outcome(text) if text in {outcome.value for outcome in SEVERITY} else Outcome.UNDEFINED


def _proofs(proofs: Sequence[Mapping[str, Any]]) -> Table | None:
    rows, before = [], ""
    for proof in proofs:
        value, limit = against_limit(float(proof["value"]), float(proof["limit"]))
        unit = proof.get("unit") or NOTHING
        detail = proof.get("detail", "")
        if detail and detail == before:
            detail = "as above"
        else:
            before = detail
        rows.append((proof["name"], value, limit, unit, proof["outcome"], detail))
    if not rows:
        return None
    columns = ("Proof", "Value", "Limit", "Unit", "Outcome", "What it means")
    return Table("Proofs", columns, tuple(rows), numeric=(1, 2), outcome=4)


def _rule(estimate: Estimate) -> str:
    if "decision_rule" not in estimate:
        return ""
    probability = float(estimate.get("conformance_probability", 0.95))
    return (
        f"Decision rule: method of {estimate['decision_rule']}. OK and NotOK both need a probability of at "
        f"least {plain(100 * probability)} %; an accepted value keeps the guard band from its limits. "
        "U = 2 u. Bar: tolerance zone, the part inside the guard bands darker; point and line: value ± U."
    )


def _fit_facts(fit: Mapping[str, Any] | None) -> list[str]:
    if not fit:
        return []
    rejected = int(fit.get("rejected", 0))
    return [
        f"Fit: {words.counted(len(fit['standardised_residuals']), 'residual')}, "
        f"chi-square {fit['chi2']:.1f} at {fit['dof']} degrees of freedom (p {_p_value(fit['p_value'])}), "
        f"variance factor {fit['variance_factor']:.2f}, "
        f"{words.counted(rejected, 'outlier') if rejected else 'no outlier'} rejected, "
        f"{words.counted(int(fit['iterations']), 'iteration')} ({fit['stop_reason']})."
    ]


def _p_value(p_value: float) -> str:
    return "< 0.001" if p_value < 0.001 else f"= {p_value:.3f}"


def _tables(estimate: Estimate) -> list[Table]:
    tables = []
    if gated := estimate.get("gated"):
        tables.append(_gated(gated, estimate.get("limit_m")))
    if shifts := estimate.get("shifts"):
        tables.append(_shifts(shifts))
    if "residuals_m" in estimate and "features" in estimate:
        tables.append(_check_points(estimate))
    return tables


def _gated(gated: Sequence[Mapping[str, Any]], limit_m: float | None) -> Table:
    rows = []
    for point in gated:
        source, part = next(iter(_by_share(point)), (NOTHING, 0.0))
        rows.append(
            (
                point["point"],
                ", ".join(fixed(1e3 * p_m, 1) for p_m in point["position_m"]),
                fixed(1e3 * point["U_m"], 3),
                NOTHING if limit_m is None else fixed(1e3 * limit_m, 3),
                NOTHING if not limit_m else share(point["U_m"] / limit_m),
                f"{source}, {share(part)}",
            )
        )
    columns = (
        "Gated point",
        "Position / mm",
        "U / mm",
        "Limit / mm",
        "U / limit",
        "Largest source of variance",
    )
    return Table("Gated points", columns, tuple(rows), numeric=(1, 2, 3, 4))


def _by_share(point: Mapping[str, Any]) -> list[tuple[str, float]]:
    """The budget, largest source first: the store keeps keys in alphabetical order."""
    return sorted(
        ((source, float(part)) for source, part in point["budget"].items()), key=lambda bar: -bar[1]
    )


def _shifts(shifts: Sequence[Mapping[str, Any]]) -> Table:
    rows = []
    for shift in shifts:
        moved, u, decimals = with_uncertainty(1e3 * shift["moved_m"], 1e3 * shift["u_m"])
        rows.append((shift["point"], moved, u, fixed(K * 1e3 * shift["u_m"], decimals)))
    columns = ("Range", "Error seen / mm", "u / mm", "U / mm")
    note = "How far the estimated movement of the laser would displace a measured point, at each gated range."
    return Table("Error at the gated ranges", columns, tuple(rows), numeric=(1, 2, 3), note=note)


def _check_points(estimate: Estimate) -> Table:
    rows = tuple(
        (str(i + 1), feature, fixed(1e3 * residual_m, 3), fixed(standardised, 2))
        for i, (feature, residual_m, standardised) in enumerate(
            zip(estimate["features"], estimate["residuals_m"], estimate["standardised"], strict=True)
        )
    )
    columns = ("Point", "Feature", "Residual / mm", "Residual / sigma")
    return Table("Fresh points", columns, rows, numeric=(0, 2, 3))


def _estimates(estimate: Estimate) -> list[Table]:
    """Values with u and U, one table for each object. The noise phase has proofs instead."""
    groups: dict[str, list[tuple[str, ...]]] = {}
    for entry in estimate.get("values", ()):
        if "u" not in entry:
            continue
        block, _, freedom = entry["name"].rpartition(" ")
        title = words.BLOCKS.get(block) or f"Deviation of {block.removeprefix('part.')}"
        label = words.FREEDOMS.get(freedom, freedom)
        if title == f"Deviation of {label}":  # a face has one deviation, named as itself
            title, label = "Form deviation of faces", freedom
        groups.setdefault(title, []).append(_quantity(label, entry["value"], entry["u"], entry["unit"]))
    if bump := estimate.get("bump"):
        title = "Movement of the laser, estimated"
        for i, (label, unit) in enumerate(BUMP_FREEDOMS):
            u = math.sqrt(max(bump["covariance"][i][i], 0.0))
            groups.setdefault(title, []).append(_quantity(label, bump["value"][i], u, unit))
    columns = ("", "Value", "u", "U", "Unit")
    return [
        Table(
            title + (", continued" if first else ""),
            columns,
            tuple(rows[first : first + MOST_ROWS]),
            numeric=(1, 2, 3),
        )
        for title, rows in groups.items()
        for first in range(0, len(rows), MOST_ROWS)
    ]


def _quantity(label: str, value: float, u: float, unit: str) -> tuple[str, ...]:
    name, factor = shown_unit(unit)
    shown, shown_u, decimals = with_uncertainty(factor * value, factor * u)
    expanded = NOTHING if shown_u == NOTHING else fixed(K * factor * u, decimals)
    return label, shown, shown_u, expanded, name or NOTHING


def _pictures(estimate: Estimate, key: str) -> list[Picture]:
    pictures = []
    if gated := estimate.get("gated"):
        pictures += _gate_pictures(gated, estimate, key)
    fit = estimate.get("fit") or {}
    if standardised := fit.get("standardised_residuals"):
        pictures.append(
            Picture(
                f"{key}-residuals",
                Residuals(tuple(map(float, standardised))),
                "Standardised residuals",
                "Residuals over their standard deviations in the order of measurement, lines at 2 and 3; "
                "right: their distribution beside the standard normal one.",
                wide=True,
            )
        )
    return pictures


def _gate_pictures(gated: Sequence[Mapping[str, Any]], estimate: Estimate, key: str) -> list[Picture]:
    worst = max(gated, key=lambda point: float(point["U_m"]))
    frame = str(estimate.get("pose", {}).get("target", "base"))
    points = tuple(
        Ellipsoid(
            str(point["point"]),
            tuple(1e3 * axis_m for axis_m in point["axes_m"]),
            tuple(tuple(direction) for direction in point["directions"]),
            point is worst,
        )
        for point in gated
    )
    bars = _by_share(worst)
    if len(bars) > MOST_BARS:
        others = (f"{len(bars) - MOST_BARS + 1} others", sum(part for _, part in bars[MOST_BARS - 1 :]))
        bars = [*bars[: MOST_BARS - 1], others]
    limit_mm = 1e3 * float(estimate.get("limit_m") or 0.0)
    return [
        Picture(
            f"{key}-ellipsoids",
            Ellipsoids(points, limit_mm, frame),
            "95 % ellipsoids at the gated points",
            f"Projections in frame {frame}, to scale, all about one centre. Dashed: the limit, "
            f"{plain(limit_mm, fewest=2)} mm.",
            wide=True,
        ),
        Picture(
            f"{key}-budget",
            Budget(tuple(bars)),
            f"Uncertainty budget at {worst['point']}",
            "Share of the variance along the longest half axis, at the worst gated point.",
        ),
    ]
