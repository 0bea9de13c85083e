"""Which values objects take beyond the range of their type, and which belong together; ``pdo`` has those of PDOs."""

from __future__ import annotations

from collections.abc import Callable

from frictid_drivers.virtual.axis import MODES, VELOCITY_UNITS
from frictid_drivers.virtual.object_dictionary import Abort, Guard, ObjectDictionary, SdoAbort
from frictid_drivers.virtual.objects import ERROR_HISTORY, Key, key

_SAVE, _LOAD = 0x65766173, 0x64616F6C  # signatures "save" and "load" of 1010h and 1011h

_UNITS = (0x608F01, 0x608F02, 0x609101, 0x609102, 0x609201, 0x609202, 0x607600, 0x60C201, 0x60C202, 0x608000)
UNITS = (*_UNITS, 0x202001, 0x202002, 0x202102, 0x202202, 0x60A900)
"""Objects that decide units, limits or the drive's own helpers."""
COMMANDS = (
    0x604000, 0x606000, 0x60FE01, 0x607100, 0x607200, 0x607A00, 0x60FF00, 0x60B000, 0x60B100, 0x60B200, 0x607D01,
    0x607D02,
)  # fmt: skip
"""Controlword, mode, outputs and set-points."""
NETWORK = (0x100500, 0x100600, 0x101601, 0x101602, 0x201001, 0x201002)
"""SYNC, its supervision, and the heartbeats listened for."""
HAND = (0x204001, 0x204002, 0x204003, 0x204004)


def install_rules(dictionary: ObjectDictionary, powered: Callable[[], bool]) -> None:
    """Put guards, and the effects that the dictionary has on itself, on a node's objects."""
    values = dictionary.values

    def clear_history() -> None:
        values.update({key(0x1003, sub): 0 for sub in range(1, ERROR_HISTORY + 1)})

    def store() -> None:
        values[key(0x1010, 1)] = 1
        dictionary.store()

    def restore() -> None:
        values[key(0x1011, 1)] = 1
        dictionary.forget()

    dictionary.guards.update(_guards(dictionary, powered))
    dictionary.effects.update({key(0x1003): clear_history, key(0x1010, 1): store, key(0x1011, 1): restore})


def _guards(dictionary: ObjectDictionary, powered: Callable[[], bool]) -> dict[Key, Guard]:
    """What refuses a value that is to be written."""
    number = dictionary.number

    def while_off(value: int) -> None:
        if powered():
            raise SdoAbort(Abort.DEVICE_STATE)

    def velocity_unit(value: int) -> None:
        while_off(value)
        if value not in VELOCITY_UNITS:
            raise SdoAbort(Abort.INVALID_VALUE)

    def mode(value: int) -> None:
        if value and (not 1 <= value <= 32 or not number(key(0x6502)) >> value - 1 & 1 or value not in MODES):
            raise SdoAbort(Abort.INVALID_VALUE)

    def sync_cob_id(value: int) -> None:
        # Bit 30 would make this node the producer of SYNC.
        if not 0x80 <= value <= 0xFF:
            raise SdoAbort(Abort.INVALID_VALUE)

    def sync_counter(value: int) -> None:
        if number(key(0x1006)):
            raise SdoAbort(Abort.DEVICE_STATE)
        if value == 1:
            raise SdoAbort(Abort.INVALID_VALUE)

    return dict.fromkeys(_UNITS, while_off) | {
        key(0x1003): _only(0, Abort.INVALID_VALUE),
        key(0x1005): sync_cob_id,
        key(0x1010, 1): _only(_SAVE, Abort.CANNOT_STORE),
        key(0x1011, 1): _only(_LOAD, Abort.CANNOT_STORE),
        key(0x1016, 1): _consumer(dictionary, key(0x1016, 2)),
        key(0x1016, 2): _consumer(dictionary, key(0x1016, 1)),
        key(0x1019): sync_counter,
        key(0x2023): while_off,
        key(0x6060): mode,
        key(0x60A9): velocity_unit,
    }


def _only(expected: int, refusal: int) -> Guard:
    def guard(value: int) -> None:
        if value != expected:
            raise SdoAbort(refusal)

    return guard


def _consumer(dictionary: ObjectDictionary, other: Key) -> Guard:
    """An entry of 1016h: a node that exists, and not the same one twice."""

    def guard(value: int) -> None:
        node, time_ms = value >> 16, value & 0xFFFF
        if node > 127:
            raise SdoAbort(Abort.INVALID_VALUE)
        beside = dictionary.number(other)
        if node and time_ms and beside >> 16 == node and beside & 0xFFFF:
            raise SdoAbort(Abort.INCOMPATIBLE)

    return guard
