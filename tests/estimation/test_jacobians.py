"""Row 20: every model that the solver sees, each column, against differences; near the truth of random cells.

Columns are the parameters there are: mounts and objects with 3, 5 and 6 freedoms, axes, kinematic parameters,
compliance, scale, offset, radii, form, certificates, pose errors, errors that points share, deviations and
control points of features. Single surfaces, fits and arms have tests of their own beside theirs.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.belief import Belief
from estimation.localization.points import SharedError
from estimation.localization.task import Localization
from estimation.measurement import Chain
from estimation.model import Model, values_of
from estimation.surfaces import Feature
from estimation.surfaces.feature import freeform
from estimation.transform import FloatArray, Transform
from tests.estimation import test_measurement
from tests.estimation.blade import blade_mesh, patch, points_on
from tests.estimation.tasks.arm_cells import tracker_cell
from tests.estimation.tasks.cells import CELLS, Make
from tests.estimation.tasks.layout import MM, Setting, anywhere
from tests.estimation.tasks.pair_cells import PAIR_CELLS
from tests.estimation.tasks.positioner_cells import positioner_cell
from tests.estimation.tasks.two_robot_cells import TWO_ROBOT_CELLS
from tests.estimation.test_measurement import moved
from tests.estimation.test_surfaces import KINDS, any_feature
from tests.estimation.twin import FREE, arm

Rng = np.random.Generator
At = tuple[Model, Belief]
STEP = 1e-4
MOST_COLUMNS = 20
OFF = 0.05  # how far from the truth, m and rad


def at_truth(problem: Any, truth: dict[str, FloatArray]) -> At:
    belief = problem.belief()
    found: dict[str, Any] = {}
    for name, true in truth.items():
        value = belief.value(name)
        found[name] = Transform(value.target, value.source, true) if isinstance(value, Transform) else true
    return problem.model(), belief.replaced({**values_of(belief), **found}, belief.contributions)


def of_cell(rng: Rng, make: Make, **changes: Any) -> At:
    cell = make(rng)
    return at_truth(replace(cell.problem, **changes), cell.truth)


def of_joints(rng: Rng, make: Make) -> At:
    """Kinematics and the errors of poses that readings share."""
    cell = make(rng, count=40, setting=Setting(arm=True))
    motion = replace(cell.problem.motion, arm=replace(arm(), free=FREE), kinematics_std=1e-3)
    return at_truth(replace(cell.problem, motion=motion), cell.truth)


def of_tracker(rng: Rng) -> At:
    cell = tracker_cell(rng, count=12, reflectors=2)
    return at_truth(cell.problem, {})


def of_positioner(rng: Rng, kind: str) -> At:
    return at_truth(positioner_cell(rng, kind, each=4).problem, {})


def of_cell_chain(rng: Rng) -> At:
    return Chain(test_measurement.ARM, test_measurement.batches(rng)), test_measurement.everything(rng)


def of_localization(rng: Rng, features: tuple[Feature, ...], object_p: FloatArray, index: FloatArray) -> At:
    """Signed distances of points that share an error, to features each with a form of its own."""
    base_T_object = anywhere(rng)
    base_p = object_p @ base_T_object[:3, :3].T + base_T_object[:3, 3]
    shared = SharedError("shared", 1e-6 * np.eye(3), rng.normal(size=(len(base_p), 3, 3)), ("tx", "ty", "tz"))
    problem = Localization(
        base_p=base_p,
        covariance=1e-10 * np.eye(3),
        surface=features,
        index=index.astype(np.intp),
        shared=(shared,),
        form_std_m={feature.name: 1e-4 for feature in features},
    )
    return at_truth(problem, {"object": base_T_object})


def of_features(rng: Rng) -> At:
    """Points beside each kind, well away from centres and axes."""
    axis = np.array([0.36, 0.48, 0.8])
    features = tuple(
        replace(any_feature(kind, kind, rng.uniform(-0.1, 0.1, 3), axis, True), deviations=(), blocks=())
        for kind in KINDS
    )
    index = np.repeat(np.arange(len(KINDS)), 4)
    side = np.cross(axis, rng.normal(size=(len(index), 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    along = rng.uniform(0.1, 0.4, (len(index), 1))
    centre = np.array([feature.point_m for feature in features])[index]
    return of_localization(rng, features, centre + 0.5 * side + along * axis, index)


def of_free_forms(rng: Rng) -> At:
    mesh, skin = blade_mesh(), patch()
    on_skin = skin.points(rng.uniform(0.2, 0.8, (8, 2)))
    object_p = np.concatenate([points_on(mesh, 8, rng), on_skin]) + 1e-4 * rng.normal(size=(16, 3))
    features = (freeform("mesh", mesh), freeform("skin", skin))
    return of_localization(rng, features, object_p, np.repeat([0, 1], 8))


ERRORS: dict[str, dict[str, Any]] = {
    "point-laser-plane": {"scale_std": 1e-3, "offset_std_m": 1e-4},
    "point-laser-sphere": {"scale_std": 1e-3, "radius_std_m": 1e-4},
    "point-laser-planes": {"offset_std_m": 1e-4, "form_std_m": 1e-4},
    "profile-laser-plane": {"scale_std": 1e-3, "offset_std_m": 1e-4},
    "touch-planes": {"ball_std_m": 1e-4, "form_std_m": 1e-4},
    "touch-sphere": {"ball_std_m": 1e-4, "radius_std_m": 1e-4},
    "camera-hand-eye": {"marker_std_m": 1e-4},
    "camera-eye-to-hand": {"marker_std_m": 1e-4},
}
ARMED = (
    "point-laser-plane",
    "profile-laser-plane",
    "profile-laser-sphere",
    "camera-hand-eye",
    "pose-pairs",
    "move-pairs",
)
EVERY = {**CELLS, **PAIR_CELLS}
MODELS: dict[str, Callable[[Rng], At]] = {
    **{name: partial(of_cell, make=make, **ERRORS.get(name, {})) for name, make in EVERY.items()},
    **{f"{name}, of an arm": partial(of_joints, make=EVERY[name]) for name in ARMED},
    **{f"two robots: {name}": partial(of_cell, make=make) for name, make in TWO_ROBOT_CELLS.items()},
    **{f"positioner: {kind}": partial(of_positioner, kind=kind) for kind in ("points", "sphere", "planes")},
    "kinematics from a tracker": of_tracker,
    "chain of the cell": of_cell_chain,
    "localization on features": of_features,
    "localization on free forms": of_free_forms,
}


@pytest.mark.parametrize("name", MODELS)
@settings(max_examples=2, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_row_20_jacobians_of_every_model(name: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    model, belief = MODELS[name](rng)
    off = OFF * MM if "localization" in name else OFF  # beside a facet or patch, not behind it
    if name != "chain of the cell":  # which is off already
        belief = moved(belief, off * rng.uniform(-1.0, 1.0, belief.size))
    model = model.weighed_at(values_of(belief))

    def residual(column: int, step: float) -> FloatArray:
        away = np.zeros(belief.size)
        away[column] = step
        return model.rows(values_of(moved(belief, away))).residual_m

    jacobian = model.rows(values_of(belief)).dense(belief)
    length = np.linalg.norm(jacobian, axis=1)
    assert (length > 0.0).all()
    for column in rng.permutation(belief.size)[:MOST_COLUMNS]:
        near = residual(column, STEP) - residual(column, -STEP)
        far = residual(column, 2 * STEP) - residual(column, -2 * STEP)
        numeric = (8.0 * near - far) / (12.0 * STEP)  # central, to fourth order
        worst = np.max(np.abs(jacobian[:, column] - numeric) / length)
        assert worst < 1e-6, (belief.labels[column], worst)
