"""A fitted surface as people read it and as scripts read it: millimetres, degrees and covariance."""

from typing import Any, Final

import numpy as np

from controller.offline.units import scatter_hint
from estimation.shapes.automatic import Choice
from estimation.shapes.refusals import Cause
from estimation.shapes.result import SurfaceFit
from estimation.transform import FloatArray

_MM: Final = 1e3


def status_of(fit: SurfaceFit) -> tuple[str, str]:
    """("usable", "") or ("not_usable", why): the flags that spoil the numbers."""
    reasons = []
    for flag in fit.flags:
        if flag.spoils:
            scatter = flag.cause is Cause.SCATTER_NOT_AS_STATED
            hint = scatter_hint(float(np.sqrt(fit.variance_factor or 1.0))) if scatter else ""
            reasons.append(f"{flag.text}{f'; {hint}' if hint else ''}")
    return ("not_usable" if reasons else "usable"), "; ".join(reasons)


def document(fit: SurfaceFit, choice: Choice | None) -> dict[str, Any]:
    """For `--json`. The covariance is of `parameter_names`, in mm and deg, in the frame given with it."""
    scale = np.array([_MM if unit == "m" else np.degrees(1.0) for unit in fit.units])
    status, reason = status_of(fit)
    return {
        "surface": fit.surface,
        "parameters": {
            _outside(name): _number(name, value) for name, value in fit.shape.parameters().items()
        },
        "standard_uncertainty": {
            _outside(q.name): _uncertain(q.unit, q.standard) for q in fit.quantities.values()
        },
        "expanded_uncertainty": {
            _outside(q.name): _uncertain(q.unit, q.expanded) for q in fit.quantities.values()
        },
        "parameter_names": list(fit.parameter_names),
        "covariance": (fit.covariance * np.outer(scale, scale)).tolist(),
        "covariance_units": ["mm" if unit == "m" else "deg" for unit in fit.units],
        "covariance_form": "A",
        "covariance_order": "shifts along u, v, w; tilts about u, v, w; sizes",
        "covariance_frame": {
            "origin_mm": (_MM * fit.frame.origin_m).tolist(),
            "axes_uvw": fit.frame.axes.T.tolist(),
        },
        "rms_mm": _MM * fit.rms_m,
        "sigma_mm": None if fit.sigma_m is None else _MM * fit.sigma_m,
        "dof": fit.redundancy,
        "variance_factor": fit.variance_factor,
        "p_value": fit.p_value,
        "rejected": fit.rejected.tolist(),
        "diagnostics": _finite(fit.diagnostics()),
        "flags": [{"cause": str(flag.cause), "text": flag.text} for flag in fit.flags],
        "chosen_because": None if choice is None else choice.reason,
        "not_chosen": [] if choice is None else list(choice.others),
        "status": status,
        "reason": reason,
    }


def table_rows(fit: SurfaceFit) -> list[tuple[str, str, str, str, str]]:
    """Name, value, standard and expanded uncertainty, unit."""
    rows = []
    for name, quantity in fit.quantities.items():
        digits = max(0, 2 - int(np.floor(np.log10(max(_scaled(quantity.unit, quantity.standard), 1e-9)))))
        value = _number(name, quantity.value)
        unit = "mm" if quantity.unit == "m" else "deg"
        numbers = value if isinstance(value, list) else [value]
        places = 7 if name in ("axis", "normal") else min(digits, 9)
        expanded = "-" if quantity.expanded is None else f"{_scaled(quantity.unit, quantity.expanded):.3g}"
        rows.append(
            (
                _outside(name),
                " ".join(f"{number:.{places}f}" for number in numbers),
                f"{_scaled(quantity.unit, quantity.standard):.3g}",
                expanded,
                unit,
            )
        )
    return rows


def _outside(name: str) -> str:
    """The name with the unit of files and screens."""
    return name.removesuffix("_m") + "_mm" if name.endswith("_m") else name.replace("_rad", "_deg")


def _number(name: str, value: FloatArray | float) -> list[float] | float:
    factor = _MM if name.endswith("_m") else np.degrees(1.0) if name.endswith("_rad") else 1.0
    return (factor * value).tolist() if isinstance(value, np.ndarray) else float(factor * value)


def _scaled(unit: str, value: float) -> float:
    return float(value * (_MM if unit == "m" else np.degrees(1.0)))


def _uncertain(unit: str, value: float | None) -> dict[str, float | str] | None:
    return None if value is None else {"value": _scaled(unit, value), "unit": "mm" if unit == "m" else "deg"}


def _finite(values: dict[str, Any]) -> dict[str, Any]:
    """JSON has no infinity."""
    return {
        key: None if isinstance(value, float) and not np.isfinite(value) else value
        for key, value in values.items()
    }
