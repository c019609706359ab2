from collections.abc import Callable

import numpy as np
import pytest

from estimation.belief import Belief
from estimation.errors import EstimationError
from estimation.measurement import (
    JOINT_NOISE,
    RANGE_NOISE,
    SURFACE,
    TOUCH_NOISE,
    Chain,
    Observations,
    Points,
    object_point_jacobian,
    point_jacobian,
)
from estimation.model import evaluate
from estimation.surfaces import Feature, cylinder, sphere_features
from estimation.transform import FloatArray, Transform
from tests.estimation import twin, twin_poses

SIZES = twin.Sizes()
ARM = twin.arm()


def everything(rng: np.random.Generator) -> Belief:
    """A belief with all blocks there are, away from its nominal values."""
    belief = twin.with_plate(twin.laser_belief(SIZES), SIZES)
    belief = twin.with_part(twin.with_bar(belief, SIZES), SIZES)
    stylus = Transform("flange", "probe", twin.pose(np.array([-0.06, 0, 0.11, 0, 0, 0])))
    belief = belief.with_block("probe", stylus, std=1e-3, freedoms=("tx", "ty", "tz"))
    belief = belief.with_block("probe.radius", 1.5e-3, std=1e-5)
    sphere = Transform("base", "sphere", twin.pose(np.array([0.25, -0.15, 0.12, 0, 0, 0])))
    belief = belief.with_block("sphere", sphere, std=1e-3, freedoms=("tx", "ty", "tz"))
    belief = belief.with_block("sphere.radius", 12.5e-3, std=1e-5)
    belief = belief.with_block("part.bore", np.zeros(5), std=1e-3, freedoms=BORE.deviations)
    bump = Transform("laser", "laser", np.eye(4))
    belief = belief.with_block("bump", bump, std=1e-2, freedoms=("tx", "ty", "tz", "rx", "ry"))
    return moved(belief, rng.normal(size=belief.size) * np.sqrt(np.diag(belief.covariance)))


BORE = Feature(
    "bore",
    "cylinder",
    (0.05, 0.045, 0.09),
    (0.0, 0.0, 1.0),
    0.015,
    False,
    ("shift_x", "shift_y", "offset", "tilt_x", "tilt_y"),
    ("part.bore",),
)


def moved(belief: Belief, step: FloatArray) -> Belief:
    """The belief with its values perturbed by a step (n,): right perturbations for poses."""
    values: dict[str, Transform | FloatArray] = {}
    for block in belief.blocks:
        own = step[belief.index(block.name)]
        if isinstance(block.value, Transform):
            xi = np.zeros(6)
            xi[block.active] = own
            matrix = block.value.matrix @ twin.pose(xi)
            values[block.name] = Transform(block.value.target, block.value.source, matrix)
        else:
            values[block.name] = block.value + own
    return belief.replaced(values, belief.contributions)


def touches(object: str, q: FloatArray, features: tuple[Feature, ...]) -> Observations:
    m, zero = len(q), np.zeros(len(q))
    variance, first = np.full((m, 6), 1e-10), np.zeros(m, dtype=np.intp)
    return Observations("probe", object, q, variance, zero, zero + 1e-11, zero, features, first)


def batches(rng: np.random.Generator) -> list[Observations]:
    truth = twin.Truth.drawn(rng, SIZES)
    plate = twin_poses.plate_poses(240)[:6]
    bar, second = twin_poses.sphere_poses()
    part, face = twin_poses.part_poses(30)
    anywhere = twin.START_RAD + rng.normal(size=(6, 6)) * 0.3
    return [
        twin.laser_observations("plate", plate, truth.plate_readings(plate), SIZES),
        twin.laser_observations("bar", bar, np.full(len(bar), 0.09), SIZES, second),
        twin.laser_observations("part", part, truth.part_readings(part, face), SIZES, face),
        touches("sphere", anywhere, sphere_features()),
        touches("part", anywhere, (BORE,)),
    ]


def test_noise_free_readings_of_a_cell_that_is_as_believed_leave_no_residual() -> None:
    """The twin has its own kinematics and rays: order, side and sign of every error are checked here."""
    rng = np.random.default_rng(1)
    truth = twin.Truth.drawn(rng, SIZES)
    belief = twin.with_part(
        twin.with_bar(twin.with_plate(twin.laser_belief(SIZES), SIZES), SIZES), SIZES
    ).with_block("bump", Transform("laser", "laser", np.eye(4)), std=1e-3)
    truth = truth.bumped(np.array([1e-3, -2e-3, 5e-4, 0.01, -0.02, 0.005]))
    poses = {
        "laser": truth.laser,
        "plate": truth.plate,
        "bar": truth.bar,
        "part": truth.part,
        "bump": truth.bump,
    }
    values: dict[str, Transform | FloatArray] = {}
    for name, xi in poses.items():
        nominal = belief.transform(name)
        values[name] = Transform(nominal.target, nominal.source, nominal.matrix @ twin.pose(xi))
    values["kinematics"] = truth.kinematics
    values["laser.scale"], values["laser.offset"] = np.array([truth.scale]), np.array([truth.offset_m])
    for i, feature in enumerate(twin.face_features()):
        values[feature.blocks[0]] = truth.faces_m[i : i + 1]
    plate, (part, face) = twin_poses.plate_poses(240)[:40], twin_poses.part_poses(30)
    bar, second = twin_poses.sphere_poses(aside_m=0.002)
    bar_readings = truth.bar_readings(bar, second)
    seen = np.isfinite(bar_readings)
    rows = evaluate(
        belief.replaced(values, belief.contributions),
        Chain(
            ARM,
            [
                twin.laser_observations("plate", plate, truth.plate_readings(plate), SIZES),
                twin.laser_observations("bar", bar[seen], bar_readings[seen], SIZES, second[seen]),
                twin.laser_observations("part", part, truth.part_readings(part, face), SIZES, face),
            ],
        ),
    )
    assert seen.sum() > 20
    assert np.abs(rows.residual_m).max() < 1e-14


def test_row_20_every_jacobian_against_central_differences() -> None:
    rng = np.random.default_rng(2)
    belief, observed = everything(rng), batches(rng)
    jacobian = evaluate(belief, Chain(ARM, observed)).dense(belief)
    h = 1e-5
    numeric = np.column_stack(
        [
            evaluate(moved(belief, step), Chain(ARM, observed)).residual_m
            - evaluate(moved(belief, -step), Chain(ARM, observed)).residual_m
            for step in np.eye(belief.size) * h
        ]
    ) / (2 * h)
    error = np.linalg.norm(jacobian - numeric, axis=1) / np.linalg.norm(jacobian, axis=1)
    assert error.max() < 1e-6
    assert (np.abs(jacobian).max(axis=0) > 0.1 * 0.01).all()  # no column was left out


def test_row_20_noise_sensitivities_against_central_differences() -> None:
    rng = np.random.default_rng(3)
    belief = everything(rng)
    h = 1e-6
    for batch in batches(rng):
        noise = evaluate(belief, Chain(ARM, [batch])).noise
        variance = np.zeros(len(batch))
        for joint in range(6):
            ends = []
            for sign in (h, -h):
                q = batch.joints_rad + sign * np.eye(6)[joint]
                ends.append(evaluate(belief, Chain(ARM, [_with(batch, q, batch.reading_m)])).residual_m)
            variance += ((ends[0] - ends[1]) / (2 * h)) ** 2 * batch.joint_variance[:, joint]
        assert noise[JOINT_NOISE] == pytest.approx(variance, rel=1e-5)
        if batch.sensor == "laser":
            up = evaluate(
                belief, Chain(ARM, [_with(batch, batch.joints_rad, batch.reading_m + h)])
            ).residual_m
            down = evaluate(
                belief, Chain(ARM, [_with(batch, batch.joints_rad, batch.reading_m - h)])
            ).residual_m
            expected = ((up - down) / (2 * h)) ** 2 * batch.reading_variance
            assert noise[RANGE_NOISE] == pytest.approx(expected, rel=1e-5)
        else:
            assert noise[TOUCH_NOISE] == pytest.approx(batch.reading_variance)
        assert noise[SURFACE] == pytest.approx(batch.surface_variance)


def _with(batch: Observations, q: FloatArray, reading_m: FloatArray) -> Observations:
    return Observations(
        batch.sensor, batch.object, q, batch.joint_variance, reading_m, batch.reading_variance,
        batch.surface_variance, batch.features, batch.feature_index,
    )  # fmt: skip


def test_row_20_jacobians_of_gated_points_against_central_differences() -> None:
    rng = np.random.default_rng(4)
    belief = everything(rng)
    readings, q = np.array([0.06, 0.085, 0.11]), twin_poses.plate_poses(240)[:3]
    corners = np.array([[0.0, 0.0, 0.0], [0.1, 0.15, 0.1]])
    h = 1e-5
    gated: list[Callable[[Belief], Points]] = [
        lambda b: point_jacobian(b, readings),
        lambda b: point_jacobian(b, readings, ARM, q),
        lambda b: object_point_jacobian(b, "part", corners),
    ]
    for of in gated:
        found = of(belief)
        numeric = np.stack(
            [
                (of(moved(belief, step)).points_m - of(moved(belief, -step)).points_m) / (2 * h)
                for step in np.eye(belief.size) * h
            ],
            axis=2,
        )
        assert np.abs(found.jacobian - numeric).max() < 1e-8
        covariance = found.covariance(belief)
        assert np.allclose(sum(found.budget(belief).values()), covariance, rtol=1e-12, atol=1e-20)


def test_batches_in_another_order_give_the_same_rows() -> None:
    rng = np.random.default_rng(5)
    belief, observed = everything(rng), batches(rng)
    rows, back = evaluate(belief, Chain(ARM, observed)), evaluate(belief, Chain(ARM, observed[::-1]))
    first = len(observed[0])
    assert np.array_equal(rows.residual_m[:first], back.residual_m[-first:])
    assert np.array_equal(rows.noise_variance[:first], back.noise_variance[-first:])


def test_what_is_missing_or_broken_is_named() -> None:
    belief = twin.laser_belief(SIZES)
    q = twin_poses.plate_poses(240)[:4]
    with pytest.raises(EstimationError, match="no pose 'plate'"):
        evaluate(belief, Chain(ARM, [twin.laser_observations("plate", q, np.full(4, 0.08), SIZES)]))
    with pytest.raises(EstimationError, match="reading_m"):
        twin.laser_observations("plate", q, np.array([0.08, np.nan, 0.08, 0.08]), SIZES)
    with pytest.raises(EstimationError, match=r"reading_m.*\(3,\), expected \(4,\)"):
        twin.laser_observations("plate", q, np.full(3, 0.08), SIZES)
    with pytest.raises(EstimationError, match="feature_index up to 1 of 1"):
        twin.laser_observations("plate", q, np.full(4, 0.08), SIZES, np.ones(4, dtype=np.intp))
    bore = cylinder("bore", np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.01, False, "part.bore")
    with pytest.raises(EstimationError, match=r"no vector 'part\.bore'"):
        evaluate(
            everything(np.random.default_rng(1)).without(["part.bore"]),
            Chain(ARM, [touches("part", q, (bore,))]),
        )
