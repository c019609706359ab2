"""SDO and NMT of the `canopen` library on our own link and clock, without threads.

The library waits for SDO answers on a queue that a receiving thread fills. Here the wait itself receives:
`ResponseQueue.get` pumps the link, so the same code runs in real and in virtual time.
"""

import queue
from collections.abc import Callable, Iterable
from typing import Any, Final

from canopen import ObjectDictionary
from canopen.network import Network
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from drivers.links.interfaces import CanLink
from estimation.errors import DeviceError, DeviceTimeout

OBJECT_MISSING: Final = (0x06020000, 0x06090011)  # no such object, no such subindex
ATTEMPTS: Final = 2


def read_request(index: int, subindex: int) -> bytes:
    """The frame that asks for an object (CiA 301: initiate upload)."""
    return bytes((0x40, index & 0xFF, index >> 8, subindex, 0, 0, 0, 0))


def short_answer(data: bytes, index: int, subindex: int) -> bytes | None:
    """The value in the answer to `read_request`, 1 to 4 bytes; None for any other frame."""
    if len(data) != 8 or data[0] & 0xE3 != 0x43 or data[1:4] != read_request(index, subindex)[1:4]:
        return None
    return data[4 : 8 - (data[0] >> 2 & 3)]


class SdoAbort(DeviceError):
    """The node refused an object; `code` is that of CiA 301."""

    def __init__(self, problem: str, remedy: str, code: int = 0) -> None:
        super().__init__(problem, remedy)
        self.code = code

    @property
    def is_missing(self) -> bool:
        """True if the node has no such object."""
        return self.code in OBJECT_MISSING


class ResponseQueue:
    """Stands in for the `queue.Queue` of an SdoClient."""

    def __init__(self, pump: Callable[[float, Callable[[], bool]], None]) -> None:
        self._pump, self._responses = pump, list[bytes]()

    def put(self, response: bytes) -> None:
        self._responses.append(response)

    def empty(self) -> bool:
        """Drops what a former request left behind; always True, so that the client keeps this object."""
        self._responses.clear()
        return True

    def get(self, block: bool = True, timeout: float = 0.0) -> bytes:
        self._pump(timeout, lambda: bool(self._responses))
        if not self._responses:
            raise queue.Empty
        return self._responses.pop(0)


class _LinkNetwork(Network):
    """The library's network on a CanLink."""

    def __init__(self, link: CanLink) -> None:
        super().__init__()
        self._link = link

    def send_message(self, can_id: int, data: Iterable[int], remote: bool = False) -> None:
        self._link.send(can_id, bytes(data))


class _CheckedSdoClient(SdoClient):
    """Drops answers that name another object: the library checks this for reads only."""

    def __init__(self, node_id: int) -> None:
        dictionary = ObjectDictionary()  # type: ignore[no-untyped-call]
        super().__init__(0x600 + node_id, 0x580 + node_id, dictionary)  # type: ignore[no-untyped-call]
        self._object = b""

    def send_request(self, request: bytearray) -> None:
        if request[0] & 0xE0 in (0x20, 0x40):  # start of a download or upload names the object
            self._object = bytes(request[1:4])
        super().send_request(request)  # type: ignore[no-untyped-call]

    def on_response(self, can_id: int, data: bytes, timestamp: float) -> None:
        names_object = len(data) == 8 and data[0] & 0xE0 in (0x40, 0x60, 0x80)
        if len(data) == 8 and (not names_object or bytes(data[1:4]) == self._object):
            super().on_response(can_id, data, timestamp)  # type: ignore[no-untyped-call]


class SdoPort:
    """SDO access to the nodes of one bus.

    `pump(timeout_s, done)` receives frames and calls `deliver` until `done()` or the timeout.
    """

    def __init__(
        self,
        link: CanLink,
        node_ids: Iterable[int],
        pump: Callable[[float, Callable[[], bool]], None],
        timeout_s: float,
    ) -> None:
        self._network = _LinkNetwork(link)
        self._timeout_s, self._pump = timeout_s, pump
        self._clients: dict[int, Any] = {}
        for node_id in node_ids:
            client: Any = _CheckedSdoClient(node_id)
            client.network, client.RESPONSE_TIMEOUT = self._network, timeout_s
            client.responses = ResponseQueue(pump)
            self._network.subscribe(client.tx_cobid, client.on_response)
            self._clients[node_id] = client

    def deliver(self, can_id: int, data: bytes, time_s: float) -> None:
        """Hand over a received frame with an identifier of 580h + node."""
        self._network.notify(can_id, bytearray(data), time_s)

    def send_nmt(self, command: int, node_id: int = 0) -> None:
        """Network management command to one node, or to all (0)."""
        nmt = self._network.nmt
        nmt.id = node_id
        nmt.send_command(command)

    def read(self, node_id: int, index: int, subindex: int = 0) -> bytes:
        """Value of an object, little-endian. Raises SdoAbort, DeviceTimeout."""
        return bytes(self._transfer(node_id, index, subindex, None))

    def read_int(self, node_id: int, index: int, subindex: int = 0, *, signed: bool = False) -> int:
        """Integer value of an object. Raises SdoAbort, DeviceTimeout."""
        return int.from_bytes(self.read(node_id, index, subindex), "little", signed=signed)

    def write(self, node_id: int, index: int, subindex: int, value: int, size: int) -> None:
        """Write an integer of `size` bytes. Raises SdoAbort, DeviceTimeout."""
        signed = value < 0
        self._transfer(node_id, index, subindex, value.to_bytes(size, "little", signed=signed))

    def _transfer(self, node_id: int, index: int, subindex: int, data: bytes | None) -> bytes:
        client = self._clients[node_id]
        what = f"Node {node_id} object {index:04X}h:{subindex}"
        failure = ""
        for _ in range(ATTEMPTS):
            try:
                if data is None:
                    return bytes(client.upload(index, subindex))
                client.download(index, subindex, data)
                return b""
            except SdoAbortedError as abort:
                text = SdoAbortedError.CODES.get(abort.code, "unknown reason")
                raise SdoAbort(
                    f"{what}: it refused with {abort.code:08X}h ({text})",
                    "Check that the device is of the type which the cell file names",
                    abort.code,
                ) from abort
            except SdoCommunicationError as error:
                failure = str(error)
                self._pump(self._timeout_s, lambda: False)  # a late answer must not meet the next request
        raise DeviceTimeout(
            f"{what}: no valid answer within {self._timeout_s:g} s, {ATTEMPTS} attempts ({failure})",
            "Check power, node id and CAN wiring of this joint",
        )
