"""Object dictionary of one drive, after the device file of the arm."""

from typing import Final

from simulators.canopen_objects import Row, communication, entries_of, mapping


def _table() -> list[Row]:
    """Every object that this drive has. Absent: 603F, 605A-605E, 6067, 6068, 6071, 6084, 6085, 6099, 60FF."""
    table: list[Row] = [
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
        table += mapping(index, mapped)
    for index, base, kind in (
        (0x1400, 0x200, 1),
        (0x1401, 0x300, 1),
        (0x1800, 0x180, 1),
        (0x1801, 0x280, 1),
        (0x1802, 0x380, 1),
        (0x1803, 0x480, 254),
    ):
        table += communication(index, base, kind)
    return table


ENTRIES: Final = entries_of(_table())
