"""Who has the bus: the driver that was called, before the keeper in the background."""

import threading


class Foreground:
    """A re-entrant lock with a right of way: `wanted` tells the keeper to stand back."""

    def __init__(self) -> None:
        self.lock, self.wanted = threading.RLock(), 0
        self.idle = threading.Event()
        self.idle.set()
        self._count_lock = threading.Lock()

    def __enter__(self) -> None:
        if not self.lock.acquire(blocking=False):
            with self._count_lock:
                self.wanted += 1
                self.idle.clear()
            self.lock.acquire()
            with self._count_lock:
                self.wanted -= 1
                if not self.wanted:
                    self.idle.set()

    def __exit__(self, *error: object) -> None:
        self.lock.release()
