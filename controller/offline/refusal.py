"""What people give that is not taken, because something would have to be guessed."""

from controller.console.exit_codes import ExitCode
from estimation.errors import CellError


class BadInput(CellError):
    """An option or a file that cannot be taken as it is."""

    code = ExitCode.BAD_INPUT


class BadFile(BadInput):
    """A file that cannot be read without guessing; the problem names file and line."""
