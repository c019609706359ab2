"""The lines of the inspection table."""

from collections.abc import Mapping
from typing import Any

from controller.report.rounding import NOTHING, fixed, percent, plain, with_uncertainty
from controller.report.view import Characteristic, Picture, ToleranceBar


def characteristic(row: Mapping[str, Any], key: str) -> Characteristic:
    """One characteristic, from metres to text."""
    value, u, decimals = with_uncertainty(1e3 * row["value_m"], 1e3 * row["u_m"])
    guard_m, probability = row.get("guard_band_m"), row.get("conformance_probability")
    two_sided = row["lower_m"] is not None
    return Characteristic(
        id=str(row["id"]),
        what=f"{row['kind']} of {row['feature']}",
        datums=" | ".join(row["datums"]) or NOTHING,
        nominal=_mm(row["nominal_m"]) if two_sided else NOTHING,
        limits=f"{_mm(row['lower_m'])} … {_mm(row['upper_m'])}" if two_sided else f"≤ {_mm(row['upper_m'])}",
        value=value,
        expanded_u=NOTHING if u == NOTHING else fixed(1e3 * row["U_m"], decimals),
        guard_band=NOTHING if guard_m is None else fixed(1e3 * guard_m, decimals),
        probability=NOTHING if probability is None else percent(probability),
        outcome=str(row["outcome"]),
        points=str(row["points"]),
        method=str(row["method"]),
        bar=_bar(row, key),
    )


def _mm(length_m: float | None) -> str:
    return NOTHING if length_m is None else plain(1e3 * length_m, fewest=2)


def _bar(row: Mapping[str, Any], key: str) -> Picture:
    """Scaled to the tolerance zone; a one-sided zone begins at the natural limit 0."""
    lower_m = 0.0 if row["lower_m"] is None else row["lower_m"]
    width_m = row["upper_m"] - lower_m
    guard_m = row.get("guard_band_m")
    drawing = ToleranceBar(
        value=(row["value_m"] - lower_m) / width_m,
        expanded_u=row["U_m"] / width_m,
        guard=None if guard_m is None else guard_m / width_m,
        two_sided=row["lower_m"] is not None,
        outcome=str(row["outcome"]),
    )
    words = f"{row['id']}: {1e3 * row['value_m']:.4f} mm in its tolerance zone, {row['outcome']}"
    return Picture(key, drawing, title=words, caption="")
