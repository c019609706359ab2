"""Events from the engine's thread to everybody who watches, over HTTP (server-sent events)."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from typing import Any, Final, Protocol

HEARTBEAT_S: Final = 1.0  # a client that hears nothing for three of them has lost the daemon
_MOST_WAITING: Final = 1000  # events; whoever is slower than that is cut off and may come back


class Publisher(Protocol):
    """What the feed needs of the engine."""

    def subscribe(self, listener: Callable[[dict[str, Any]], None], /) -> Callable[[], None]:
        """Call `listener` with every event; returns how to unsubscribe."""


def plain(value: object) -> Any:
    """`value` as JSON can carry it: arrays as lists, numbers that are not finite as null."""
    text = json.dumps(value, default=lambda v: v.tolist() if hasattr(v, "tolist") else str(v))
    return json.loads(text, parse_constant=lambda _: None)


class EventFeed:
    """Fans events out to any number of watchers; one slow watcher holds up nobody."""

    def __init__(self, publisher: Publisher) -> None:
        """Call inside the event loop that serves the watchers."""
        self._loop = asyncio.get_running_loop()
        self._queues = set[asyncio.Queue[dict[str, Any] | None]]()
        self._closed = False
        self._unsubscribe = publisher.subscribe(self._from_engine)

    def close(self) -> None:
        """End every stream."""
        if not self._closed:
            self._closed = True
            self._unsubscribe()
            for queue in tuple(self._queues):
                self._offer(queue, None)

    def _from_engine(self, event: dict[str, Any]) -> None:
        event = plain(event)  # here, while the engine still stands behind what it says
        if not self._closed:
            self._loop.call_soon_threadsafe(self._spread, event)

    def _spread(self, event: dict[str, Any]) -> None:
        for queue in tuple(self._queues):
            self._offer(queue, event)

    def _offer(self, queue: asyncio.Queue[dict[str, Any] | None], event: dict[str, Any] | None) -> None:
        if event is None or queue.full():
            self._queues.discard(queue)
            while not queue.empty():
                queue.get_nowait()
            event = None
        queue.put_nowait(event)

    async def stream(self, snapshot: Callable[[], dict[str, Any]]) -> AsyncIterator[str]:
        """The text of one stream: a snapshot of the status, then every event."""
        queue = asyncio.Queue[dict[str, Any] | None](_MOST_WAITING)
        if self._closed:
            return
        self._queues.add(queue)  # before the snapshot: what happens meanwhile comes after it, not never
        try:
            status = await asyncio.to_thread(snapshot)
            yield _message({"event": "status", **plain(status)})
            while True:
                try:
                    event = await asyncio.wait_for(queue.get(), HEARTBEAT_S)
                except TimeoutError:
                    yield ": alive\n\n"
                    continue
                if event is None:
                    return
                yield _message(event)
        finally:
            self._queues.discard(queue)


def _message(event: dict[str, Any]) -> str:
    return f"event: {event.get('event', 'message')}\ndata: {json.dumps(event)}\n\n"
