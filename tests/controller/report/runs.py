"""Runs as the engine would record them: plausible numbers in the form of the phases' estimates."""

from typing import Any

import numpy as np

from controller.gates import Proof, Verdict
from controller.samples import Sample
from controller.store import Store
from estimation.statistics import Outcome, decide

STARTED_UTC_S = 1_790_000_000.0
CELL_DIGEST = "c0ffee" + "0123456789abcdef" * 3 + "0123456789"

CELL = """
[cell]
name = "bench-block"
simulated = true
[bar]
certificate = "BAR-0417"
certified = 2026-03-02
valid_to = 2028-03-01
[sphere]
certificate = "SPH-1288"
certified = 2026-03-02
valid_to = 2028-03-01
[part]
name = "block"
[job]
phases = [
  { name = "noise", kind = "noise" },
  { name = "hand-eye", kind = "hand_eye" },
  { name = "hand-eye check", kind = "check", of = "hand-eye" },
  { name = "localize", kind = "localize" },
  { name = "part check", kind = "check", of = "localize" },
  { name = "inspect", kind = "inspect" },
]
"""


class StepClock:
    """Time that moves by 2.5 s at every look."""

    def __init__(self) -> None:
        self._utc_s = STARTED_UTC_S

    def now_s(self) -> float:
        return self._utc_s

    def sleep(self, duration_s: float) -> None:
        self._utc_s += duration_s

    def utc_s(self) -> float:
        self._utc_s += 2.5
        return self._utc_s


def begin(store: Store, *, simulated: bool = True, text: str = CELL) -> int:
    run = store.begin_run(text, CELL_DIGEST, "0.1.0", simulated=simulated, seed=7 if simulated else None)
    store.event("state", "Starting -> Execute")
    return run.id


def take(store: Store, run: int, phase: str, count: int, attempt: int = 1, bad: int = 0) -> list[int]:
    """Samples, of which the first `bad` saw nothing."""
    ids = []
    for step in range(count):
        sample = Sample(
            step=f"{phase} {step}",
            kind="laser",
            object="plate",
            feature="face",
            joints_rad=(0.1, 0.2, -1.5, 0.0, -1.5, 0.0),
            joint_scatter_rad=(2.6e-5,) * 6,
            joint_readings=3,
            reading_m=0.085,
            reading_scatter_m=1e-5,
            readings=40,
            quality="bad" if step < bad else "good",
            why="no target in the beam" if step < bad else "",
            source_time_s=float(step),
            utc_s=STARTED_UTC_S,
        )
        ids.append(store.add_sample(run, phase, attempt, step, "laser", sample.to_dict()))
    return ids


def conclude(
    store: Store, run: int, phase: str, kind: str, estimate: dict[str, Any], verdict: Verdict, **more: Any
) -> None:
    """Save the result of an attempt as the job does."""
    attempt = more.pop("attempt", 1)
    ids = [sample.id for sample in store.samples(run, phase, attempt)]
    earlier = store.results(run)
    store.save_result(
        run,
        phase,
        attempt,
        verdict.outcome.value,
        {"kind": kind, "estimate": estimate, "verdict": verdict.to_dict()},
        sample_ids=ids,
        calibration=earlier[-1].content_hash if earlier else None,
    )


def gated(names: list[str], u_m: float, seed: int) -> list[dict[str, Any]]:
    """Gated points with U near `u_m`, their ellipsoids and budgets."""
    rng = np.random.default_rng(seed)
    points = []
    for i, name in enumerate(names):
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        variance = np.sort(np.array([0.25, 0.5, 1.0]) * (0.8 + 0.2 * i / max(len(names) - 1, 1))) ** 2
        axes_m = u_m * np.sqrt(variance)
        shares = np.array([0.44, 0.21, 0.14, 0.08, 0.05, 0.03, 0.02, 0.02, 0.01])
        sources = (
            "kinematics",
            "laser mount",
            "hand-eye range noise",
            "laser offset",
            "laser scale",
            "hand-eye joint noise",
            "plate place",
            "hand-eye surface",
            "part form",
        )
        points.append(
            {
                "point": name,
                "position_m": rng.normal(scale=0.1, size=3).tolist(),
                "U_m": float(axes_m[-1]),
                "axes_m": axes_m.tolist(),
                "directions": rotation.T.tolist(),
                "budget": dict(zip(sources, shares.tolist(), strict=True)),
            }
        )
    return points


def fit(count: int, seed: int, unknowns: int = 12, rejected: int = 0) -> dict[str, Any]:
    """A fit whose residuals are as declared."""
    rng = np.random.default_rng(seed)
    standardised = rng.normal(size=count)
    chi2 = float(standardised @ standardised) * (count - unknowns) / count
    return {
        "chi2": chi2,
        "dof": count - unknowns,
        "p_value": 0.4312,
        "variance_factor": chi2 / (count - unknowns),
        "rejected": rejected,
        "iterations": 4,
        "stop_reason": "step below tolerance",
        "initial_cost": 4e5,
        "final_cost": chi2,
        "standardised_residuals": standardised.tolist(),
        "residuals_m": (3.2e-5 * standardised).tolist(),
    }


def values(block: str, entries: dict[str, tuple[float, float, str]]) -> list[dict[str, Any]]:
    return [
        {"name": f"{block} {name}", "value": value, "u": u, "unit": unit}
        for name, (value, u, unit) in entries.items()
    ]


def noise(store: Store, run: int) -> None:
    take(store, run, "noise", 12)
    proofs = tuple(
        Proof.at_most(
            f"noise of joint {j}",
            0.00151 + 1e-5 * j,
            0.00189,
            "deg",
            "standard deviation of one reading, 117 degrees of freedom, declared 0.0015 deg",
        )
        for j in (6, 5, 4, 3, 2, 1)
    )
    proofs += (
        Proof.at_most(
            "noise of laser points", 0.0298, 0.0517, "mm", "about a local plane, 9 degrees of freedom"
        ),
    )
    rows = [{"name": p.name, "value": p.value, "limit": p.limit, "unit": p.unit} for p in proofs]
    verdict = Verdict(proofs, "Joints and laser repeat as declared", "Have that axis or sensor looked at")
    conclude(store, run, "noise", "noise", {"values": rows}, verdict)


LASER = {
    "tx": (0.0812345, 1.23e-4, "m"),
    "ty": (-0.0011234, 9.96e-5, "m"),
    "tz": (0.0594321, 8.7e-5, "m"),
    "rx": (0.00812, 2.1e-4, "rad"),
    "ry": (-0.00401, 1.8e-4, "rad"),
}


def hand_eye(store: Store, run: int, u_m: float = 2.62e-4, attempt: int = 1, bad: int = 2) -> None:
    ids = take(store, run, "hand-eye", 80, attempt, bad)
    if bad:
        store.exclude(ids[5], "somebody leaned on the bench", "metrologist mk")
        store.retake(ids[6], "laser window was dirty", "operator")
    kinematics = {}
    for j in range(1, 6):
        kinematics[f"a{j}"] = (7e-5 - 2e-5 * j, 8.1e-5, "m")
        kinematics[f"alpha{j}"] = (1.2e-4 - 3e-5 * j, 1.4e-4, "rad")
        if j > 1:
            kinematics[f"theta{j}"] = (-8e-5, 1.2e-4, "rad")
        if j > 2:
            kinematics[f"d{j}"] = (3.1e-5, 8.8e-5, "m")
    kinematics["beta2"] = (2.2e-5, 1.1e-4, "rad")
    points = gated(["60 mm", "85 mm", "110 mm"], u_m, 1)
    ellipsoid = Proof.at_most(
        "expanded uncertainty",
        u_m * 1e3,
        0.4,
        "mm",
        "U (3-D, 95 %) at 110 mm; kinematics contributes 44% of the variance",
    )
    numbers = fit(78, 2, 29, rejected=1)
    proofs = (
        Proof(
            "directions held by no measurement", 0.0, 0.0, "", Outcome.OK, "the data determine every freedom"
        ),
        Proof(
            "chi-square of the residuals",
            numbers["chi2"],
            82.4,
            "",
            Outcome.OK,
            "49 degrees of freedom, band 24.1 to 82.4: residuals are as declared",
        ),
        ellipsoid,
    )
    passed = ellipsoid.outcome is Outcome.OK
    verdict = Verdict(
        proofs,
        f"Hand-eye known to U = {u_m * 1e3:.3f} mm, limit 0.400 mm"
        if passed
        else f"expanded uncertainty {u_m * 1e3:.3g} mm, limit 0.4 mm: {ellipsoid.detail}",
        "" if passed else "Reduce kinematics, or raise the limit",
    )
    estimate = {
        "pose": {"target": "flange", "source": "laser", "matrix": np.eye(4).tolist()},
        "values": [
            *values("laser", LASER),
            *values("laser.scale", {"scale": (1.13e-4, 1.9e-4, "1")}),
            *values("laser.offset", {"offset": (-1.2e-5, 1.7e-5, "m")}),
            *values(
                "plate",
                {"tz": (0.061234, 1.1e-4, "m"), "rx": (0.0031, 2e-4, "rad"), "ry": (-0.002, 2e-4, "rad")},
            ),
            *values("kinematics", kinematics),
        ],
        "gated": points,
        "limit_m": 4e-4,
        "fit": numbers,
    }
    conclude(store, run, "hand-eye", "hand_eye", estimate, verdict, attempt=attempt)


def bar_check(store: Store, run: int) -> None:
    take(store, run, "hand-eye check", 16)
    words = "no movement of the laser beyond its uncertainty (estimate 0.11 mm, 0.042 deg)"
    proofs = (
        Proof("bump of the laser", 3.91, 16.75, "", Outcome.OK, words),
        Proof(
            "chi-square of the check",
            9.42,
            26.76,
            "",
            Outcome.OK,
            "11 degrees of freedom, with the bump free",
        ),
        Proof.at_most(
            "error seen by the check",
            0.093,
            0.271,
            "mm",
            "at 110 mm; limit 0.40 mm less the guard band of the check",
        ),
    )
    estimate = {
        "bump": {
            "value": [8e-5, -6e-5, 4.5e-5, 5e-4, -5.2e-4],
            "covariance": np.diag([1.2e-4, 1.1e-4, 6e-5, 7e-4, 6e-4]).__pow__(2).tolist(),
            "words": words,
        },
        "statistic": 3.91,
        "limit": 16.75,
        "shifts": [
            {"point": "60 mm", "moved_m": 8.1e-5, "u_m": 6.4e-5},
            {"point": "85 mm", "moved_m": 8.8e-5, "u_m": 7.0e-5},
            {"point": "110 mm", "moved_m": 9.3e-5, "u_m": 7.8e-5},
        ],
        "points": 16,
    }
    verdict = Verdict(proofs, f"The check agrees with the hand-eye: {words}")
    conclude(store, run, "hand-eye check", "check", estimate, verdict)


def localize(store: Store, run: int) -> None:
    take(store, run, "localize", 42)
    corners = [f"corner ({x}, {y}, {z}) mm" for x in (0, 100) for y in (0, 150) for z in (0, 100)]
    numbers = fit(30, 4, 6)
    proofs = (
        Proof(
            "directions held by no measurement", 0.0, 0.0, "", Outcome.OK, "the data determine every freedom"
        ),
        Proof(
            "chi-square of the residuals",
            numbers["chi2"],
            50.6,
            "",
            Outcome.OK,
            "24 degrees of freedom, band 8.1 to 50.6: residuals are as declared",
        ),
        Proof.at_most(
            "expanded uncertainty",
            0.331,
            0.4,
            "mm",
            "U (3-D, 95 %) at corner (100, 150, 100) mm; kinematics contributes 44% of the variance",
        ),
    )
    pose = {
        "tx": (0.0412, 1e-4, "m"),
        "ty": (-0.48312, 1.2e-4, "m"),
        "tz": (0.12041, 9e-5, "m"),
        "rx": (0.004, 3e-4, "rad"),
        "ry": (-0.002, 3e-4, "rad"),
        "rz": (1.06, 2.5e-4, "rad"),
    }
    estimate = {
        "pose": {"target": "base", "source": "part", "matrix": np.eye(4).tolist()},
        "values": [
            *values("part", pose),
            *(
                entry
                for face in ("top", "front", "back", "left", "right")
                for entry in values(f"part.{face}", {face: (1.2e-5, 1.4e-5, "m")})
            ),
        ],
        "gated": gated(corners, 3.31e-4, 5),
        "limit_m": 4e-4,
        "fit": numbers,
    }
    verdict = Verdict(proofs, "Part known to U = 0.331 mm, limit 0.400 mm")
    conclude(store, run, "localize", "localize", estimate, verdict)


def part_check(store: Store, run: int) -> None:
    take(store, run, "part check", 8)
    rng = np.random.default_rng(6)
    standardised = rng.normal(size=8)
    proofs = (
        Proof.at_most("missing check points", 0.0, 0.0, "", "8 points, at least 6"),
        Proof(
            "chi-square of the check",
            7.71,
            23.57,
            "",
            Outcome.OK,
            "8 fresh points with the full covariance of pose, hand-eye, kinematics and form",
        ),
        Proof.at_most(
            "largest residual", 0.061, 0.347, "mm", "on left; limit 0.40 mm less the guard band of the check"
        ),
    )
    estimate = {
        "residuals_m": (3.6e-5 * standardised).tolist(),
        "standardised": standardised.tolist(),
        "features": ["top", "front", "back", "left", "right", "top", "left", "front"],
        "chi2": 7.71,
        "limit": 23.57,
    }
    verdict = Verdict(proofs, "Fresh points agree with the localization within 0.061 mm")
    conclude(store, run, "part check", "check", estimate, verdict)


def row(
    identifier: str, feature: str, kind: str, value_m: float, u_m: float, nominal_m: float, half_m: float
) -> dict[str, Any]:
    """A line of the inspection table; without a nominal value the zone begins at 0 and ends at `half_m`."""
    lower_m = nominal_m - half_m if nominal_m else -np.inf
    upper_m = nominal_m + half_m
    decision = decide(value_m, u_m, lower_m, upper_m)
    limit_m = upper_m if value_m >= nominal_m else lower_m
    return {
        "id": identifier,
        "feature": feature,
        "kind": kind,
        "nominal_m": nominal_m,
        "lower_m": lower_m if nominal_m else None,
        "upper_m": upper_m,
        "value_m": value_m,
        "deviation_m": value_m - nominal_m,
        "limit_m": limit_m - nominal_m,
        "u_m": u_m,
        "U_m": 2.0 * u_m,
        "guard_band_m": decision.guard_band,
        "conformance_probability": decision.conformance_probability,
        "outcome": decision.outcome.value,
        "points": 12,
        "method": "least squares, touched datums" if kind == "position" else "least squares",
        "datums": ["top", "left", "front"] if kind == "position" else [],
        "text": f"{kind} of {feature}: {value_m * 1e3:.4f} mm, U = {2e3 * u_m:.4f} mm (k = 2)",
    }


CONFORMING = (
    row("C1", "bore", "diameter", 0.0300126, 9.8e-6, 0.03, 1e-4),
    row("C2", "boss", "diameter", 0.0249731, 1.04e-5, 0.025, 1e-4),
    row("C3", "bore", "position", 1.42e-4, 4.1e-5, 0.0, 3e-4),
    row("C4", "boss", "position", 0.87e-4, 4.3e-5, 0.0, 3e-4),
    row("C5", "top", "flatness", 4.42e-5, 1.2e-5, 0.0, 2e-4),
)
MIXED = (
    CONFORMING[0],
    row("C2", "boss", "diameter", 0.0251304, 1.04e-5, 0.025, 1e-4),
    row("C3", "bore", "position", 2.83e-4, 4.1e-5, 0.0, 3e-4),
    row("C4", "boss", "position", 7.2e-4, 4.3e-5, 0.0, 3e-4),
    CONFORMING[4],
)


def inspect(store: Store, run: int, table: tuple[dict[str, Any], ...] = CONFORMING) -> None:
    take(store, run, "inspect", 47)
    numbers = fit(36, 8, 9)
    proofs = (
        Proof(
            "chi-square of the residuals",
            18.2,
            31.3,
            "",
            Outcome.OK,
            "12 degrees of freedom, band 2.9 to 31.3: residuals are as declared",
        ),
        Proof(
            "chi-square of the residuals",
            numbers["chi2"],
            54.1,
            "",
            Outcome.OK,
            "27 degrees of freedom, band 9.6 to 54.1: residuals are as declared",
        ),
        *(
            Proof(
                line["id"],
                line["deviation_m"] * 1e3,
                line["limit_m"] * 1e3,
                "mm",
                Outcome(line["outcome"]),
                line["text"],
            )
            for line in table
        ),
    )
    feature = {
        "shift_x": (2.1e-5, 2.2e-5, "m"),
        "shift_y": (-4.4e-5, 2.1e-5, "m"),
        "offset": (6.3e-6, 4.9e-6, "m"),
    }
    estimate = {
        "characteristics": list(table),
        "values": [
            *values(
                "probe",
                {"tx": (-0.0602, 2.2e-5, "m"), "ty": (2e-4, 2.1e-5, "m"), "tz": (0.1101, 2.6e-5, "m")},
            ),
            *values("probe.radius", {"radius": (0.0015008, 1.6e-6, "m")}),
            *values(
                "sphere", {"tx": (-0.2812, 1e-4, "m"), "ty": (0.1609, 1e-4, "m"), "tz": (0.1502, 9e-5, "m")}
            ),
            *values("part.bore", feature),
            *values("part.boss", feature),
        ],
        "stylus": {"radius_m": 0.0015008, "u_m": 1.6e-6},
        "fit": numbers,
        "decision_rule": "ISO 14253-1",
        "conformance_probability": 0.95,
    }
    passed = all(line["outcome"] == "OK" for line in table)
    message = (
        f"{len(table)} of {len(table)} characteristics conform"
        if passed
        else "C2 0.13 mm, limit 0.1 mm: " + table[1]["text"]
    )
    conclude(
        store,
        run,
        "inspect",
        "inspect",
        estimate,
        Verdict(proofs, message, "" if passed else "See the inspection table of the report"),
    )


def whole(store: Store, table: tuple[dict[str, Any], ...] = CONFORMING, *, simulated: bool = True) -> int:
    """A run with all phases."""
    run = begin(store, simulated=simulated)
    noise(store, run)
    hand_eye(store, run)
    bar_check(store, run)
    localize(store, run)
    part_check(store, run)
    inspect(store, run, table)
    outcome = "OK" if table is CONFORMING else "NotOK"
    store.close_run(run, outcome)
    return run


def held(store: Store) -> int:
    """A run that stands in Held: the second attempt at the hand-eye did not reach its limit either."""
    run = begin(store)
    noise(store, run)
    hand_eye(store, run, u_m=5.2e-4, attempt=1)
    store.event(
        "fault",
        "Phase hand-eye: expanded uncertainty 0.52 mm, limit 0.4 mm",
        code="G",
        remedy="Reduce kinematics, or raise the limit",
    )
    hand_eye(store, run, u_m=4.71e-4, attempt=2, bad=0)
    return run
