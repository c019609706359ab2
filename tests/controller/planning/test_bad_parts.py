"""Parts that cannot be planned for: one sentence each, with what was seen and what to do."""

import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stderr
from io import StringIO
from pathlib import Path
from runpy import run_path

import pytest
import trimesh

from controller.console.app import main
from controller.console.exit_codes import ExitCode
from tests.controller.planning.random_cells import write_cell


def edit(old: str, new: str, name: str = "cell.toml") -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / name
        text = path.read_text(encoding="utf-8")
        assert re.search(old, text)
        path.write_text(re.sub(old, new, text, count=1), encoding="utf-8")

    return change


def cut_short(folder: Path) -> None:
    path = folder / "part.stl"
    path.write_bytes(path.read_bytes()[:300])


def opened(folder: Path) -> None:
    mesh = trimesh.load_mesh(folder / "part.stl")
    mesh.update_faces([index > 1 for index in range(len(mesh.faces))])
    mesh.export(folder / "part.stl")


def enlarged(folder: Path) -> None:
    mesh = trimesh.load_mesh(folder / "part.stl")
    mesh.apply_scale(1000.0)
    mesh.export(folder / "part.stl")


FAR = edit(
    r'name = "stepped"((?:.*\n)*?)xyz = \[[^]]*\]', r'name = "stepped"\1xyz = ["1.5 m", "0 mm", "100 mm"]'
)


@pytest.fixture
def _importer_in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Saves loading its libraries anew for every part; the process itself is tested with the reader."""

    def run(command: list[str], **_: object) -> subprocess.CompletedProcess[bytes]:
        monkeypatch.setattr(sys, "argv", command[2:])
        with redirect_stderr(StringIO()) as said:
            try:
                run_path(command[2], run_name="__main__")
            except SystemExit as ended:
                code = int(ended.code or 0)
            except Exception as error:  # whatever a broken mesh ends in: a process would end like this
                code = 1
                print(repr(error), file=sys.stderr)
        return subprocess.CompletedProcess(command, code, b"", said.getvalue().encode())

    monkeypatch.setattr(subprocess, "run", run)


@pytest.mark.usefixtures("_importer_in_this_process")
@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (cut_short, r"part\.stl is damaged or holds no faces"),
        (opened, r"part\.stl is open: \d+ edges do not belong to two triangles"),
        (enlarged, r"measures \d+\.?\d* m, more than the 5 m .* mistake of the unit"),
        (edit('cad_unit = "mm"\n', ""), r"part\.cad_unit: key is missing"),
        (edit('cad_unit = "mm"', 'cad_unit = "m"'), r"measures \d+\.?\d* m, more than the 5 m"),
        (edit(r'faces = \["top"', 'faces = ["topp"'), r"no such feature.*top"),
        (
            edit(r'name = "top"\nat = \[[^]]*\]', 'name = "top"\nat = ["500 mm", "0 mm", "0 mm"]'),
            r"part\.features\[top\]\.at = .*: no face of the part lies within 1 mm of \(500, 0, 0\) mm",
        ),
        (FAR, r"part\.xyz.*: the part is out of reach"),
    ],
    ids=[
        "broken",
        "open",
        "1000 times too large",
        "no unit",
        "wrong unit",
        "wrong name",
        "beside the face",
        "out of reach",
    ],
)
def test_bad_parts_are_refused_in_one_sentence(
    damage: Callable[[Path], None],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    write_cell(tmp_path, seed=1)
    damage(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["plan", str(tmp_path)])
    answer = capsys.readouterr()
    assert ended.value.code == ExitCode.BAD_INPUT
    assert re.search(said, answer.err), answer.err
    assert "Traceback" not in answer.err
    assert len(answer.err.strip().splitlines()) <= 3
