"""world.toml: strict, with units, and in step with cell.toml."""

import math
import shutil
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import CellFileError
from simulators.world.toml_table import parse_quantity
from simulators.world.world_file import Placement, WorldFile, read_world_file


@given(st.decimals(-10_000, 10_000, places=4))
def test_a_length_is_its_number_times_its_unit(number: Any) -> None:
    assert parse_quantity(f"{number} mm", "length") == pytest.approx(float(number) * 1e-3)
    assert parse_quantity(f"{number} deg", "angle") == pytest.approx(math.radians(float(number)))


@pytest.mark.parametrize("text", ["12", "12 deg", "mm", "", "1e3 mm", "1  mm", 12, None, "12 inch", "nan mm"])
def test_a_length_without_a_length_unit_is_refused(text: object) -> None:
    with pytest.raises(CellFileError, match="not a length"):
        parse_quantity(text, "length")


def _edited(cell_dir: Path, tmp_path: Path, old: str, new: str) -> Path:
    text = (cell_dir / "world.toml").read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "world.toml").write_text(text.replace(old, new, 1), encoding="utf-8")
    shutil.copy(cell_dir / "block.step", tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("flatness =", "flatnes =", "flatness"),
        ('release = "0.01 mm"', 'release = "0.01"', "release"),
        ("[scenarios.honest]", "[scenarios.honest]\nspeed = 3", "speed"),
        ("nodes = [3, 4, 5, 6, 7, 8]", "nodes = [3, 4, 5, 6, 7]", "start_joints"),
        ("[plate]", "[plate", "world.toml"),
    ],
)
def test_a_mistake_is_named(cell_dir: Path, tmp_path: Path, old: str, new: str, says: str) -> None:
    with pytest.raises(CellFileError, match=says):
        read_world_file(_edited(cell_dir, tmp_path, old, new))


def test_a_directory_without_a_world_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CellFileError, match="does not exist"):
        read_world_file(tmp_path)


# -- in step with cell.toml ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def cell(cell_dir: Path) -> dict[str, Any]:
    return tomllib.loads((cell_dir / "cell.toml").read_text(encoding="utf-8"))


def _same(text: str, kind: str, value: float) -> None:
    assert parse_quantity(text, kind) == pytest.approx(value, rel=1e-12, abs=1e-15)


def _same_placement(table: dict[str, Any], placement: Placement) -> None:
    matrix = placement.nominal.matrix
    for text, value in zip(table["xyz"], matrix[:3, 3], strict=True):
        _same(text, "length", float(value))
    roll, pitch, yaw = (parse_quantity(text, "angle") for text in table["rpy"])
    c, s = np.cos, np.sin
    rx = np.array([[1, 0, 0], [0, c(roll), -s(roll)], [0, s(roll), c(roll)]])
    ry = np.array([[c(pitch), 0, s(pitch)], [0, 1, 0], [-s(pitch), 0, c(pitch)]])
    rz = np.array([[c(yaw), -s(yaw), 0], [s(yaw), c(yaw), 0], [0, 0, 1]])
    np.testing.assert_allclose(matrix[:3, :3], rz @ ry @ rx, atol=1e-12)
    _same(table["position_u"], "length", placement.position_sigma_m)
    if "rotation_u" in table:
        _same(table["rotation_u"], "angle", placement.rotation_sigma_rad)


def test_the_arm_is_the_arm_of_the_cell_file(world_file: WorldFile, cell: dict[str, Any]) -> None:
    robot, arm = cell["robot"], world_file.arm
    assert tuple(robot["nodes"]) == arm.nodes
    _same(robot["joint_noise"], "angle", arm.noise_rad)
    _same(robot["encoder_step"], "angle", arm.encoder_step_rad)
    for text, value in zip(robot["start_joints"], arm.start_joints_rad, strict=True):
        _same(text, "angle", float(value))
    for table, link in zip(robot["joints"], arm.links, strict=True):
        kinds = {"theta": "angle", "d": "length", "a": "length", "alpha": "angle", "beta": "angle"}
        for name, kind in kinds.items():
            _same(table.get(name, "0 mm" if kind == "length" else "0 deg"), kind, link.values[name])
        assert {name for name in kinds if f"{name}_u" in table} == set(link.sigmas)
        for name, sigma in link.sigmas.items():
            _same(table[f"{name}_u"], kinds[name], sigma)
        _same(table["limits"][0], "angle", link.lower_rad)
        _same(table["limits"][1], "angle", link.upper_rad)


def test_laser_and_probe_are_those_of_the_cell_file(world_file: WorldFile, cell: dict[str, Any]) -> None:
    table, laser = cell["laser"], world_file.laser
    assert (table["model"], table["serial_number"], table["baud"]) == (
        laser.model,
        laser.serial_number,
        laser.baud,
    )
    _same(table["range_start"], "length", laser.range_start_m)
    _same(table["range"], "length", laser.range_m)
    _same(table["noise"], "length", laser.point_noise_m)
    _same(table["reading_noise"], "length", laser.reading_noise_m)
    _same(table["scale_u"], "ratio", laser.scale_sigma)
    _same(table["offset_u"], "length", laser.offset_sigma_m)
    _same_placement(table["mount"], laser.mount)
    table, probe = cell["probe"], world_file.probe
    assert table["channel"] == probe.channel and table["model"] == f"ADAM-{probe.model:x}"
    _same(table["ball_radius"], "length", probe.ball_radius_m)
    _same(table["ball_radius_u"], "length", probe.ball_radius_sigma_m)
    _same(table["noise"], "length", probe.noise_m)
    _same_placement(table["mount"], probe.mount)


def test_artefacts_and_part_are_those_of_the_cell_file(world_file: WorldFile, cell: dict[str, Any]) -> None:
    plate, bar, sphere, part = world_file.plate, world_file.bar, world_file.sphere, world_file.part
    _same_placement(cell["plate"], plate.placement)
    _same_placement(cell["bar"], bar.placement)
    _same_placement(cell["sphere"], sphere.placement)
    _same_placement(cell["part"], part.placement)
    for text, value in zip(cell["plate"]["size"], plate.size_m, strict=True):
        _same(text, "length", float(value))
    _same(cell["plate"]["flatness_u"], "length", plate.flatness_m)
    _same(cell["bar"]["sphere_radius"], "length", bar.sphere_radius_m)
    _same(cell["bar"]["sphere_radius_u"], "length", bar.sphere_radius_sigma_m)
    _same(cell["bar"]["length"], "length", bar.length_m)
    _same(cell["bar"]["length_u"], "length", bar.length_sigma_m)
    _same(cell["sphere"]["radius"], "length", sphere.radius_m)
    _same(cell["sphere"]["radius_u"], "length", sphere.radius_sigma_m)
    _same(cell["part"]["position_limit"], "length", part.placement.position_limit_m)
    _same(cell["part"]["rotation_limit"], "angle", part.placement.rotation_limit_rad)
    assert part.cad.name == cell["part"]["cad"]
    features = {feature.name: feature for feature in part.features}
    assert set(features) == {table["name"] for table in cell["part"]["features"]}
    for table in cell["part"]["features"]:
        feature = features[table["name"]]
        for text, value in zip(table["at"], feature.at_m, strict=True):
            _same(text, "length", float(value))
        _same(table.get("form_u", table.get("size_u")), "length", feature.offset_sigma_m)
        _same(table.get("position_u", "0 mm"), "length", feature.shift_sigma_m)
