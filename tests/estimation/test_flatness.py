"""Flatness of wavy and perfect faces, touched with and without noise: does the statement hold the truth?"""

import numpy as np
import pytest

from estimation.errors import DegenerateGeometry
from estimation.flatness import FlatnessEstimate, flatness
from estimation.transform import FloatArray

TOUCHES, WAVE_M = 9, 0.04


def wavy(face_p: FloatArray, amplitude_m: float, random: np.random.Generator) -> FloatArray:
    phase = random.uniform(0.0, 2.0 * np.pi, 2)
    waves: FloatArray = np.prod(np.sin(2.0 * np.pi / WAVE_M * face_p + phase), axis=1)
    return amplitude_m * waves


def estimates(amplitude_m: float, noise_m: float, count: int = 200) -> list[FlatnessEstimate]:
    random, found = np.random.default_rng(7), []
    for _ in range(count):
        face_p = random.uniform((0.0, 0.0), (0.1, 0.15), (TOUCHES, 2))
        common_m = 50e-6 * random.standard_normal()  # height of the face: no matter for its flatness
        distance = wavy(face_p, amplitude_m, random) + common_m + noise_m * random.standard_normal(TOUCHES)
        found.append(flatness(face_p, distance, noise_m**2 * np.eye(TOUCHES) + (50e-6) ** 2))
    return found


@pytest.mark.parametrize(("amplitude_m", "noise_m"), [(0, 10e-6), (5e-6, 10e-6), (5e-6, 1e-6), (20e-6, 5e-6)])
def test_the_stated_uncertainty_holds_the_truth(amplitude_m: float, noise_m: float) -> None:
    inside = [abs(e.value_m - 2.0 * amplitude_m) <= 2.0 * e.u_m for e in estimates(amplitude_m, noise_m)]
    assert np.mean(inside) > 0.92


def test_well_measured_waves_are_seen_as_high_as_they_are() -> None:
    found = estimates(amplitude_m=20e-6, noise_m=0.2e-6)
    assert np.mean([e.value_m for e in found]) == pytest.approx(40e-6, rel=0.1)


def test_noise_is_not_taken_for_form() -> None:
    """The range of nine residuals of a perfect face is three times the noise, whatever is done after."""
    random = np.random.default_rng(3)
    face_p = np.array([[u, v] for u in (0.0, 0.05, 0.1) for v in (0.0, 0.07, 0.15)])
    plane = np.column_stack([np.ones(9), face_p])
    left = np.eye(9) - plane @ np.linalg.pinv(plane)
    noise = 10e-6 * random.standard_normal((200, 9))
    ranges = np.ptp(noise @ left, axis=1)
    stated = [flatness(face_p, distance, 1e-10 * np.eye(9)) for distance in noise]
    assert np.mean(ranges) > 22e-6
    assert np.mean([e.value_m - e.u_m for e in stated]) < 10e-6


def test_a_tilt_and_a_height_change_nothing() -> None:
    random = np.random.default_rng(4)
    face_p = random.uniform(0.0, 0.1, (TOUCHES, 2))
    distance = wavy(face_p, 10e-6, random)
    covariance = 1e-12 * np.eye(TOUCHES)
    plain = flatness(face_p, distance, covariance)
    tilted = flatness(face_p, distance + 1e-3 + face_p @ np.array([2e-3, -1e-3]), covariance)
    assert tilted.value_m == pytest.approx(plain.value_m, rel=1e-6)
    assert tilted.u_m == pytest.approx(plain.u_m, rel=1e-6)


@pytest.mark.parametrize("shape", ["few", "line"])
def test_touches_that_tell_nothing_are_refused(shape: str) -> None:
    face_p = np.zeros((TOUCHES, 2))
    face_p[:, 0] = np.linspace(0.0, 0.1, TOUCHES)
    face_p = face_p[:5] if shape == "few" else face_p
    with pytest.raises(DegenerateGeometry, match="on one line"):
        flatness(face_p, np.zeros(len(face_p)), np.eye(len(face_p)) * 1e-12)
