"""Object dictionary of one drive, after the device file of the arm, and its SDO server (CiA 301)."""

import struct
from collections.abc import Callable
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
    kind: str  # of SIZES, or "text"
    default: Value
    writable: bool
    mappable: bool


def _entries() -> dict[Key, ObjectEntry]:
    """Every object that this drive has. Absent: 603F, 605A-605E, 6067, 6068, 6071, 6084, 6085, 6099, 60FF."""
    table: list[tuple[int, int, str, Value, str]] = [
        (0x1000, 0, "u32", 0x00020192, "r"),
        (0x1001, 0, "u8", 0, "rm"),
        (0x1003, 0, "u8", 0, "w"),
        *[(0x1003, sub, "u32", 0, "r") for sub in range(1, 9)],
        (0x1005, 0, "u32", 0x80, "r"),
        (0x1006, 0, "u32", 10_000, "w"),
        (0x1008, 0, "text", "", "r"),
        (0x1009, 0, "text", "1.0", "r"),
        (0x100A, 0, "text", "01.69.00.27 simulated", "r"),
        (0x1014, 0, "u32", 0x80, "r"),
        (0x1016, 0, "u8", 2, "r"),
        (0x1016, 1, "u32", 0, "w"),
        (0x1016, 2, "u32", 0, "w"),
        (0x1017, 0, "u16", 0, "w"),
        (0x1018, 0, "u8", 4, "r"),
        *[(0x1018, sub, "u32", 0, "r") for sub in range(1, 5)],
        (0x200B, 0, "text", "", "r"),
        (0x200D, 0, "f32", 36.5, "r"),
        (0x200E, 0, "u8", 6, "w"),
        (0x2060, 0, "u8", 3, "r"),
        (0x2060, 1, "u16", 2500, "w"),
        (0x2060, 2, "u8", 0, "w"),
        (0x2060, 3, "u8", 0, "r"),
        (0x20A0, 0, "u8", 7, "r"),
        (0x20A0, 7, "u8", 1, "r"),
        (0x6040, 0, "u16", 0, "wm"),
        (0x6041, 0, "u16", 0, "rm"),
        (0x6042, 0, "i16", 0, "wm"),
        (0x6060, 0, "i8", 7, "wm"),
        (0x6061, 0, "i8", 7, "rm"),
        (0x6062, 0, "i32", 0, "rm"),
        (0x6064, 0, "i32", 0, "rm"),
        (0x6065, 0, "u32", 3000, "w"),
        (0x606B, 0, "i32", 0, "rm"),
        (0x606C, 0, "i32", 0, "rm"),
        (0x6077, 0, "i16", 0, "rm"),
        (0x607A, 0, "i32", 0, "wm"),
        (0x607C, 0, "i32", 0, "w"),
        (0x607D, 0, "u8", 2, "r"),
        (0x607D, 1, "i32", 0, "w"),
        (0x607D, 2, "i32", 0, "w"),
        (0x6081, 0, "u32", 10_000, "wm"),
        (0x6083, 0, "u32", 0, "wm"),
        (0x6098, 0, "i8", 0, "r"),
        (0x60C0, 0, "i16", 0, "r"),
        (0x60C1, 0, "u8", 1, "r"),
        (0x60C1, 1, "i32", 0, "wm"),
        (0x60C2, 0, "u8", 2, "r"),
        (0x60C2, 1, "u8", 8, "w"),
        (0x60C2, 2, "i8", -3, "w"),
        (0x60F4, 0, "i32", 0, "rm"),
        (0x60FD, 0, "u32", 0, "rm"),
        (0x60FE, 0, "u8", 2, "r"),
        (0x60FE, 1, "u32", 0, "wm"),
        (0x60FE, 2, "u32", 0, "w"),
        (0x6502, 0, "u32", 0x43, "r"),
    ]
    maps: dict[int, tuple[int, ...]] = {
        0x1600: (0x60400010, 0x60420010, 0x60C10120),
        0x1601: (0x607A0020, 0x60810020),
        0x1A00: (0x60410010, 0x60610008),
        0x1A01: (0x606B0020, 0x606C0020),
        0x1A02: (0x60640020, 0x606C0020),
        0x1A03: (),
    }
    for index, mapped in maps.items():
        table.append((index, 0, "u8", len(mapped), "w"))
        padded = mapped + (0,) * (8 - len(mapped))
        table += [(index, sub, "u32", value, "w") for sub, value in enumerate(padded, start=1)]
    for index, base, kind in (
        (0x1400, 0x200, 1),
        (0x1401, 0x300, 1),
        (0x1800, 0x180, 1),
        (0x1801, 0x280, 1),
        (0x1802, 0x380, 1),
        (0x1803, 0x480, 254),
    ):
        table += [(index, 0, "u8", 5, "r"), (index, 1, "u32", base, "w"), (index, 2, "u8", kind, "w")]
        table += [(index, 3, "u16", 0, "w"), (index, 5, "u16", 0, "w")]
    return {
        (index, sub): ObjectEntry(kind, default, "w" in flags, "m" in flags)
        for index, sub, kind, default, flags in table
    }


ENTRIES: Final = _entries()
INDEXES: Final = frozenset(index for index, _ in ENTRIES)


def entry_of(key: Key) -> ObjectEntry:
    """Raises SdoAbort if the drive has no such object."""
    entry = ENTRIES.get(key)
    if entry is None:
        raise SdoAbort(NO_SUBINDEX if key[0] in INDEXES else NO_OBJECT)
    return entry


class SdoServer:
    """Answers the SDO requests to one node: expedited both ways, segmented when the answer is a text.

    `read` and `write` give and take values; both may raise SdoAbort.
    """

    def __init__(self, read: Callable[[Key], Value], write: Callable[[Key, Value], None]) -> None:
        self._read, self._write = read, write
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
        entry = entry_of(self._key)
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
        entry = entry_of(self._key)
        if not entry.writable:
            raise SdoAbort(READ_ONLY_WRITTEN)
        size = SIZES.get(entry.kind, 0)
        sent = 4 - (command >> 2 & 3) if command & 1 else size
        if not command & 2 or sent != size:
            raise SdoAbort(WRONG_LENGTH)
        (value,) = struct.unpack("<" + PACKING[entry.kind], data[:size])
        self._write(self._key, value)
        return struct.pack("<BHBI", 0x60, *self._key, 0)
