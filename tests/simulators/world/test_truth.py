"""What is drawn: reproducible, of the declared size, and one stream not disturbing another."""

import json
from dataclasses import replace

import numpy as np

from simulators.world.truth import Truth, draw_truth, stream
from simulators.world.world_file import WorldFile


def test_a_seed_is_a_world(world_file: WorldFile) -> None:
    first, again, other = (draw_truth(world_file, seed).to_json() for seed in (3, 3, 4))
    assert first == again
    assert first["poses"] != other["poses"]
    assert json.loads(json.dumps(first)) == first


def test_another_error_source_does_not_shift_the_others(world_file: WorldFile) -> None:
    fewer = replace(world_file, part=replace(world_file.part, features=world_file.part.features[2:]))
    whole, part = draw_truth(world_file, 7).to_json(), draw_truth(fewer, 7).to_json()
    for block in ("kinematics", "poses", "scalars"):
        assert whole[block] == part[block]
    for name, deviation in part["features"].items():
        assert whole["features"][name] == deviation


def test_streams_of_different_names_differ() -> None:
    assert stream(1, "a").random() != stream(1, "b").random()


def test_the_nominal_cell_has_no_errors(nominal: Truth, world_file: WorldFile) -> None:
    assert not any(nominal.link_errors.values())
    np.testing.assert_allclose(nominal.base_T_plate, world_file.plate.placement.nominal.matrix, atol=1e-15)
    assert nominal.probe_radius_m == world_file.probe.ball_radius_m
    assert all(face.offset_m == 0 and not face.shift_m.any() for face in nominal.features.values())


def test_errors_have_the_declared_spread(world_file: WorldFile) -> None:
    truths = [draw_truth(world_file, seed) for seed in range(400)]

    def close(values: list[float], sigma: float) -> None:
        spread, mean = np.std(values), np.mean(values)
        assert abs(spread / sigma - 1) < 0.15  # 4 sigma of the estimate of a sigma from 400
        assert abs(mean) < 4.5 * sigma / np.sqrt(len(values))

    for row, link in enumerate(world_file.arm.links):
        for name, sigma in link.sigmas.items():
            close([t.link_errors[f"{name}{row + 1}"] for t in truths], sigma)
    close([t.laser_scale for t in truths], world_file.laser.scale_sigma)
    close([t.laser_offset_m for t in truths], world_file.laser.offset_sigma_m)
    laser = world_file.laser.mount
    for axis in range(3):
        close([t.deviations["laser"][axis] for t in truths], laser.position_sigma_m)
        close([t.deviations["laser"][3 + axis] for t in truths], laser.rotation_sigma_rad)
    close([t.bar_length_m - world_file.bar.length_m for t in truths], world_file.bar.length_sigma_m)
    features = {feature.name: feature for feature in world_file.part.features}
    close([t.features["bore"].shift_m[0] for t in truths], features["bore"].shift_sigma_m)
    close([t.features["boss"].offset_m for t in truths], features["boss"].offset_sigma_m)


def test_the_part_stays_within_what_the_clamps_allow(world_file: WorldFile) -> None:
    placement = world_file.part.placement
    loose = replace(
        world_file, part=replace(world_file.part, placement=replace(placement, position_sigma_m=0.02))
    )
    for seed in range(50):
        xi = draw_truth(loose, seed).deviations["part"]
        assert np.linalg.norm(xi[:3]) <= placement.position_limit_m * (1 + 1e-12)
        assert np.linalg.norm(xi[3:]) <= placement.rotation_limit_rad * (1 + 1e-12)


def test_the_sphere_has_no_orientation_error(world_file: WorldFile) -> None:
    assert not draw_truth(world_file, 1).deviations["sphere"][3:].any()
