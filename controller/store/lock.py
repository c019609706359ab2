"""One owner per store: an advisory lock that the kernel drops when the owner dies, however it dies."""

import fcntl
import os
from pathlib import Path

from estimation.errors import StoreError


def lock_of(store: Path) -> Path:
    """The lock file beside a store."""
    return store.with_name(store.name + ".lock")


class OwnerLock:
    """Holds `path` exclusively until `release` or the end of this process."""

    def __init__(self, path: Path, owner: str) -> None:
        """Take the lock; `owner` goes into the file for whoever is refused.

        Raises StoreError naming the present owner.
        """
        try:
            self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        except OSError as error:
            raise StoreError(
                f"Lock file {path} cannot be opened: {error.strerror}",
                "Make its folder yours to write in, or give another --state-dir",
            ) from error
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            present = os.read(self._descriptor, 200).decode(errors="replace").strip() or "another process"
            os.close(self._descriptor)
            raise StoreError(
                f"Store {path.with_suffix('')} is in use by {present}",
                "Stop that daemon, or give another --state-dir",
            ) from None
        os.ftruncate(self._descriptor, 0)
        os.pwrite(self._descriptor, owner.encode(), 0)

    def release(self) -> None:
        """Let the next owner in; safe twice."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1
