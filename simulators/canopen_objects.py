"""Object dictionary and SDO server of a CANopen device (CiA 301)."""

import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Final

# Abort codes
TOGGLE_BIT: Final = 0x05030000
UNKNOWN_COMMAND: Final = 0x05040001
WRITE_ONLY_READ: Final = 0x06010001
READ_ONLY_WRITTEN: Final = 0x06010002
NO_OBJECT: Final = 0x06020000
CANNOT_BE_MAPPED: Final = 0x06040041
MAPPING_TOO_LONG: Final = 0x06040042
WRONG_LENGTH: Final = 0x06070010
NO_SUBINDEX: Final = 0x06090011
BAD_VALUE: Final = 0x06090030
WRONG_STATE: Final = 0x08000022

SIZES: Final = {"u8": 1, "i8": 1, "u16": 2, "i16": 2, "u32": 4, "i32": 4, "f32": 4}
PACKING: Final = {"u8": "B", "i8": "b", "u16": "H", "i16": "h", "u32": "I", "i32": "i", "f32": "f"}

Value = int | float | str
Key = tuple[int, int]


class SdoAbort(Exception):
    """The access is refused with this abort code; never leaves the simulator."""

    def __init__(self, code: int) -> None:
        super().__init__(f"{code:08X}h")
        self.code = code


@dataclass(frozen=True, slots=True)
class ObjectEntry:
    """One object: its type, its value at power-on, and what may be done with it."""

    kind: str  # of SIZES, or "text"
    default: Value
    writable: bool
    mappable: bool


Entries = Mapping[Key, ObjectEntry]
Row = tuple[int, int, str, Value, str]  # index, subindex, kind, default, flags


def entries_of(table: Iterable[Row]) -> dict[Key, ObjectEntry]:
    """Objects from a table; the flags are r or w, and m if it can be mapped into a PDO."""
    return {
        (index, sub): ObjectEntry(kind, default, "w" in flags, "m" in flags)
        for index, sub, kind, default, flags in table
    }


def mapping(index: int, mapped: tuple[int, ...]) -> list[Row]:
    """The rows of a mapping object (16xxh, 1Axxh)."""
    padded = mapped + (0,) * (8 - len(mapped))
    return [
        (index, 0, "u8", len(mapped), "w"),
        *[(index, sub, "u32", word, "w") for sub, word in enumerate(padded, start=1)],
    ]


def communication(index: int, base: int, kind: int, inhibit: int = 0) -> list[Row]:
    """The rows of a communication object (14xxh, 18xxh): identifier without node, transmission type."""
    return [
        (index, 0, "u8", 5, "r"),
        (index, 1, "u32", base, "w"),
        (index, 2, "u8", kind, "w"),
        (index, 3, "u16", inhibit, "w"),
        (index, 5, "u16", 0, "w"),
    ]


def entry_of(entries: Entries, key: Key) -> ObjectEntry:
    """Raises SdoAbort if the device has no such object."""
    entry = entries.get(key)
    if entry is None:
        known = any(index == key[0] for index, _ in entries)
        raise SdoAbort(NO_SUBINDEX if known else NO_OBJECT)
    return entry


class SdoServer:
    """Answers the SDO requests to one node: expedited both ways, segmented when the answer is a text.

    `read` and `write` give and take values; both may raise SdoAbort.
    """

    def __init__(
        self, entries: Entries, read: Callable[[Key], Value], write: Callable[[Key, Value], None]
    ) -> None:
        self._entries, self._read, self._write = entries, read, write
        self._rest = b""  # of a segmented upload under way
        self._key: Key = (0, 0)
        self._toggle: int | None = None

    def answer(self, request: bytes) -> bytes:
        """The 8 bytes to send back; b"" if none."""
        if len(request) != 8:
            return b""
        command = request[0]
        try:
            if command >> 5 == 3:
                return self._segment(command)
            index, sub = struct.unpack_from("<HB", request, 1)
            self._key, self._toggle = (index, sub), None
            if command >> 5 == 2:
                return self._upload()
            if command >> 5 == 1:
                return self._download(command, request[4:])
            if command >> 5 == 4:
                return b""  # the client gave up
            raise SdoAbort(UNKNOWN_COMMAND)
        except SdoAbort as abort:
            self._toggle = None
            return struct.pack("<BHBI", 0x80, *self._key, abort.code)

    def _upload(self) -> bytes:
        entry = entry_of(self._entries, self._key)
        value = self._read(self._key)
        if isinstance(value, str):
            self._rest, self._toggle = value.encode("ascii"), 0
            return struct.pack("<BHBI", 0x41, *self._key, len(self._rest))
        data = struct.pack("<" + PACKING[entry.kind], value)
        head = 0x43 | (4 - len(data)) << 2
        return struct.pack("<BHB4s", head, *self._key, data)

    def _segment(self, command: int) -> bytes:
        if self._toggle is None:
            raise SdoAbort(UNKNOWN_COMMAND)
        if (command >> 4) & 1 != self._toggle:
            raise SdoAbort(TOGGLE_BIT)
        piece, self._rest = self._rest[:7], self._rest[7:]
        head = self._toggle << 4 | (7 - len(piece)) << 1 | (0 if self._rest else 1)
        self._toggle = self._toggle ^ 1 if self._rest else None
        return struct.pack("<B7s", head, piece)

    def _download(self, command: int, data: bytes) -> bytes:
        entry = entry_of(self._entries, self._key)
        if not entry.writable:
            raise SdoAbort(READ_ONLY_WRITTEN)
        size = SIZES.get(entry.kind, 0)
        sent = 4 - (command >> 2 & 3) if command & 1 else size
        if not command & 2 or sent != size:
            raise SdoAbort(WRONG_LENGTH)
        (value,) = struct.unpack("<" + PACKING[entry.kind], data[:size])
        self._write(self._key, value)
        return struct.pack("<BHBI", 0x60, *self._key, 0)
