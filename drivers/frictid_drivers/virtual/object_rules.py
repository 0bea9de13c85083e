"""Which values objects take beyond the range of their type, and what happens when one is written.

Guards refuse with the abort codes of CiA 301; effects make a written value act. PDO parameters have theirs in ``pdo``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from frictid_drivers.virtual.axis import MODES, VELOCITY_UNITS
from frictid_drivers.virtual.object_dictionary import (
    CANNOT_STORE,
    DEVICE_STATE,
    INCOMPATIBLE,
    INVALID_VALUE,
    Effect,
    Guard,
    ObjectDictionary,
    SdoAbort,
)
from frictid_drivers.virtual.objects import ERROR_HISTORY, Key, key

_SAVE, _LOAD = 0x65766173, 0x64616F6C
"""Signatures "save" and "load" of 1010h and 1011h."""

_UNITS = (0x608F01, 0x608F02, 0x609101, 0x609102, 0x609201, 0x609202, 0x607600, 0x60C201, 0x60C202, 0x608000)
_HELPERS = (0x202001, 0x202002, 0x202102, 0x202202)
_COMMANDS = (
    0x604000, 0x606000, 0x60FE01, 0x607100, 0x607200, 0x607A00, 0x60FF00, 0x60B000, 0x60B100, 0x60B200, 0x607D01,
    0x607D02,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Reactions:
    """What the node does when objects change.

    Attributes:
        powered: asked: the motor has power.
        units: units or limits changed.
        commands: controlword, mode, outputs or set-points changed.
        brake: the brake may have to move.
        network: SYNC, its supervision or the heartbeats listened for changed.
        counter: the SYNC counter changed.
        frames: the kind of frame of PDOs changed.
        heartbeat: our own heartbeat changed.
        hand: the simulated hand changed.
        payload: the simulated payload changed.
    """

    powered: Callable[[], bool]
    units: Effect
    commands: Effect
    brake: Effect
    network: Effect
    counter: Effect
    frames: Effect
    heartbeat: Effect
    hand: Effect
    payload: Effect


def install_rules(dictionary: ObjectDictionary, reactions: Reactions) -> None:
    """Put guards and effects on a node's objects."""
    dictionary.guards.update(_guards(dictionary, reactions))
    dictionary.effects.update(_effects(dictionary, reactions))


def _guards(dictionary: ObjectDictionary, reactions: Reactions) -> dict[Key, Guard]:
    """What refuses a value that is to be written."""
    number = dictionary.number

    def while_off(value: int) -> None:
        if reactions.powered():
            raise SdoAbort(DEVICE_STATE)

    def velocity_unit(value: int) -> None:
        while_off(value)
        if value not in VELOCITY_UNITS:
            raise SdoAbort(INVALID_VALUE)

    def mode(value: int) -> None:
        if value and (not 1 <= value <= 32 or not number(key(0x6502)) >> value - 1 & 1 or value not in MODES):
            raise SdoAbort(INVALID_VALUE)

    def sync_cob_id(value: int) -> None:
        # Bit 30 would make this node the producer of SYNC.
        if not 0x80 <= value <= 0xFF:
            raise SdoAbort(INVALID_VALUE)

    def sync_counter(value: int) -> None:
        if number(key(0x1006)):
            raise SdoAbort(DEVICE_STATE)
        if value == 1:
            raise SdoAbort(INVALID_VALUE)

    return dict.fromkeys(_UNITS, while_off) | {
        key(0x1003): _one_of(0),
        key(0x1005): sync_cob_id,
        key(0x1010, 1): _signature(_SAVE),
        key(0x1011, 1): _signature(_LOAD),
        key(0x1016, 1): _consumer(dictionary, key(0x1016, 2)),
        key(0x1016, 2): _consumer(dictionary, key(0x1016, 1)),
        key(0x1019): sync_counter,
        key(0x2023): while_off,
        key(0x6060): mode,
        key(0x60A9): velocity_unit,
    }


def _effects(dictionary: ObjectDictionary, reactions: Reactions) -> dict[Key, Effect]:
    """What follows from a value that was written."""

    def clear_history() -> None:
        for sub in range(1, ERROR_HISTORY + 1):
            dictionary.values[key(0x1003, sub)] = 0

    def store() -> None:
        dictionary.values[key(0x1010, 1)] = 1
        dictionary.store()

    def restore() -> None:
        dictionary.values[key(0x1011, 1)] = 1
        dictionary.forget()

    network = (key(0x1005), key(0x1006), key(0x1016, 1), key(0x1016, 2), key(0x2010, 1), key(0x2010, 2))
    hand = (key(0x2040, sub) for sub in (1, 2, 3, 4))
    return {
        key(0x1003): clear_history,
        key(0x1010, 1): store,
        key(0x1011, 1): restore,
        key(0x1017): reactions.heartbeat,
        key(0x1019): reactions.counter,
        key(0x2023): reactions.frames,
        key(0x2041): reactions.payload,
        key(0x60A9): reactions.units,
        key(0x60FE, 2): reactions.brake,
        **dict.fromkeys(network, reactions.network),
        **dict.fromkeys(hand, reactions.hand),
        **dict.fromkeys(_UNITS + _HELPERS, reactions.units),
        **dict.fromkeys(_COMMANDS, reactions.commands),
    }


def _one_of(*allowed: int) -> Guard:
    def guard(value: int) -> None:
        if value not in allowed:
            raise SdoAbort(INVALID_VALUE)

    return guard


def _signature(expected: int) -> Guard:
    def guard(value: int) -> None:
        if value != expected:
            raise SdoAbort(CANNOT_STORE)

    return guard


def _consumer(dictionary: ObjectDictionary, other: Key) -> Guard:
    """An entry of 1016h: a node that exists, and not the same one twice."""

    def guard(value: int) -> None:
        node, time_ms = value >> 16, value & 0xFFFF
        if node > 127:
            raise SdoAbort(INVALID_VALUE)
        beside = dictionary.number(other)
        if node and time_ms and beside >> 16 == node and beside & 0xFFFF:
            raise SdoAbort(INCOMPATIBLE)

    return guard
