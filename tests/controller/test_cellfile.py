"""Cell files: the good one, the bad ones with file, line and message, and what is derived from them."""

import pickle
import shutil
import tomllib
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from controller.cellfile import Cell, CellFileMistakes, Mistake, check_cell, format_mistakes, load_cell
from controller.cellfile.document import document
from estimation.errors import CellFileError

BENCH_BLOCK = Path(__file__).parents[2] / "cells" / "bench-block"
# A copy of its cell file as it once was, so that tuning the example does not disturb these tests.
GOOD_TEXT = Path(__file__).with_name("good_cell.toml").read_text(encoding="utf-8")
CASES: list[dict[str, Any]] = tomllib.loads(
    Path(__file__).with_name("bad_cells.toml").read_text(encoding="utf-8")
)["case"]


@pytest.fixture(scope="module")
def cad_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Reading a CAD file takes seconds: once is enough for all tests."""
    return tmp_path_factory.mktemp("cad")


@pytest.fixture
def folder(tmp_path: Path, cad_cache: Path) -> Path:
    shutil.copy(BENCH_BLOCK / "block.step", tmp_path)
    (tmp_path / ".truecell").symlink_to(cad_cache)
    return tmp_path


@pytest.fixture
def good(folder: Path) -> Cell:
    write(folder, GOOD_TEXT)
    return load_cell(folder)


def write(folder: Path, text: str) -> Path:
    path = folder / "cell.toml"
    path.write_text(text, encoding="utf-8")
    return path


def edited(old: str, new: str, after: str = "", text: str = GOOD_TEXT) -> str:
    start = text.index(after)
    assert old in text[start:], f"{old!r} is not in the good cell file"
    return text[:start] + text[start:].replace(old, new, 1)


def line_with(text: str, what: str, after: str = "") -> int:
    return text.count("\n", 0, text.index(what, text.index(after))) + 1


def test_the_bench_block_is_accepted(folder: Path) -> None:
    write(folder, (BENCH_BLOCK / "cell.toml").read_text(encoding="utf-8"))
    assert check_cell(folder) == []


def test_a_good_cell_is_accepted_by_file_and_by_folder(good: Cell, folder: Path) -> None:
    assert check_cell(folder) == []
    assert load_cell(folder / "cell.toml") == good
    assert good.name == "bench-block"
    assert good.simulated
    assert good.path == folder / "cell.toml"
    assert good.text == GOOD_TEXT
    assert good.cad_path == folder / "block.step"


@pytest.mark.parametrize(
    "port", ["COM3", "/dev/ttyUSB3", "/dev/serial/by-id/usb-FTDI_A3-if00", "run/laser", "/dev/ttyUSB*"]
)
def test_ports_of_windows_and_linux_are_accepted(port: str, folder: Path) -> None:
    text = edited('port = "run/laser"', f'port = "{port}"')
    for robot in ('interface = "slcan"', 'interface = "socketcan"'):
        other = "can0" if "socketcan" in robot else port.replace("3", "4").replace("laser", "arm")
        here = edited('port = "run/arm"', f'port = "{other}"', text=text)
        write(folder, edited('interface = "slcan"', robot, text=here))
        assert check_cell(folder) == []


def test_there_are_at_least_fifty_bad_cells_of_different_kinds() -> None:
    assert len({case["name"] for case in CASES}) == len(CASES) >= 50


@pytest.mark.parametrize("case", CASES, ids=[case["name"] for case in CASES])
def test_bad_cell_is_reported_with_file_line_and_message(case: dict[str, Any], folder: Path) -> None:
    after = case.get("after", "")
    text = edited(case["old"], case["new"], after)
    path = write(folder, text)
    line = line_with(text, case["at"]) if "at" in case else line_with(text, case["new"], after)
    line += case.get("offset", 0)

    mistakes = check_cell(folder)

    lines = format_mistakes(mistakes).splitlines()
    assert [found for found in lines if found.startswith(f"{path}:{line}: ") and case["message"] in found], (
        lines
    )
    assert len(mistakes) == case.get("mistakes", 1), lines
    with pytest.raises(CellFileError, match="in the cell file") as refused:
        load_cell(path)
    assert case["message"] in str(refused.value)


def test_every_mistake_of_a_file_is_reported_in_the_order_of_the_file(folder: Path) -> None:
    text = GOOD_TEXT
    edits = [
        ('speed = "60 deg/s"', 'speed = "60"', 'robot.speed = "60": unit missing'),
        ('port = "run/laser"', 'port = "a"\nport = "b"', "laser.port: stands twice"),
        ('touch_speed = "1 mm/s"', 'touch_speed = "2 mm/s"', "of travel between two polls"),
        ('flatness_u = "0.005 mm"', 'flatnes_u = "0.005 mm"', 'did you mean "flatness_u"?'),
        ('cad = "block.step"', 'cad = "none.step"', "part.cad"),
        ('of = "localize"', 'of = "localise"', 'did you mean "localize"?'),
    ]
    for old, new, _ in edits:
        text = edited(old, new, text=text)
    write(folder, text)

    mistakes = check_cell(folder)

    assert [mistake.line for mistake in mistakes] == sorted(mistake.line for mistake in mistakes)
    assert len(mistakes) == len(edits)
    for mistake, (_, _, message) in zip(mistakes, edits, strict=True):
        assert message in str(mistake)


def test_a_message_reads_file_line_key_value_problem_remedy() -> None:
    mistake = Mistake("cell.toml", 17, "robot.sync_period", '"20"', "unit missing", 'write "20 ms"')
    assert format_mistakes([mistake]) == 'cell.toml:17: robot.sync_period = "20": unit missing, write "20 ms"'


def test_all_mistakes_survive_pickling(folder: Path) -> None:
    write(folder, edited('speed = "60 deg/s"', "speed = 60"))
    with pytest.raises(CellFileMistakes) as refused:
        load_cell(folder)
    again = pickle.loads(pickle.dumps(refused.value))
    assert again.mistakes == refused.value.mistakes
    assert str(again) == str(refused.value)


@pytest.mark.parametrize(
    ("content", "line", "message"),
    [
        (None, 1, "cannot be read (No such file or directory)"),
        (b"", 1, "keys are missing: cell, robot, laser"),
        (b'[cell]\nname = "\xe9"\n', 2, "byte 0xE9 is not UTF-8"),
        (b"\x00\x01\x02", 1, "not TOML"),
        (b"a = " + b"[" * 5000, 1, "not"),
        (b"a = " + b"9" * 5000, 1, "not"),
        (b"#" * 1_000_001, 1, "at most 1000000 bytes"),
    ],
)
def test_what_is_no_cell_file_is_refused(
    folder: Path, content: bytes | None, line: int, message: str
) -> None:
    path = folder / "cell.toml"
    if content is not None:
        path.write_bytes(content)
    (mistake,) = check_cell(path)
    assert (mistake.file, mistake.line) == (str(path), line)
    assert message in str(mistake)


@pytest.mark.parametrize("encode", [lambda text: "\ufeff" + text, lambda text: text.replace("\n", "\r\n")])
def test_files_saved_by_other_editors_are_read(good: Cell, folder: Path, encode: Any) -> None:
    (folder / "cell.toml").write_bytes(encode(GOOD_TEXT).encode())
    assert load_cell(folder).digest == good.digest
    text = encode(edited("readings = 3 ", "readings = -3 "))
    (folder / "cell.toml").write_bytes(text.encode())
    assert [mistake.line for mistake in check_cell(folder)] == [line_with(text, "readings = -3")]


def test_values_are_in_si(good: Cell) -> None:
    cell = good
    assert cell.robot.sync_period_s == 0.02
    assert cell.robot.speed_rad_s == pytest.approx(np.radians(60))
    assert cell.robot.joints[0].d_m == 0.2604
    assert cell.laser.rate_hz == 2000.0
    assert cell.laser.scale_u == 0.0002
    assert cell.probe.touch_speed_m_s == 0.001
    assert cell.job.phases[1].kind == "hand_eye"
    assert cell.job.phases[1].limit_m == 0.0004
    assert cell.job.phases[1].expires_s == 30 * 86400
    assert cell.job.conformance_probability == 0.95


def test_transforms_carry_their_frames(good: Cell) -> None:
    frames = [(place.transform().target, place.transform().source) for place in good.placements]
    assert frames == [
        ("flange", "laser"),
        ("flange", "probe"),
        ("base", "plate"),
        ("base", "bar"),
        ("base", "sphere"),
        ("base", "part"),
    ]
    bar = good.bar.transform()
    np.testing.assert_allclose(bar.rotation @ [0, 0, 1], [1, 0, 0], atol=1e-12)  # as its comment says
    np.testing.assert_allclose(bar.origin_m, [-0.1, 0.4, 0.15])


def test_the_arm_model_has_the_uncertain_parameters_free(good: Cell) -> None:
    robot = good.robot
    arm = robot.arm_model()
    assert len(arm.parameter_labels) == len(robot.parameter_u()) == 18
    assert arm.parameter_labels[:4] == ("a1", "alpha1", "theta2", "a2")
    np.testing.assert_allclose(robot.parameter_u()[:3], [1e-4, np.radians(0.01), np.radians(0.01)])
    np.testing.assert_allclose(arm.upper_rad, np.radians([170, 145, 135, 170, 170, 179]))
    np.testing.assert_allclose(arm.a, [0, 0.35, 0, 0, 0, 0])


def test_the_digest_follows_the_content_and_nothing_else(good: Cell, folder: Path) -> None:
    digest = good.digest
    write(folder, "# another comment\n" + edited('sync_period = "20 ms"', 'sync_period = "0.02 s"'))
    assert load_cell(folder).digest == digest
    write(folder, edited('expires = "30 days"', ""))  # the default
    assert load_cell(folder).digest == digest
    write(folder, edited("readings = 3 ", "readings = 4 "))
    assert load_cell(folder).digest != digest
    write(folder, GOOD_TEXT)
    assert load_cell(folder).digest == digest
    with (folder / "block.step").open("a") as cad:
        cad.write("\n")
    assert load_cell(folder).digest != digest


def test_differences_name_key_and_both_values(good: Cell, folder: Path) -> None:
    write(folder, edited("readings = 3 ", "readings = 5 ", text=edited('expires = "30 days"', "")))
    after = load_cell(folder)
    assert good.differences(after) == [
        "robot.readings: 3 -> 5",
        'job.phases[2].expires: "30 days" -> not there',
    ]
    assert good.differences(good) == []


def test_expired_certificates_are_named(good: Cell) -> None:
    assert good.expired(date(2028, 3, 1)) == []
    assert good.expired(date(2028, 3, 2)) == [
        "certificate BAR-0417 of the bar held until 2028-03-01",
        "certificate SPH-1288 of the sphere held until 2028-03-01",
    ]


def test_the_reference_of_the_cell_file_is_current() -> None:
    page = Path(__file__).parents[2] / "docs" / "cell-file.md"
    assert page.read_text(encoding="utf-8") == document(), (
        "run python -m controller.cellfile.document > docs/cell-file.md"
    )


def test_a_cell_cannot_be_changed(good: Cell) -> None:
    with pytest.raises(ValueError, match="frozen"):
        good.robot.readings = 5


def test_feasibility_is_asked_only_about_a_cell_in_order(folder: Path) -> None:
    def feasibility(cell: Cell) -> list[Mistake]:
        problem = "best reachable 0.21 mm; range noise contributes 34 %"
        return [cell.mistake_at(("job", "phases", 3, "limit"), problem, "raise the limit")]

    write(folder, GOOD_TEXT)
    (mistake,) = check_cell(folder, feasibility)
    assert mistake.line == line_with(GOOD_TEXT, "limit", after='name = "localize"')
    assert 'job.phases[localize].limit = "0.40 mm": best reachable 0.21 mm' in str(mistake)
    with pytest.raises(CellFileMistakes, match="best reachable"):
        load_cell(folder, feasibility)
    write(folder, edited("readings = 3 ", "readings = 0 "))
    (mistake,) = check_cell(folder, feasibility)
    assert mistake.key == "robot.readings"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            'at = ["15 mm", "100 mm", "100 mm"]',
            'at = ["15 mm", "100 mm", "103 mm"]',
            'part.features[top].at = ["15 mm", "100 mm", "103 mm"]: no face of the part lies within 1 mm',
        ),
        (
            'at = ["0 mm", "75 mm", "50 mm"]',
            'at = ["50 mm", "0 mm", "20 mm"]',
            "lies on the same face as front",
        ),
        (
            'nominal = "30 mm"',
            'nominal = "32 mm"',
            'part.characteristics[C1].nominal = "32 mm": bore has a diameter of 30 mm in the CAD file',
        ),
        (
            'datums = ["top", "left", "front"]',
            'datums = ["top", "boss", "front"]',
            'part.characteristics[C3].datums[2] = "boss": boss is a cylinder, a datum must be a plane',
        ),
        ('datums = ["top", "left", "front"]', 'datums = ["top", "back", "front"]', "leave a direction open"),
        (
            'faces = ["top", "front", "back", "left", "right"]',
            'faces = ["top", "left", "right"]',
            "the faces leave a direction open",
        ),
    ],
    ids=["no face", "same face", "diameter", "datum", "datums", "faces"],
)
def test_the_part_is_compared_with_its_cad_file(folder: Path, old: str, new: str, message: str) -> None:
    text = edited(old, new)
    path = write(folder, text)
    load_cell(path)  # quick, without the faces
    (mistake,) = check_cell(path)
    assert mistake.line == line_with(text, new)
    assert message in str(mistake)


def test_a_damaged_cad_file_is_named(folder: Path) -> None:
    cad = folder / "block.step"
    cad.write_bytes(cad.read_bytes()[:5000])
    write(folder, GOOD_TEXT)
    (mistake,) = check_cell(folder)
    assert "part.cad" in str(mistake)
    assert mistake.line == line_with(GOOD_TEXT, 'cad = "block.step"')


LINES = GOOD_TEXT.splitlines()
SETTINGS = [number for number, line in enumerate(LINES) if "=" in line and not line.startswith("#")]
ODD_VALUES = (
    """
"5 mm" | "-5 mm" | "3 deg" | "20 ms" | "1e308 m" | 0 | -1 | 1.5 | true | [] | {} | "" | nan | ["1 mm"]
["1 mm", "2 mm"] | [[1]] | [{}] | { a = 1 } | 2026-03-02 | 07:32:00 | "flange" | "bore" | "check" | 'a'
999999999999999999999 | "base" | "hand-eye" | "part" | "\\u0000" | "."
""".strip()
    .replace("\n", " | ")
    .split(" | ")
)
VALUES = st.one_of(
    st.sampled_from(ODD_VALUES),
    st.text(max_size=12),
    st.integers().map(str),
    st.floats().map(str),
)


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_no_mutation_gives_a_traceback(data: st.DataObject, folder: Path) -> None:
    lines = list(LINES)
    for _ in range(data.draw(st.integers(1, 3))):
        number = data.draw(st.sampled_from(SETTINGS))
        key, _, value = lines[number].partition("=")
        match data.draw(st.sampled_from(["value", "key", "drop", "swap", "table", "insert"])):
            case "value":
                lines[number] = f"{key}= {data.draw(VALUES)}"
            case "key":
                lines[number] = f"{data.draw(st.text(max_size=8))} ={value}"
            case "drop":
                lines[number] = ""
            case "swap":
                other = data.draw(st.sampled_from(SETTINGS))
                lines[number], lines[other] = lines[other], lines[number]
            case "table":
                lines[number] = (
                    f"[{data.draw(st.sampled_from(['robot', 'part.x', 'job', 'a.b', '[job.phases]']))}]"
                )
            case "insert":
                lines[number] += data.draw(st.text(max_size=6))
    path = write_raw(folder, "\n".join(lines))
    try:
        mistakes: tuple[Mistake, ...] = ()
        load_cell(path)
    except CellFileMistakes as refused:
        mistakes = refused.mistakes
        assert mistakes
    for mistake in mistakes:
        assert 1 <= mistake.line <= "\n".join(lines).count("\n") + 1
        assert str(mistake).startswith(f"{path}:{mistake.line}: ")
        assert "\n" not in str(mistake)


def write_raw(folder: Path, text: str) -> Path:
    path = folder / "cell.toml"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    return path
