"""Torque of gravity is the fall of potential energy with each joint."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.errors import EstimationError
from estimation.kinematics import ArmModel
from estimation.loads import GRAVITY_M_S2, GravityLoad
from estimation.transform import FloatArray

angles = st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6).map(np.array)
masses = st.lists(st.floats(0.0, 20.0), min_size=6, max_size=6).map(np.array)
centres = st.lists(st.floats(-0.3, 0.3), min_size=21, max_size=21).map(lambda v: np.reshape(v, (7, 3)))


@settings(max_examples=30)
@given(q=angles, mass=masses, payload=st.floats(0.0, 10.0), place=centres)
def test_torque_is_minus_the_gradient_of_potential_energy(
    prbt: ArmModel, q: FloatArray, mass: FloatArray, payload: float, place: FloatArray
) -> None:
    up = np.array([0.6, 0.0, 0.8])
    load = GravityLoad(payload, place[6], mass, place[:6], up)

    def energy_j(joints: FloatArray) -> FloatArray:
        height = np.zeros(len(joints))
        for row, angles_of_row in enumerate(joints):
            for link in range(7):
                part = min(link, 5) + 1  # each link on an arm that is cut behind it
                cut = ArmModel.from_dh(*(getattr(prbt, name)[:part] for name in ("theta", "d", "a", "alpha")))
                end = cut.flange_pose(angles_of_row[:part])
                at = end[:3, :3] @ place[link] + end[:3, 3]
                height[row] += np.append(mass, payload)[link] * GRAVITY_M_S2 * (up @ at)
        return height

    steps = 1e-5 * np.eye(6)
    slope = (energy_j(q + steps) - energy_j(q - steps)) / 2e-5
    assert load.torque_nm(prbt, q[None])[0] == pytest.approx(-slope, abs=1e-5)


def test_a_payload_alone_is_the_simple_case(prbt: ArmModel) -> None:
    """Straight up nothing turns; out to the side, joint 2 holds weight times arm."""
    load = GravityLoad(2.0)
    assert load.torque_nm(prbt, np.zeros((1, 6)))[0] == pytest.approx(np.zeros(6), abs=1e-12)
    aside = load.torque_nm(prbt, np.array([[0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0]]))[0]
    assert abs(aside[1]) == pytest.approx(2.0 * GRAVITY_M_S2 * (0.350 + 0.307 + 0.084), rel=1e-9)
    assert aside[0] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("load", "message"),
    [
        (GravityLoad(-1.0), "A mass is -1 kg"),
        (GravityLoad(1.0, link_kg=[1.0] * 5), r"Masses of shape \(5,\)"),
        (GravityLoad(1.0, link_kg=[1.0] * 6, link_m=np.zeros((6, 2))), r"centres \(6, 2\)"),
    ],
)
def test_refuses_masses_that_are_none(prbt: ArmModel, load: GravityLoad, message: str) -> None:
    with pytest.raises(EstimationError, match=message):
        load.torque_nm(prbt, np.zeros((1, 6)))
