"""What the cell stated against what is hidden in the simulation; for `truecell demo` and nothing else."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from controller.cellfile import Cell, HandEyePhase
from controller.knowledge import part_corners_m, part_features
from controller.store import Result
from estimation.belief import Belief
from estimation.transform import FloatArray


@dataclass(frozen=True, slots=True)
class Row:
    """One stated quantity: its true error, what was stated of it, and its limit; millimetres."""

    quantity: str
    error_mm: float
    stated_mm: float  # expanded uncertainty, 95 %
    limit_mm: float
    conforms: bool  # in truth: the error is within the limit, the characteristic within its tolerance
    verdict: str

    @property
    def inside(self) -> bool:
        """The truth lies within the stated uncertainty (95 of 100 honest ones do)."""
        return self.error_mm <= self.stated_mm

    @property
    def wrongly_released(self) -> bool:
        """Said to be OK, and in truth it is not: must never happen."""
        return self.verdict == "OK" and not self.conforms


@dataclass(frozen=True, slots=True)
class TruthTable:
    """All comparisons of one run."""

    rows: tuple[Row, ...]

    def to_dict(self) -> list[dict[str, Any]]:
        """For --json."""
        return [
            asdict(row) | {"inside": row.inside, "wrongly_released": row.wrongly_released}
            for row in self.rows
        ]

    def show(self) -> None:
        """On the terminal."""
        from rich.table import Table

        from controller.console.show import coloured, console

        table = Table(
            title="Stated against the hidden truth (mm)", title_justify="left", box=None, pad_edge=False
        )
        table.add_column("quantity", no_wrap=True)
        for heading in ("true error", "stated U", "limit"):
            table.add_column(heading, justify="right")
        table.add_column("truth within U")
        table.add_column("verdict")
        for row in self.rows:
            table.add_row(
                row.quantity,
                f"{row.error_mm:.3f}",
                f"{row.stated_mm:.3f}",
                f"{row.limit_mm:.2f}",
                "yes" if row.inside else "no (1 in 20 may be)",
                coloured(row.verdict),
            )
        console().print(table if self.rows else "No phase got as far as an estimate: nothing to compare.")


def compare(cell: Cell, results: Sequence[Result], truth: Mapping[str, Any]) -> TruthTable:
    """Rows for every estimate among the last results of a run."""
    rows: list[Row] = []
    for result in results:
        if result.belief is None:
            continue
        belief, estimate = Belief.from_dict(result.belief), result.result["estimate"]
        match result.result["kind"]:
            case "hand_eye":
                rows += _hand_eye(cell, result, belief, estimate, truth)
            case "localize":
                rows.append(_part(cell, result, belief, estimate, truth))
            case "inspect":
                rows += _characteristics(cell, estimate, truth)
    return TruthTable(tuple(rows))


def _hand_eye(
    cell: Cell, result: Result, belief: Belief, estimate: Mapping[str, Any], truth: Mapping[str, Any]
) -> list[Row]:
    """The point of a reading, in the flange."""
    (spec,) = (p for p in cell.job.phases if isinstance(p, HandEyePhase) and p.name == result.phase)
    scalars = truth["scalars"]
    rows = []
    for range_m, gated in zip(spec.gated_ranges_m, estimate["gated"], strict=True):
        true_m = (1 + scalars["laser.scale"]) * range_m + scalars["laser.offset"]
        true_p = _point(np.array(truth["poses"]["laser"]), true_m)
        seen_m = (1 + belief.scalar("laser.scale")) * range_m + belief.scalar("laser.offset")
        error_m = np.linalg.norm(_point(belief.transform("laser").matrix, seen_m) - true_p)
        name = f"laser point at {gated['point']}"
        rows.append(_gated(name, float(error_m), gated["U_m"], spec.limit_m, result.verdict))
    return rows


def _gated(name: str, error_m: float, stated_m: float, limit_m: float, verdict: str) -> Row:
    return Row(name, error_m * 1e3, stated_m * 1e3, limit_m * 1e3, error_m <= limit_m, verdict)


def _point(matrix: FloatArray, distance_m: float) -> FloatArray:
    point: FloatArray = matrix[:3, :3] @ np.array([0.0, 0.0, distance_m]) + matrix[:3, 3]
    return point


def _part(
    cell: Cell, result: Result, belief: Belief, estimate: Mapping[str, Any], truth: Mapping[str, Any]
) -> Row:
    """The corner of the part with the largest true error."""
    corners = part_corners_m(cell)
    true = np.array(truth["poses"]["part"])
    true_p = corners @ true[:3, :3].T + true[:3, 3]
    error_m = np.linalg.norm(belief.transform("part").points(corners) - true_p, axis=1)
    worst = int(np.argmax(error_m))
    gated = estimate["gated"][worst]
    return _gated(
        f"part, {gated['point']}", float(error_m[worst]), gated["U_m"], estimate["limit_m"], result.verdict
    )


def _characteristics(cell: Cell, estimate: Mapping[str, Any], truth: Mapping[str, Any]) -> list[Row]:
    """Error of the measured value, and whether the true one is within its tolerance."""
    rows = []
    for item in estimate["characteristics"]:
        true_m = _true_value(cell, item, truth["features"])
        if true_m is None:
            continue
        lower_m = -np.inf if item["lower_m"] is None else item["lower_m"]
        rows.append(
            Row(
                f"{item['id']} {item['kind']} of {item['feature']}",
                abs(item["value_m"] - true_m) * 1e3,
                item["U_m"] * 1e3,
                abs(item["limit_m"]) * 1e3,
                bool(lower_m <= true_m <= item["upper_m"]),
                item["outcome"],
            )
        )
    return rows


def _true_value(cell: Cell, item: Mapping[str, Any], features: Mapping[str, Any]) -> float | None:
    deviation = features[f"part.{item['feature']}"]
    match item["kind"]:
        case "diameter":
            return float(item["nominal_m"] + 2.0 * deviation["offset"])
        case "position":
            normals = {feature.name: np.array(feature.axis) for feature in part_features(cell)}
            shift = np.array([deviation["shift_x"], deviation["shift_y"], deviation["shift_z"]])
            axis = normals[item["feature"]]
            across = [datum for datum in item["datums"] if abs(normals[datum] @ axis) < 0.5][:2]
            off = [normals[datum] @ shift - features[f"part.{datum}"]["offset"] for datum in across]
            return float(2.0 * np.linalg.norm(off))
        case "flatness":
            return float(deviation["flatness"])
        case _:
            return None
