"""`truecell verify`: the figures as JSON and as a table, and an exit code that says whether to believe."""

import json

import numpy as np
import pytest

from controller.console.app import main
from controller.console.exit_codes import ExitCode
from estimation.proof.coverage import Coverage

_HONEST = np.random.default_rng(1).chisquare(5, 400)


@pytest.mark.parametrize(
    ("scale", "verdict", "code"),
    [
        (1.0, "honest", ExitCode.OK),
        (4.0, "claims too much", ExitCode.NOT_OK),
        (0.25, "claims too little", ExitCode.OK),
    ],
)
def test_the_exit_code_says_whether_more_is_claimed_than_kept(
    scale: float,
    verdict: str,
    code: ExitCode,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def covered(*_: object) -> dict[str, Coverage]:
        return {"hand-eye": Coverage(5, scale * _HONEST, refused=3)}

    monkeypatch.setattr("controller.verify.random_cells.cover", covered)
    for arguments in (["--json"], []):
        with pytest.raises(SystemExit) as ended:
            main(["verify", "--cells", "400", "--workers", "1", *arguments])
        assert ended.value.code == code
    as_json, *table = capsys.readouterr().out.splitlines()
    (row,) = json.loads(as_json)["estimates"]
    assert (row["verdict"], row["cells"], row["refused"]) == (verdict, 403, 3)
    assert any(verdict in line and "403" in line for line in table)


def test_a_cell_file_that_is_not_there_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["verify", "nowhere", "--workers", "1"])
    assert ended.value.code == ExitCode.BAD_INPUT
    assert "nowhere" in capsys.readouterr().err
