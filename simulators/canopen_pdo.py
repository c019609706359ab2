"""The process data of a CANopen device: which objects travel in which frame, as set at run time (CiA 301)."""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from simulators.canopen_objects import (
    BAD_VALUE,
    CANNOT_BE_MAPPED,
    MAPPING_TOO_LONG,
    NO_OBJECT,
    PACKING,
    SIZES,
    WRONG_STATE,
    Entries,
    Key,
    SdoAbort,
    Value,
)

DISABLED: Final = 1 << 31
SYNCHRONOUS: Final = (0, 1)  # every SYNC; not every n-th
EVENT_DRIVEN: Final = (254, 255)


@dataclass(frozen=True, slots=True)
class Pdo:
    """One PDO in use."""

    can_id: int
    kind: int  # transmission type
    layout: struct.Struct
    keys: tuple[Key, ...]
    event_s: float  # event timer, 0 = none


SentFrame = tuple[int, Callable[..., bytes], tuple[Callable[[], int | float], ...]]  # id, packing, readers


@dataclass(slots=True)
class TimedPdo:
    """A transmit PDO that goes out by its event timer."""

    due_s: float
    period_s: float
    frame: SentFrame


def is_communication(index: int) -> bool:
    """Whether this object says how a PDO travels, and not what is in it."""
    return 0x1400 <= index < 0x1600 or 0x1800 <= index < 0x1A00


def check_pdo_write(entries: Entries, values: dict[Key, Value], key: Key, value: Value) -> None:
    """Raises SdoAbort if a communication (14xx, 18xx) or mapping (16xx, 1Axx) object must not become this.

    A mapping can be changed only while its PDO is switched off and its count is zero.
    """
    index, sub = key
    number = int(value)
    if is_communication(index):
        if sub == 2 and number not in SYNCHRONOUS + EVENT_DRIVEN:
            raise SdoAbort(BAD_VALUE)
        enabled_before = not int(values[index, 1]) & DISABLED
        if sub == 1 and enabled_before and not number & DISABLED and number != values[index, 1]:
            raise SdoAbort(WRONG_STATE)  # a COB-ID is changed by way of "switched off"
        return
    if not int(values[index - 0x200, 1]) & DISABLED:
        raise SdoAbort(WRONG_STATE)
    if sub:
        if values[index, 0]:
            raise SdoAbort(WRONG_STATE)
        if number:
            _mapped(entries, number, receive=index < 0x1A00)
        return
    if number > 8:
        raise SdoAbort(BAD_VALUE)
    bits = 0
    for position in range(1, number + 1):
        mapped = int(values[index, position])
        _mapped(entries, mapped, receive=index < 0x1A00)
        bits += mapped & 0xFF
    if bits > 64:
        raise SdoAbort(MAPPING_TOO_LONG)


def _mapped(entries: Entries, word: int, receive: bool) -> Key:
    key = (word >> 16, word >> 8 & 0xFF)
    entry = entries.get(key)
    if entry is None:
        raise SdoAbort(NO_OBJECT)
    if not entry.mappable or (receive and not entry.writable) or SIZES[entry.kind] * 8 != word & 0xFF:
        raise SdoAbort(CANNOT_BE_MAPPED)
    return key


def active_pdos(entries: Entries, values: dict[Key, Value], receive: bool) -> list[Pdo]:
    """The PDOs that are switched on and carry something."""
    base = 0x1400 if receive else 0x1800
    result = []
    for index in [index for index, sub in values if base <= index < base + 0x200 and sub == 1]:
        can_id = int(values[index, 1])
        mapping = index + 0x200
        size = int(values[mapping, 0])
        if can_id & DISABLED or not size:
            continue
        keys = tuple(_mapped(entries, int(values[mapping, sub]), receive) for sub in range(1, size + 1))
        layout = struct.Struct("<" + "".join(PACKING[entries[key].kind] for key in keys))
        event_s = int(values[index, 5]) / 1000
        result.append(Pdo(can_id & 0x7FF, int(values[index, 2]), layout, keys, event_s))
    return result


def default_can_ids(values: dict[Key, Value], node: int) -> None:
    """Power-on COB-IDs depend on the node."""
    for index, sub in values:
        if is_communication(index) and sub == 1:
            values[index, 1] = int(values[index, 1]) + node
    values[0x1014, 0] = 0x80 + node
