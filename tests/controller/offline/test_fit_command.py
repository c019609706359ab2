"""`truecell fit` as a user runs it: the example of the docs, its JSON, and every kind of bad file."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from controller.console.app import main
from controller.console.exit_codes import ExitCode

EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "cylinder.csv"
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """`truecell fit` with these arguments: exit code, standard output, standard error."""

    def call(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            main(["fit", *map(str, arguments)])
        out, err = capsys.readouterr()
        assert isinstance(end.value.code, int)
        return end.value.code, out, err

    return call


def _points_mm() -> np.ndarray:
    return np.loadtxt(EXAMPLE, delimiter=",", skiprows=1)


def test_the_example_is_a_cylinder_of_12_5_mm(run: Run) -> None:
    code, out, _ = run(EXAMPLE, "--surface", "cylinder", "--unit", "mm", "--json")
    found = json.loads(out)
    assert code == ExitCode.OK
    assert (found["surface"], found["status"], found["reason"]) == ("cylinder", "usable", "")
    assert set(found["parameters"]) == {"axis_point_mm", "axis", "radius_mm"}
    u = found["expanded_uncertainty"]["radius_mm"]["value"]
    assert abs(found["parameters"]["radius_mm"] - 12.5) < u < 0.01
    assert np.shape(found["covariance"]) == (len(found["parameter_names"]),) * 2
    assert found["dof"] == 120 - 5


def test_auto_says_why_it_chose(run: Run) -> None:
    code, out, _ = run(EXAMPLE, "--surface", "auto", "--unit", "mm", "--json")
    found = json.loads(out)
    assert code == ExitCode.OK
    assert found["surface"] == "cylinder"
    assert "least that explains the points" in found["chosen_because"]
    assert len(found["not_chosen"]) == 4


def test_the_report_is_one_page_with_its_picture(run: Run, tmp_path: Path) -> None:
    page = tmp_path / "out.html"
    code, _, _ = run(EXAMPLE, "--surface", "cylinder", "--unit", "mm", "--report", page)
    assert code == ExitCode.OK
    assert "radius_mm" in page.read_text()
    assert "data:image/png;base64," in page.read_text()


@pytest.mark.parametrize("unit", ["mm", "m", "inch"])
@pytest.mark.parametrize("kind", ["csv", "txt", "xyz", "ply", "stl"])
def test_every_kind_of_file_and_unit_gives_the_same_radius(
    run: Run, tmp_path: Path, kind: str, unit: str
) -> None:
    points = _points_mm() / {"mm": 1.0, "m": 1e3, "inch": 25.4}[unit]
    path = tmp_path / f"points.{kind}"
    if kind in ("ply", "stl"):
        trimesh.Trimesh(points, np.arange(120).reshape(-1, 3), process=False).export(path)
    else:
        np.savetxt(path, points, delimiter={"csv": ";", "txt": "\t", "xyz": " "}[kind])
    code, out, err = run(path, "--surface", "cylinder", "--unit", unit, "--json")
    assert code == ExitCode.OK, err
    assert json.loads(out)["parameters"]["radius_mm"] == pytest.approx(12.5, abs=0.01)


_ROWS = "1,2,3\n4,5,6\n7,8,10\n"
_BAD = {
    "empty": ("", "the file is empty"),
    "blank": ("\n\n", "the file is empty"),
    "header only": ("x,y,z\n", "line 1: only a header, no points"),
    "text in a column": (_ROWS + "1,two,3\n", "line 4: 'two' is not a number"),
    "missing value": (_ROWS + "1,,3\n", "line 4: '' is not a number"),
    "not a number": (_ROWS + "1,nan,3\n", "line 4: 'nan' is not a finite number"),
    "infinite": (_ROWS + "1,2,inf\n", "line 4: 'inf' is not a finite number"),
    "mixed separators": (_ROWS + "1;2;3\n", "line 4: separated by semicolon, the lines before by comma"),
    "a line by spaces": (_ROWS + "1 2 3\n", "line 4: 1 columns"),
    "decimal comma, semicolons": ("1,5;2,5;3,5\n", "line 1: '1,5;2,5;3,5' seems to have decimal commas"),
    "decimal comma, commas": ("1,5,2,5,3,5\n", "line 1: '1,5,2,5,3,5' seems to have decimal commas"),
    "decimal comma, spaces": ("1,5 2,5 3,5\n", "line 1: '1,5 2,5 3,5' seems to have decimal commas"),
    "decimal comma, later": ("1;2;3\n1,5;2;3\n", "line 2: '1,5' has a decimal comma"),
    "two columns": ("1,2\n3,4\n", "line 1: 2 columns, a point has 3"),
    "a column more": (_ROWS + "1,2,3,4\n", "line 4: 4 columns"),
    "two headers": ("x,y,z\nmm,mm,mm\n1,2,3\n", "line 2: 'mm,mm,mm' is not a point"),
    "header without z": ("x,y,height\n1,2,3\n", "line 1: the header 'x,y,height' does not name x, y and z"),
    "inch in the header": ("x [inch],y [inch],z [inch]\n1,2,3\n", "line 1: the file says 'inch'"),
    "metres in a comment": ("# unit: m\n1,2,3\n", "line 1: the file says 'm'"),
    "centimetres in the header": ("x_cm,y_cm,z_cm\n1,2,3\n", "line 1: the file says 'cm'"),
    "binary": ("PK\x03\x04\x00\x00\udcff", "not a text file"),
}


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
def test_text_of_any_common_encoding_is_read(run: Run, tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "points.csv"
    rows = "\r\n".join(f"{x},{y},{0.01 * (x * y % 3)}" for x in range(5) for y in range(5))
    path.write_bytes(f"# Prüfling 3, µm-Tisch\r\nx [mm],y [mm],z [mm]\r\n{rows}\r\n".encode(encoding))
    code, _, err = run(path, "--surface", "plane", "--unit", "mm")
    assert (code, err) == (ExitCode.OK, "")


def test_a_small_piece_is_read_where_its_size_is_stated(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text("\n".join(f"{0.1 * x},{0.1 * y},0" for x in range(5) for y in range(5)))
    assert run(path, "--surface", "plane", "--unit", "mm")[0] == ExitCode.BAD_INPUT
    assert run(path, "--surface", "plane", "--unit", "mm", "--size", "0.4 mm")[0] == ExitCode.OK


def test_stl_files_that_are_cut_off_are_said_to_be(run: Run, tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=10.0)
    path = tmp_path / "ball.stl"
    whole = trimesh.exchange.stl.export_stl_ascii(ball).replace("solid", "solid Prüfling", 1)
    path.write_bytes(whole.encode("latin-1"))
    assert run(path, "--surface", "sphere", "--unit", "mm")[0] == ExitCode.OK
    path.write_bytes(whole.encode("latin-1")[:-3000])
    assert "cut off" in run(path, "--surface", "sphere", "--unit", "mm")[2]
    path.write_bytes(trimesh.exchange.stl.export_stl(ball)[:-30])
    assert "320 triangles announced and 319 present" in run(path, "--surface", "sphere", "--unit", "mm")[2]


@pytest.mark.parametrize("case", list(_BAD))
def test_bad_files_are_refused_with_one_sentence_and_the_line(run: Run, tmp_path: Path, case: str) -> None:
    text, expected = _BAD[case]
    path = tmp_path / "points.csv"
    path.write_bytes(text.encode(errors="surrogateescape"))
    code, out, err = run(path, "--surface", "plane", "--unit", "mm")
    assert (code, out) == (ExitCode.BAD_INPUT, "")
    assert err.startswith("points.csv")
    assert expected in err
    assert err.count("\n") == 1


def test_one_bad_line_in_many_is_found(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "points.xyz"
    path.write_text("1.25 2.5 3\n" * 199_999 + "1.25 2.5 3..0\n" + "1 2 3\n" * 50_000)
    code, _, err = run(path, "--surface", "plane", "--unit", "mm")
    assert code == ExitCode.BAD_INPUT
    assert "line 200000: '3..0' is not a number" in err


def test_columns_are_taken_by_name(run: Run, tmp_path: Path) -> None:
    points = _points_mm()
    path = tmp_path / "points.csv"
    numbered = np.column_stack([np.arange(120), points[:, [2, 0, 1]]])
    np.savetxt(path, numbered, delimiter=",", header="number,z,x,y", comments="")
    code, out, _ = run(path, "--surface", "cylinder", "--unit", "mm", "--json")
    assert code == ExitCode.OK
    assert json.loads(out)["parameters"]["axis_point_mm"] == pytest.approx(points.mean(axis=0), abs=15.0)


@pytest.mark.parametrize(
    ("wrong_by", "words"), [(25.4, "mm and inch"), (1000.0, "m and mm"), (10.0, "cm and mm")]
)
@pytest.mark.parametrize("option", ["--size", "--sigma"])
def test_a_unit_wrong_by_a_usual_factor_is_named(
    run: Run, tmp_path: Path, wrong_by: float, words: str, option: str
) -> None:
    path = tmp_path / "points.xyz"
    np.savetxt(path, _points_mm() * wrong_by)
    stated = "55 mm" if option == "--size" else "0.01 mm"
    code, out, err = run(path, "--surface", "cylinder", "--unit", "mm", option, stated)
    assert code in (ExitCode.BAD_INPUT, ExitCode.NOT_DECIDABLE)
    assert words in out + err


def test_a_span_that_no_part_has_is_refused(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "points.xyz"
    np.savetxt(path, _points_mm())
    code, _, err = run(path, "--surface", "cylinder", "--unit", "m")
    assert code == ExitCode.BAD_INPUT
    assert "55.24 m" in err


@pytest.mark.parametrize("sigma", ["0.01", "3 deg", "-1 mm", "0 mm"])
def test_a_sigma_without_meaning_is_refused(run: Run, sigma: str) -> None:
    code, _, err = run(EXAMPLE, "--surface", "cylinder", "--unit", "mm", f"--sigma={sigma}")
    assert code == ExitCode.BAD_INPUT
    assert err.startswith("--sigma: ")


def test_a_refused_fit_is_json_too(run: Run) -> None:
    code, out, _ = run(EXAMPLE, "--surface", "sphere", "--unit", "mm", "--json")
    assert code == ExitCode.NOT_DECIDABLE
    assert json.loads(out)["status"] == "refused"
    assert "radius" in json.loads(out)["reason"]


def test_a_report_in_no_folder_is_refused(run: Run, tmp_path: Path) -> None:
    code, _, err = run(
        EXAMPLE, "--surface", "cylinder", "--unit", "mm", "--report", tmp_path / "no" / "a.html"
    )
    assert code == ExitCode.BAD_INPUT
    assert "cannot be written" in err
