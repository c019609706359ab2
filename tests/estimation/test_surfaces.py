import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import DegenerateGeometry, EstimationError
from estimation.surfaces import DEVIATIONS, Feature, bar_features, cylinder, plane, signed_distance
from estimation.transform import FloatArray

UP = np.array([0.0, 0.0, 1.0])
CENTRE = np.array([0.05, 0.045, 0.09])
ALL = DEVIATIONS


def beside(x: float, y: float, z: float) -> FloatArray:
    return np.asarray(np.add(CENTRE, [x, y, z]))


def distance(
    feature: Feature, point: list[float] | FloatArray, parameters: FloatArray | None = None
) -> float:
    return float(
        signed_distance((feature,), np.zeros(1, dtype=np.intp), np.array([point]), parameters).distance_m[0]
    )


def test_distance_is_positive_where_there_is_no_material() -> None:
    face = plane("top", np.array([0.0, 0.0, 0.1]), UP)
    boss = cylinder("boss", CENTRE, UP, 0.0125, outward=True)
    bore = cylinder("bore", CENTRE, UP, 0.015, outward=False)
    assert distance(face, [0.3, 0.2, 0.101]) == pytest.approx(0.001)
    assert distance(boss, beside(0.0135, 0, 0.2)) == pytest.approx(0.001)
    assert distance(bore, beside(0.0, 0.014, -0.01)) == pytest.approx(0.001)


def test_offset_moves_the_surface_out_of_the_material_so_a_boss_grows_and_a_bore_shrinks() -> None:
    boss = cylinder("boss", CENTRE, UP, 0.0125, True, "part.boss")
    bore = cylinder("bore", CENTRE, UP, 0.015, False, "part.bore")
    for feature in (boss, bore):
        assert feature.deviations == ("shift_x", "shift_y", "offset")
        assert distance(feature, beside(0.02, 0, 0), np.array([0, 0, 1e-4])) == pytest.approx(
            distance(feature, beside(0.02, 0, 0)) - 1e-4
        )
    assert boss.deviated((0.0, 0.0, 1e-4)).radius_m == pytest.approx(0.0126)
    assert bore.deviated((0.0, 0.0, 1e-4)).radius_m == pytest.approx(0.0149)


def test_the_second_sphere_of_a_bar_stands_at_the_length_and_has_the_shared_radius() -> None:
    features = bar_features()
    points = np.array([[0.015, 0.0, 0.0], [0.0, 0.016, 0.2]])
    found = signed_distance(features, np.array([0, 1]), points, np.array([0.015, 0.2]))
    assert found.distance_m == pytest.approx([0.0, 0.001])
    assert found.deviation == pytest.approx(np.array([[-1.0, 0.0], [-1.0, 0.0]]))  # by radius, by length


@given(
    kind=st.sampled_from(["plane", "sphere", "cylinder"]),
    outward=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_row_20_gradient_and_deviation_derivatives_against_central_differences(
    kind: str, outward: bool, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    features = tuple(
        Feature(name, kind, tuple(rng.normal(size=3)), tuple(axis), 0.3, outward, ALL, (name,))  # type: ignore[arg-type]
        for name in ("first", "second")
    )
    index, points = np.array([0, 1, 1]), rng.normal(size=(3, 3)) * 2
    parameters = rng.normal(size=14) * 0.02
    found = signed_distance(features, index, points, parameters)
    h = 1e-6
    for column, step in enumerate(np.eye(3) * h):
        up = signed_distance(features, index, points + step, parameters).distance_m
        down = signed_distance(features, index, points - step, parameters).distance_m
        assert found.gradient[:, column] == pytest.approx((up - down) / (2 * h), abs=1e-6)
    for column, step in enumerate(np.eye(14) * h):
        up = signed_distance(features, index, points, parameters + step).distance_m
        down = signed_distance(features, index, points, parameters - step).distance_m
        assert found.deviation[:, column] == pytest.approx((up - down) / (2 * h), abs=3e-6)


@given(st.integers(0, 2**32 - 1))
def test_a_deviated_feature_is_the_feature_with_its_parameters(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.normal(size=7) * 1e-5
    for kind in ("plane", "sphere", "cylinder"):
        feature = Feature("f", kind, (0.1, 0.2, 0.3), (0.0, 0.6, 0.8), 0.05, False, ALL, ("b",))
        point = rng.normal(size=3)
        assert distance(feature, point, values) == pytest.approx(
            distance(feature.deviated(values.tolist()), point), abs=1e-8
        )


def test_features_that_cannot_be_are_refused_by_name() -> None:
    with pytest.raises(EstimationError, match=r"top.*axis of length 2"):
        Feature("top", "plane", (0, 0, 0), (0, 0, 2.0))
    with pytest.raises(EstimationError, match="top deviates by bend"):
        Feature("top", "plane", (0, 0, 0), deviations=("bend",), blocks=("b",))
    with pytest.raises(EstimationError, match="2 deviations in 0 blocks"):
        Feature("top", "plane", (0, 0, 0), deviations=("offset", "tilt_x"))
    with pytest.raises(DegenerateGeometry, match="axis of bore"):
        distance(cylinder("bore", CENTRE, UP, 0.015, False), beside(0, 0, 0.3))
