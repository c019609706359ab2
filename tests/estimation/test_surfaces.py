import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import DegenerateGeometry, EstimationError
from estimation.surfaces import (
    DEVIATIONS,
    Feature,
    bar_features,
    cone,
    cylinder,
    plane,
    signed_distance,
    torus,
)
from estimation.transform import FloatArray

UP = np.array([0.0, 0.0, 1.0])
CENTRE = np.array([0.05, 0.045, 0.09])
ALL = DEVIATIONS
OWN = {"cone": ("half_angle",), "torus": ("major_radius",)}
KINDS = ("plane", "sphere", "cylinder", "cone", "torus")


def any_feature(name: str, kind: str, point: FloatArray, axis: FloatArray, outward: bool) -> Feature:
    return Feature(
        name,
        kind,  # type: ignore[arg-type]
        tuple(point),
        tuple(axis),
        0.0 if kind in ("plane", "cone") else 0.3,
        outward or kind == "plane",
        (*ALL, *OWN.get(kind, ())),
        (name,),
        half_angle_rad=0.4 if kind == "cone" else 0.0,
        major_radius_m=0.8 if kind == "torus" else 0.0,
    )


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


@given(kind=st.sampled_from(KINDS), outward=st.booleans(), seed=st.integers(0, 2**32 - 1))
def test_row_20_gradient_and_deviation_derivatives_against_central_differences(
    kind: str, outward: bool, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    features = tuple(
        any_feature(name, kind, rng.normal(size=3), axis, outward) for name in ("first", "second")
    )
    index, points = np.array([0, 1, 1]), rng.normal(size=(3, 3)) * 2
    size = 2 * len(features[0].deviations)
    parameters = rng.normal(size=size) * 0.02
    found = signed_distance(features, index, points, parameters)
    # The second derivative grows without bound towards a centre, an axis or the edge behind an apex.
    h, near = 1e-6, 4e-6 / min(0.3, *(clearance(feature, points) for feature in features))
    for column, step in enumerate(np.eye(3) * h):
        up = signed_distance(features, index, points + step, parameters).distance_m
        down = signed_distance(features, index, points - step, parameters).distance_m
        assert found.gradient[:, column] == pytest.approx((up - down) / (2 * h), abs=near)
    for column, step in enumerate(np.eye(size) * h):
        up = signed_distance(features, index, points, parameters + step).distance_m
        down = signed_distance(features, index, points, parameters - step).distance_m
        assert found.deviation[:, column] == pytest.approx((up - down) / (2 * h), abs=near)


def clearance(feature: Feature, points: FloatArray) -> float:
    """How far the points stay from where the distance has a kink, metres; 0.02 m of deviation allowed for."""
    arm = points - np.array(feature.point_m)
    along = arm @ np.array(feature.axis)
    across = np.linalg.norm(arm - along[:, None] * np.array(feature.axis), axis=1)
    kinks = {
        "plane": np.full(1, np.inf),
        "sphere": np.linalg.norm(arm, axis=1),
        "cylinder": across,
        "cone": np.minimum(across, np.abs(across * np.sin(0.4) + along * np.cos(0.4))),
        "torus": np.minimum(across, np.hypot(across - 0.8, along)),
    }[feature.kind]
    return max(float(kinks.min()), 1e-3)


@given(st.integers(0, 2**32 - 1))
def test_a_deviated_feature_is_the_feature_with_its_parameters(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for kind in KINDS:
        feature = any_feature("f", kind, np.array([0.1, 0.2, 0.3]), np.array([0.0, 0.6, 0.8]), False)
        values = rng.normal(size=len(feature.deviations)) * 1e-5
        # On the side of the cone: behind its apex, parallel cones are not the same cone moved.
        point = np.array(feature.point_m) + np.array(feature.axis) + 0.2 * rng.normal(size=3)
        assert distance(feature, point, values) == pytest.approx(
            distance(feature.deviated(values.tolist()), point), abs=2e-8
        )


def test_cone_and_torus_by_hand() -> None:
    tip = cone("tip", CENTRE, UP, np.arctan(0.75), outward=True)  # generating line along (3, 0, 4) / 5
    assert distance(tip, beside(0.03, 0, 0.04)) == pytest.approx(0.0, abs=1e-15)
    assert distance(tip, beside(0.03 + 0.0008, 0, 0.04 - 0.0006)) == pytest.approx(0.001)
    assert distance(tip, beside(0.0, 0.0006, -0.0008)) == pytest.approx(0.001)  # behind the apex
    ring = torus("ring", CENTRE, UP, 0.04, 0.01, outward=True)
    assert distance(ring, beside(0, 0.04, 0.011)) == pytest.approx(0.001)
    assert distance(ring, beside(0.028, 0, 0)) == pytest.approx(0.002)
    assert distance(torus("groove", CENTRE, UP, 0.04, 0.01, False), beside(0.031, 0, 0)) == pytest.approx(
        0.001
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
    with pytest.raises(EstimationError, match=r"Cone tip has a half angle of 90 deg"):
        cone("tip", CENTRE, UP, np.pi / 2, True)
    with pytest.raises(EstimationError, match=r"tube of 50 mm"):
        torus("ring", CENTRE, UP, 0.04, 0.05, True)
    with pytest.raises(EstimationError, match="shape"):
        Feature("skin", "freeform", (0, 0, 0))
    with pytest.raises(EstimationError, match="half_angle"):
        Feature("top", "plane", (0, 0, 0), deviations=("half_angle",), blocks=("b",))
