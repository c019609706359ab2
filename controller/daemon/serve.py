"""The daemon's process: asyncio with the routes in the main thread, the engine in a thread of its own."""

import asyncio
import contextlib
import logging
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import uvicorn

from controller.daemon.address import listen
from controller.daemon.api import CellEngine, Reporter, create_app
from controller.daemon.feed import EventFeed
from controller.store import Store

log = logging.getLogger(__name__)

_STREAMS_END_S: Final = 2
_ENGINE_END_S: Final = 10.0  # a controlled stop takes less; then the process ends all the same


class _Server(uvicorn.Server):
    """uvicorn, but signals are ours: the arm stops before the last watcher has gone."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


def serve(
    engine: CellEngine,
    store: Store,
    address: Path,
    report: Reporter,
    ready: Callable[[], None],
) -> bool:
    """Serve until SIGTERM or SIGINT; `ready` is called once clients can connect.

    Returns True after an orderly end, False if the engine died or did not end.
    Raises CellError if the socket cannot be had.
    """
    listener = listen(address)
    try:
        return asyncio.run(_serve(engine, store, listener, report, ready))
    finally:
        listener.close()
        address.unlink(missing_ok=True)


async def _serve(
    engine: CellEngine, store: Store, listener: socket.socket, report: Reporter, ready: Callable[[], None]
) -> bool:
    loop = asyncio.get_running_loop()
    feed = EventFeed(engine)
    app = create_app(engine, store, feed, report)
    config = uvicorn.Config(
        app, lifespan="off", log_config=None, access_log=False, timeout_graceful_shutdown=_STREAMS_END_S
    )
    server = _Server(config)
    asked_to_end = False
    died = False

    def end() -> None:
        nonlocal asked_to_end
        if not asked_to_end:
            asked_to_end = True
            threading.Thread(target=engine.shutdown, name="stop", daemon=True).start()
            feed.close()  # uvicorn waits for open streams
            server.should_exit = True

    def act() -> None:
        nonlocal died
        try:
            engine.run_forever()
        except Exception:
            log.exception("The engine died")
        if not asked_to_end:  # nobody would answer commands any more: stop the arm and let go
            died = True
            with contextlib.suppress(RuntimeError):  # the loop may have ended meanwhile
                loop.call_soon_threadsafe(end)

    if threading.current_thread() is threading.main_thread():  # in a test it is not
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, end)
    thread = threading.Thread(target=act, name="engine", daemon=True)
    thread.start()
    try:
        serving = asyncio.create_task(server.serve(sockets=[listener]))
        while not server.started and not serving.done():
            await asyncio.sleep(0.005)
        ready()
        await serving
    finally:
        end()
        await asyncio.to_thread(thread.join, _ENGINE_END_S)
    if thread.is_alive():
        log.error("The engine did not end within %.0f s", _ENGINE_END_S)
    return not died and not thread.is_alive()
