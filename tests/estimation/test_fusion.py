"""Sets of measurements, fused one by one, against all of them at once."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimation.belief import POSE_FREEDOMS, Belief
from estimation.errors import EstimationError
from estimation.fusion import Tangent, fuse
from estimation.localization.points import SharedError, SurfacePoints, hand_eye_error
from estimation.solver import update
from estimation.surfaces import plane
from estimation.transform import FloatArray, Transform, exp_pose, log_pose

FACES = (
    plane("top", np.array([0.0, 0, 0.05]), np.array([0, 0, 1.0])),
    plane("side", np.array([0.08, 0, 0]), np.array([1.0, 0, 0])),
    plane("slope", np.array([0, 0.06, 0.02]), np.array([0, 0.8, 0.6])),
)
SETS, EACH = 96, 24
HAND_EYE = np.diag(np.array([1e-4, 1e-4, 1e-4, 3e-4, 3e-4, 3e-4]) ** 2)


def points(count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    index = rng.integers(0, 3, count)
    away = rng.uniform(-0.05, 0.05, (count, 3))
    axis, place = (np.array([getattr(f, k) for f in FACES])[index] for k in ("axis", "point_m"))
    return place + away - np.einsum("mi,mi->m", away, axis)[:, None] * axis, index


def laser_points(count: int, seed: int, turning: bool = True) -> SurfacePoints:
    """Points that all carry one error of the hand-eye calibration, each seen from another side."""
    rng = np.random.default_rng(seed)
    object_p, index = points(count, rng)
    turned = Rotation.from_rotvec(turning * rng.normal(size=(count, 3))).as_matrix()
    sensor_p = np.column_stack([np.zeros(count), rng.uniform(-0.02, 0.02, count), np.full(count, 0.08)])
    error = hand_eye_error("hand-eye", HAND_EYE, turned, sensor_p)
    base_p = object_p - error.by_point @ np.linalg.cholesky(HAND_EYE) @ np.ones(6)
    base_p = base_p + 3e-5 * rng.normal(size=(count, 3))
    covariance = np.broadcast_to(3e-5**2 * np.eye(3), (count, 3, 3))
    return SurfacePoints(base_p, covariance, FACES, index, (error,), "part")


def touches(count: int, seed: int) -> SurfacePoints:
    """Points of a probe, all off by one error of its ball along the normals."""
    rng = np.random.default_rng(seed)
    object_p, index = points(count, rng)
    normal = np.array([f.axis for f in FACES])[index]
    ball = SharedError("ball", np.array([[2e-5**2]]), normal[:, :, None], ("radius",))
    covariance = np.broadcast_to(5e-6**2 * np.eye(3), (count, 3, 3))
    return SurfacePoints(
        object_p + 1e-5 * normal + 5e-6 * rng.normal(size=(count, 3)),
        covariance,
        FACES,
        index,
        (ball,),
        "part",
    )


def split(model: SurfacePoints, size: int) -> Iterator[SurfacePoints]:
    for begin in range(0, len(model), size):
        some = slice(begin, begin + size)
        shared = tuple(replace(each, by_point=each.by_point[some]) for each in model.shared)
        yield replace(
            model,
            base_p=model.base_p[some],
            covariance=model.covariance[some],
            index=model.index[some],
            shared=shared,
        )


def prior(std_m: float = np.inf) -> Belief:
    start = Transform("base", "part", exp_pose(np.array([2e-3, -1e-3, 1e-3, 0.01, 0.005, -0.01])))
    belief = Belief().with_block("hand-eye", np.zeros(6), covariance=HAND_EYE, freedoms=POSE_FREEDOMS)
    belief = belief.with_block("ball", 0.0, std=2e-5)
    return belief.with_block("part", start, std=std_m)


@pytest.mark.parametrize("std_m", [np.inf, 0.01])
def test_row_16_sets_of_one_tangent_are_the_batch(std_m: float) -> None:
    batch, tangent = laser_points(SETS * EACH, 1), Tangent.at(prior(std_m))
    sets = [tangent.see(each) for each in split(batch, EACH)]
    total = sets[0]
    for each in sets[1:]:
        total = total + each
    one, all_ = tangent.fused(total), tangent.fused(tangent.see(batch))
    assert one.belief.covariance == pytest.approx(all_.belief.covariance, rel=1e-10, abs=1e-22)
    assert one.belief.transform("part").matrix == pytest.approx(
        all_.belief.transform("part").matrix, abs=1e-10
    )
    assert one.chi2 == pytest.approx(all_.chi2, rel=1e-9)


@pytest.mark.parametrize("std_m", [np.inf, 0.01])
def test_row_16_after_a_second_pass_they_are_the_converged_batch(std_m: float) -> None:
    batch, belief = laser_points(SETS * EACH, 2), prior(std_m)
    found = fuse(belief, list(split(batch, EACH)))
    converged = update(belief, batch)
    std = np.sqrt(np.diag(converged.belief.covariance))
    assert _gap(found.belief, converged.belief) < 0.01
    assert np.sqrt(np.diag(found.belief.covariance)) == pytest.approx(std, rel=1e-3)
    assert found.chi2 == pytest.approx(converged.chi2, rel=1e-3) and found.dof == converged.dof
    assert set(found.belief.contributions) == set(converged.belief.contributions)


def test_a_shared_error_keeps_its_floor_through_all_sets() -> None:
    """One orientation of the sensor: nothing tells a shift of it from a shift of the part."""
    few, many = (
        fuse(prior(), list(split(laser_points(count, 3, turning=False), EACH))).belief.std("part")[:3]
        for count in (10 * EACH, 96 * EACH)
    )
    assert many == pytest.approx(few, rel=0.02)
    assert (many > 0.9e-4).all()


def test_laser_and_touch_in_any_order_or_together_give_the_same() -> None:
    laser, touch, belief = laser_points(300, 4), touches(30, 5), prior()
    together = fuse(belief, [laser, touch])
    first = update(belief, laser).belief
    turns = update(first, touch).belief
    assert _gap(together.belief, turns) < 0.01
    assert together.belief.std("part") == pytest.approx(turns.std("part"), rel=1e-3)
    assert (together.belief.std("part") < first.std("part")).all()


def test_an_empty_stream_is_refused_and_one_that_cannot_be_read_again_too() -> None:
    with pytest.raises(EstimationError, match="read again"):
        fuse(prior(), [])
    with pytest.raises(EstimationError, match="read again"):
        fuse(prior(), split(laser_points(100, 6), 20))


def _gap(one: Belief, other: Belief) -> float:
    """Largest difference of any unknown, in standard deviations."""
    gaps = []
    for block in other.blocks:
        here = one.value(block.name)
        if isinstance(here, Transform):
            gap = log_pose(other.transform(block.name).inverse().matrix @ here.matrix)
        else:
            gap = here - other.vector(block.name)
        gaps.append(np.abs(gap / other.std(block.name)).max())
    return float(max(gaps))
