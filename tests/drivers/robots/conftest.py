"""What the tests of all robots behind a controller share."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """For the faces of the part, which take seconds to read."""
    return tmp_path_factory.mktemp("faces")
