"""`truecell simulate`: what it cannot use is one sentence, and the exit code of bad input."""

from pathlib import Path

import pytest

from simulators.__main__ import BAD_INPUT, main


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\xff\xfe\x00 not text", "utf-8"),
        (b"x = [", "cell.toml"),
        (b"", "no driver in [robot]"),
        (b'[robot]\ndriver = "canopen-402"\nport = "COM7"\n', "cannot be simulated"),
    ],
)
def test_a_cell_file_that_cannot_be_used(
    content: bytes, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "cell.toml").write_bytes(content)
    assert main([str(tmp_path)]) == BAD_INPUT
    complaint = capsys.readouterr().err
    assert words in complaint and len(complaint.splitlines()) == 1


def test_a_cell_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path / "nowhere")]) == BAD_INPUT
    assert "Name a cell file, or its folder" in capsys.readouterr().err
