"""Flatness from touches that are not much better than the face: the form that the noise leaves believable."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from estimation.errors import DegenerateGeometry
from estimation.transform import FloatArray

_SCALES: Final = 120  # grid of form standard deviations
_DRAWS: Final = 60  # of the form at each of them
_LARGEST_RATIO: Final = 12.0  # of the form to the residuals: beyond it nothing is believable
_LEAST_FREE: Final = 3


@dataclass(frozen=True, slots=True)
class FlatnessEstimate:
    """Distance of the two planes between which the face lies, with its standard uncertainty, metres."""

    value_m: float
    u_m: float


def flatness(face_p: FloatArray, distance_m: FloatArray, covariance: FloatArray) -> FlatnessEstimate:
    """Peak to valley of a face about its least-squares plane, free of the bias of noise.

    The plain range of the residuals grows with noise and with the number of touches, even on a perfect face.
    Here the form is a random deviation, independent at touches this far apart, of unknown standard deviation
    (uniform prior: Gelman 2006). Given the distances and their noise, its posterior is known in closed form
    for each standard deviation, and the range is averaged over it. The face between the touches deviates as
    at them: as many places again are drawn. With few noisy touches the value lies above the truth, within U.

    Parameters
    ----------
    face_p : (n, 2), metres: where on the face; n >= 6.
    distance_m : (n,), metres: signed distance of each touch from the nominal face.
    covariance : (n, n), square metres: of their errors, without the form.

    Raises
    ------
    DegenerateGeometry
        Fewer than 6 touches, or touches nearly on one line.
    """
    count = len(face_p)
    plane = np.column_stack([np.ones(count), face_p - face_p.mean(axis=0)])
    basis, singular, _ = np.linalg.svd(plane / np.linalg.norm(plane, axis=0, keepdims=True).clip(1e-12))
    if count < 3 + _LEAST_FREE or singular[-1] < 1e-3 * singular[0]:
        raise DegenerateGeometry(
            f"Flatness from {count} touches, or all of them on one line",
            f"Touch the face at {3 + _LEAST_FREE} places or more, spread over it",
        )
    across = basis[:, 3:]  # (n, n-3): what no plane can take up
    noise, turn = np.linalg.eigh(across.T @ covariance @ across)
    noise = np.maximum(noise, 1e-24)
    across = across @ turn
    seen = across.T @ distance_m
    scale = _scales(seen, noise)
    total = scale[:, None] ** 2 + noise  # (s, n-3)
    logs = -0.5 * np.sum(seen**2 / total + np.log(total), axis=1)
    weight = np.exp(logs - logs.max()) * np.gradient(scale)
    weight /= weight.sum()
    share = scale[:, None] ** 2 / total
    random = np.random.default_rng(0)  # the same draws each time: a pure function
    normal = random.standard_normal((_DRAWS, len(noise)))
    form = (share * seen)[:, None] + np.sqrt(share * noise)[:, None] * normal  # (s, draws, n-3)
    touched = form @ across.T
    between = scale[:, None, None] * random.standard_normal((_DRAWS, count))
    face = np.concatenate([touched, between], axis=2)
    ranges = face.max(axis=2) - face.min(axis=2)
    value = float(weight @ ranges.mean(axis=1))
    square = float(weight @ (ranges**2).mean(axis=1))
    return FlatnessEstimate(value, float(np.sqrt(max(square - value**2, 0.0))))


def _scales(seen: FloatArray, noise: FloatArray) -> FloatArray:
    """Standard deviations of the form, evenly spaced, up to where the data leave no room for them."""
    largest = _LARGEST_RATIO * np.sqrt(max(float(np.mean(seen**2)), 1e-3 * float(noise.mean())))
    return np.linspace(0.0, largest, _SCALES + 1)[1:]
