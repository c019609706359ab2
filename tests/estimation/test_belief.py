import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.belief import Belief
from estimation.errors import EstimationError
from estimation.transform import Transform, exp_pose
from tests.estimation import twin


def some() -> Belief:
    sizes = twin.Sizes()
    belief = twin.with_plate(twin.laser_belief(sizes), sizes)
    return twin.with_part(twin.with_bar(belief, sizes), sizes)


def correlated(belief: Belief, seed: int = 1) -> Belief:
    mix = np.random.default_rng(seed).normal(size=(belief.size, belief.size))
    return belief.replaced(
        {}, {source: mix @ matrix @ mix.T for source, matrix in belief.contributions.items()}
    )


def test_contributions_add_up_to_the_covariance_and_are_the_budget() -> None:
    belief = correlated(some())
    total = np.sum(list(belief.contributions.values()), axis=0)
    assert np.allclose(total, belief.covariance, rtol=1e-14, atol=0)
    jacobian = np.random.default_rng(2).normal(size=(4, 3, belief.size))
    shares = sum(belief.budget(jacobian).values())
    assert np.allclose(shares, jacobian @ belief.covariance @ jacobian.swapaxes(1, 2), rtol=1e-9)


def test_labels_units_and_places_follow_the_blocks() -> None:
    belief = some()
    assert belief.labels[belief.index("laser")] == tuple(f"laser.{x}" for x in ("tx", "ty", "tz", "rx", "ry"))
    assert belief.block("kinematics").units[:3] == ("m", "rad", "rad")
    assert belief.block("laser.scale").units == ("1",)
    assert belief.std("plate") == pytest.approx([3e-3, 0.5 * twin.DEG, 0.5 * twin.DEG])
    assert belief.scalar("bar.length") == 0.2
    assert "form" in belief.contributions  # five faces, one line in the budget


def test_a_marginal_keeps_the_covariance_of_what_stays() -> None:
    belief = correlated(some())
    part = belief.marginal(["plate", "laser"])
    assert part.names == ("plate", "laser")
    assert np.array_equal(part.block_covariance("laser"), belief.block_covariance("laser"))
    cross = belief.covariance[belief.index("plate"), belief.index("laser")]
    assert np.array_equal(part.covariance[part.index("plate"), part.index("laser")], cross)
    rest = belief.without([*(name for name in belief.names if name.startswith("bar")), "no such block"])
    assert not any(name.startswith("bar") for name in rest.names)
    assert Belief().without(["x"]).size == 0


@given(st.lists(st.floats(1e-12, 1e3), min_size=3, max_size=3), st.floats(-3, 3), st.integers(0, 99))
def test_json_keeps_every_bit(std: list[float], angle: float, seed: int) -> None:
    pose = Transform("base", "plate", exp_pose(np.array([0.1, 0.2, 1 / 3, angle, 0.1, 0.0])))
    belief = Belief().with_block("plate", pose, std=std, freedoms=("tz", "rx", "ry"), source="prior")
    belief = correlated(belief.with_block("x", [angle, 1e-300], std=1 / 7), seed)
    again = Belief.from_dict(json.loads(json.dumps(belief.to_dict())))
    assert again.digest() == belief.digest()
    assert np.array_equal(again.covariance, belief.covariance)
    assert np.array_equal(again.transform("plate").matrix, pose.matrix)
    assert again.blocks[0].freedoms == ("tz", "rx", "ry")


def test_the_digest_sees_every_change() -> None:
    belief = some()
    nearly = belief.replaced({"laser.scale": np.array([1e-300])}, belief.contributions)
    relabelled = belief.replaced({}, {f"{source}!": m for source, m in belief.contributions.items()})
    assert (
        len({belief.digest(), nearly.digest(), relabelled.digest(), belief.without(["part"]).digest()}) == 4
    )
    assert some().digest() == belief.digest()


def test_impossible_blocks_are_refused_with_the_reason() -> None:
    belief = some()
    pose = belief.transform("plate")
    with pytest.raises(EstimationError, match="there already"):
        belief.with_block("plate", pose, std=1.0)
    with pytest.raises(EstimationError, match="no block 'probe'"):
        belief.value("probe")
    with pytest.raises(EstimationError, match="rx, tx"):
        belief.with_block("b", pose, std=1.0, freedoms=("rx", "tx"))
    with pytest.raises(EstimationError, match="either std or covariance"):
        belief.with_block("b", 0.0)
    with pytest.raises(EstimationError, match="not finite"):
        belief.with_block("b", np.nan, std=1.0)
    with pytest.raises(EstimationError, match="negative variance"):
        belief.with_block("b", [0.0, 0.0], covariance=np.array([[1.0, 2.0], [2.0, 1.0]]))
    with pytest.raises(EstimationError, match="below zero"):
        belief.with_block("b", 0.0, std=-1.0)
    with pytest.raises(EstimationError, match="damaged"):
        Belief.from_dict({"blocks": [{"name": "x"}], "contributions": {}})
