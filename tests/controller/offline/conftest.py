"""`truecell estimate` with its answer, and how a data set is refused."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from controller.console.app import main
from controller.offline.dataset import read_dataset
from controller.offline.refusal import BadFile
from tests.controller.offline.answers import Run


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """`truecell estimate` with these arguments: exit code, standard output, standard error."""

    def call(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            main(["estimate", *map(str, arguments)])
        out, err = capsys.readouterr()
        assert isinstance(end.value.code, int)
        return end.value.code, out, err

    return call


@pytest.fixture
def refused(tmp_path: Path) -> Callable[[dict[str, Any]], str]:
    """The sentence with which a data set is refused: a line for each mistake, with the file."""

    def call(content: dict[str, Any]) -> str:
        path = tmp_path / "bad.json"
        path.write_text(json.dumps(content, indent=1))
        with pytest.raises(BadFile) as caught:
            read_dataset(path)
        said = caught.value.problem
        assert all(line.startswith("bad.json:") for line in said.splitlines())
        return said

    return call
