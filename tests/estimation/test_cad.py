"""The STEP reader, on the part of the example cell and on what customers send by mistake."""

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh

from estimation import cad
from estimation.errors import CellFileError, EstimationError

FEATURES = Path(__file__).with_name("data") / "features.step"
BLOCK = Path(__file__).parents[2] / "cells" / "bench-block" / "block.step"
MM = 1e-3
EXACT_M = 1e-9  # 1e-6 mm


@pytest.fixture(scope="module")
def cache_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cad")


@pytest.fixture(scope="module")
def faces(cache_dir: Path) -> tuple[cad.CadFace, ...]:
    return cad.read_faces(BLOCK, cache_dir)


def at(faces: tuple[cad.CadFace, ...], *point_mm: float) -> cad.CadFace:
    return cad.face_at(faces, np.array(point_mm) * MM)


def test_every_face_is_a_typed_surface(faces: tuple[cad.CadFace, ...]) -> None:
    assert sorted(face.kind for face in faces) == ["cylinder"] * 3 + ["plane"] * 8


@pytest.mark.parametrize(
    ("point_mm", "normal"),
    [
        ((50, 75, 0), (0, 0, -1)),
        ((15, 100, 100), (0, 0, 1)),
        ((0, 75, 50), (-1, 0, 0)),
        ((100, 75, 50), (1, 0, 0)),
        ((50, 0, 50), (0, -1, 0)),
        ((50, 150, 50), (0, 1, 0)),
        ((35, 45, 75), (0, 0, 1)),  # floor of the bore
        ((65, 105, 115), (0, 0, 1)),  # top of the boss
    ],
)
def test_plane_normals_point_out_of_the_material(
    faces: tuple[cad.CadFace, ...], point_mm: tuple[float, ...], normal: tuple[float, ...]
) -> None:
    face = at(faces, *point_mm)
    assert face.kind == "plane"
    assert face.outward
    np.testing.assert_allclose(face.axis, normal, rtol=0.0, atol=EXACT_M)
    height_m = (np.array(point_mm) * MM - face.point_m) @ face.axis
    np.testing.assert_allclose(height_m, 0.0, rtol=0.0, atol=EXACT_M)


@pytest.mark.parametrize(
    ("point_mm", "axis_xy_mm", "radius_mm", "outward", "heights_mm"),
    [
        ((35 + 15, 45, 90), (35, 45), 15.0, False, (75, 100)),  # bore
        ((65 + 12.5, 105, 107), (65, 105), 12.5, True, (100, 115)),  # boss
        ((92 + 8 * 0.6, 142 + 8 * 0.8, 50), (92, 142), 8.0, True, (0, 100)),  # rounded edge
    ],
)
def test_cylinders_know_their_side(
    faces: tuple[cad.CadFace, ...],
    point_mm: tuple[float, ...],
    axis_xy_mm: tuple[float, ...],
    radius_mm: float,
    outward: bool,
    heights_mm: tuple[float, ...],
) -> None:
    face = at(faces, *point_mm)
    assert face.kind == "cylinder"
    assert face.outward is outward
    np.testing.assert_allclose(face.radius_m, radius_mm * MM, rtol=0.0, atol=EXACT_M)
    np.testing.assert_allclose(np.abs(face.axis), (0, 0, 1), rtol=0.0, atol=EXACT_M)
    np.testing.assert_allclose(face.point_m[:2], np.array(axis_xy_mm) * MM, rtol=0.0, atol=EXACT_M)
    np.testing.assert_allclose(face.bounds_m[:, 2], np.array(heights_mm) * MM, atol=1e-8)  # single precision


def test_triangles_lie_on_their_surface(faces: tuple[cad.CadFace, ...]) -> None:
    for face in faces:
        offsets = face.triangles.reshape(-1, 3) - face.point_m
        if face.kind == "plane":
            residuals = offsets @ face.axis
        else:
            residuals = np.linalg.norm(np.cross(offsets, face.axis), axis=1) - face.radius_m
        assert np.abs(residuals).max() < 2e-8


def test_mesh_is_closed_and_has_the_volume_of_the_part(cache_dir: Path) -> None:
    mesh = cad.read_mesh(BLOCK, cache_dir)
    edges = np.concatenate([mesh.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    there, back = {tuple(edge) for edge in edges.tolist()}, {tuple(edge) for edge in edges[:, ::-1].tolist()}
    assert there == back
    assert len(there) == len(edges)
    a, b, c = np.moveaxis(mesh.vertices_m[mesh.triangles], 1, 0)
    volume_mm3 = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 / MM**3
    true_mm3 = 100 * 150 * 100 - 8**2 * (1 - np.pi / 4) * 100 - np.pi * (15**2 * 25 - 12.5**2 * 15)
    assert volume_mm3 == pytest.approx(true_mm3, rel=2e-5)
    assert mesh.face_index.shape == (len(mesh.triangles),)


def test_every_kind_of_surface_in_a_turned_assembly(cache_dir: Path) -> None:
    """data/make_features.py: (x, y, z) of the plate is (10 + x, 20 - z, 30 + y) here, in mm."""
    faces = cad.read_faces(FEATURES, cache_dir)

    def expect(kind: str, point_mm: tuple[float, ...], outward: bool) -> cad.CadFace:
        (face,) = [
            face
            for face in faces
            if face.kind == kind
            and np.allclose(face.point_m, np.array(point_mm) * MM, rtol=0.0, atol=EXACT_M)
        ]
        assert face.outward is outward
        return face

    pit = expect("cone", (-15, 8, 30), False)
    np.testing.assert_allclose(pit.axis, (0, -1, 0), rtol=0.0, atol=EXACT_M)  # from the apex to the open end
    assert pit.half_angle_rad == pytest.approx(np.pi / 4)
    assert expect("sphere", (10, 0, 30), True).radius_m == pytest.approx(6 * MM)
    assert expect("sphere", (30, 0, 45), False).radius_m == pytest.approx(5 * MM)
    assert expect("cylinder", (30, 0, 15), True).radius_m == pytest.approx(7 * MM)
    rim = expect("torus", (30, -8, 15), True)
    assert rim.radius_m == pytest.approx(2 * MM)
    assert rim.major_radius_m == pytest.approx(5 * MM)
    np.testing.assert_allclose(
        at(faces, -25, 0, 10).axis, (0, -1, 0), rtol=0.0, atol=EXACT_M
    )  # top of the plate
    free_form = [face for face in faces if face.kind == "other"]
    assert len(free_form) == 6
    assert {round(float(face.axis[2])) for face in free_form} == {-1, 0, 1}


def test_point_off_the_part_is_told_the_nearest_face(faces: tuple[cad.CadFace, ...]) -> None:
    with pytest.raises(
        EstimationError, match=r"the nearest is 3\.000 mm away, a plane around \(50\.0, 75\.0"
    ):
        at(faces, 10, 75, 103)


def test_point_on_an_edge_is_refused_and_just_inside_is_not(faces: tuple[cad.CadFace, ...]) -> None:
    with pytest.raises(EstimationError, match="lies on an edge"):
        at(faces, 50, 0.1, 100)
    np.testing.assert_allclose(at(faces, 50, 0.5, 100).axis, (0, 0, 1), rtol=0.0, atol=EXACT_M)


def test_cache_gives_the_same_without_the_kernel(
    faces: tuple[cad.CadFace, ...], cache_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_import(*args: object, **kwargs: object) -> None:
        raise AssertionError("the kernel was started")

    monkeypatch.setattr(subprocess, "run", no_import)
    again = cad.read_faces(BLOCK, cache_dir)
    assert [str(face) for face in again] == [str(face) for face in faces]
    for one, other in zip(faces, again, strict=True):
        assert (one.index, one.kind, one.radius_m, one.outward) == (
            other.index,
            other.kind,
            other.radius_m,
            other.outward,
        )
        for name in ("point_m", "axis", "bounds_m", "triangles"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_damaged_cache_is_read_anew(faces: tuple[cad.CadFace, ...], tmp_path: Path, cache_dir: Path) -> None:
    for kept in cache_dir.glob("*.npz"):
        (tmp_path / kept.name).write_bytes(kept.read_bytes()[:1000])
    assert len(cad.read_faces(BLOCK, tmp_path)) == len(faces)
    mended = [
        kept for kept in tmp_path.iterdir() if kept.read_bytes() == (cache_dir / kept.name).read_bytes()
    ]
    assert len(mended) == 1


def test_millimetres_exported_as_metres_are_refused_before_import(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = BLOCK.read_text().replace("SI_UNIT(.MILLI.,.METRE.)", "SI_UNIT($,.METRE.)")
    assert text != BLOCK.read_text()
    monkeypatch.setattr(cad, "_import", lambda *args: pytest.fail("imported"))
    (tmp_path / "metres.step").write_text(text)
    with pytest.raises(CellFileError, match=r"measures 150 m, more than the 5 m .* mistake of the unit"):
        cad.read_faces(tmp_path / "metres.step")


def test_inches_are_converted(tmp_path: Path) -> None:
    """A file in a converted unit: cascadio gives metres, and the size guard counts in the same unit."""
    text = BLOCK.read_text()
    unit = re.search(r"#(\d+) = \( LENGTH_UNIT\(\) NAMED_UNIT\(\*\) SI_UNIT\(\.MILLI\.,\.METRE\.\) \);", text)
    assert unit is not None
    inch = (
        f"#{unit[1]} = ( CONVERSION_BASED_UNIT('INCH',#9001) LENGTH_UNIT() NAMED_UNIT(#9003) );\n"
        "#9001 = LENGTH_MEASURE_WITH_UNIT(LENGTH_MEASURE(25.4),#9002);\n"
        "#9002 = ( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.MILLI.,.METRE.) );\n"
        "#9003 = DIMENSIONAL_EXPONENTS(1.,0.,0.,0.,0.,0.,0.);"
    )
    (tmp_path / "inch.step").write_text(text.replace(unit[0], inch))
    assert cad._unit_m((tmp_path / "inch.step").read_bytes()) == pytest.approx(0.0254)
    faces = cad.read_faces(tmp_path / "inch.step")
    assert sorted(face.radius_m for face in faces)[-1] == pytest.approx(15 * 0.0254, abs=1e-9)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "is empty"),
        (b"solid block\nfacet normal 0 0 1\n", "is not a STEP file"),
        (BLOCK.read_bytes()[:9000], "is cut off"),
        (
            BLOCK.read_bytes().replace(b"MANIFOLD_SOLID_BREP", b"MANIFOLD_SOLID_BRE"),
            "damaged or holds no faces",
        ),
    ],
)
def test_broken_files_are_refused(tmp_path: Path, content: bytes, problem: str) -> None:
    (tmp_path / "part.step").write_bytes(content)
    with pytest.raises(CellFileError, match=problem):
        cad.read_faces(tmp_path / "part.step")


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CellFileError, match=r"nowhere\.step cannot be read: No such file"):
        cad.read_faces(tmp_path / "nowhere.step")


def test_endless_import_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cad, "IMPORT_TIMEOUT_S", 0.05)
    with pytest.raises(CellFileError, match=r"not read within 0\.05 s"):
        cad.read_faces(BLOCK)


def block_as_mesh(tmp_path: Path, cache_dir: Path, suffix: str) -> Path:
    """The block of the example cell as a mesh in millimetres, exported by trimesh."""
    mesh = cad.read_mesh(BLOCK, cache_dir)
    path = tmp_path / f"block{suffix}"
    trimesh.Trimesh(mesh.vertices_m / MM, mesh.triangles, process=False).export(path)
    return path


@pytest.mark.parametrize("suffix", [".stl", ".ply"])
def test_a_mesh_has_the_planes_of_the_step_file(
    faces: tuple[cad.CadFace, ...], tmp_path: Path, cache_dir: Path, suffix: str
) -> None:
    found = cad.read_faces(block_as_mesh(tmp_path, cache_dir, suffix), unit_m=MM)
    assert sorted(face.kind for face in found) == ["other"] * 3 + ["plane"] * 8
    for face in faces:
        if face.kind == "plane":
            sides = face.triangles[:, 1:] - face.triangles[:, :1]
            largest = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).argmax()
            same = cad.face_at(found, face.triangles[largest].mean(axis=0))
            np.testing.assert_allclose(same.axis, face.axis, rtol=0.0, atol=1e-6)
            np.testing.assert_allclose(same.bounds_m, face.bounds_m, rtol=0.0, atol=1e-6)
            assert abs((same.point_m - face.point_m) @ face.axis) < 1e-7  # corners are in single precision


def test_a_mesh_is_measured_in_the_unit_that_is_said(tmp_path: Path, cache_dir: Path) -> None:
    path = block_as_mesh(tmp_path, cache_dir, ".stl")
    inches = cad.read_faces(path, unit_m=0.0254)
    assert max(face.bounds_m[1, 1] for face in inches) == pytest.approx(150 * 0.0254, rel=1e-6)
    with pytest.raises(CellFileError, match="names no unit of length"):
        cad.read_faces(path)
    with pytest.raises(CellFileError, match=r"measures 150 m, more than the 5 m .* mistake of the unit"):
        cad.read_faces(path, unit_m=1.0)


def test_an_inverted_mesh_is_turned_inside_in(tmp_path: Path, cache_dir: Path) -> None:
    mesh = trimesh.load(block_as_mesh(tmp_path, cache_dir, ".stl"))
    mesh.invert()
    mesh.export(tmp_path / "inverted.stl")
    top = cad.face_at(cad.read_faces(tmp_path / "inverted.stl", unit_m=MM), np.array([15, 100, 100]) * MM)
    np.testing.assert_allclose(top.axis, (0, 0, 1), rtol=0.0, atol=1e-6)


def test_an_open_mesh_is_refused(tmp_path: Path, cache_dir: Path) -> None:
    mesh = trimesh.load(block_as_mesh(tmp_path, cache_dir, ".stl"))
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    mesh.export(tmp_path / "open.stl")
    with pytest.raises(CellFileError, match=r"open\.stl is open: 3 edges do not belong to two triangles"):
        cad.read_faces(tmp_path / "open.stl", unit_m=MM)


@pytest.mark.parametrize(
    "content", [b"", b"solid block\nfacet normal 0 0 1\n", b"\x00" * 84, b"ISO-10303-21;"]
)
@pytest.mark.parametrize("suffix", [".stl", ".ply"])
def test_broken_meshes_are_refused(tmp_path: Path, content: bytes, suffix: str) -> None:
    (tmp_path / f"part{suffix}").write_bytes(content)
    with pytest.raises(CellFileError, match="damaged or holds no faces"):
        cad.read_faces(tmp_path / f"part{suffix}", unit_m=MM)
