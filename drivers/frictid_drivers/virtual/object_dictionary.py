"""The values behind the table of objects, and the rules by which they are read and written.

Everything that reaches a value from outside comes through ``upload`` and ``download``, which answer with the abort
codes of CiA 301; the drive itself uses ``values`` directly, a plain dictionary by key, because it does so thousands of
times a second.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from enum import IntEnum

from frictid_drivers.virtual.objects import (
    OBJECTS,
    SIGNED,
    SIZE_BYTES,
    STANDARD,
    DataType,
    Entry,
    Key,
    Manner,
    Record,
    Value,
    key,
)

MAX_STRING_BYTES = 64

Guard = Callable[[int], None]  # looks at a number about to be written; raises ``SdoAbort`` to refuse it
Effect = Callable[[], None]  # acts on a value that was just written


class Abort(IntEnum):
    """Abort codes of CiA 301."""

    TOGGLE_NOT_ALTERNATED = 0x05030000
    UNKNOWN_COMMAND = 0x05040001
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    MAPPING_TOO_LONG = 0x06040042
    INCOMPATIBLE = 0x06040043
    LENGTH_MISMATCH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    INVALID_VALUE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    CANNOT_STORE = 0x08000020
    DEVICE_STATE = 0x08000022


class SdoAbort(Exception):
    """Access to an object was refused; ``code`` is the abort code of CiA 301."""

    def __init__(self, code: int) -> None:
        super().__init__(f"{code:08X}h")
        self.code = code


class ObjectDictionary:
    """All values of one node."""

    def __init__(
        self,
        node_id: int,  # added to the defaults that depend on it
        overrides: Mapping[Key, Value] | None = None,  # defaults of this very drive (rated torque, gear, serial number)
        *,
        missing: Iterable[int] = (),  # indices that this drive does not have (to play a poorer drive)
        records: Iterable[Record] = OBJECTS,
        manner: Manner = STANDARD,
    ) -> None:
        self.manner = manner
        absent = frozenset(missing)
        every = [entry for record in records for entry in record.entries]
        # Objects that are missing keep their values: the drive acts by its defaults, it only does not let anybody see.
        self.entries: dict[Key, Entry] = {
            entry.key: entry for entry in every if entry.key >> 8 not in absent and entry.key not in manner.absent
        }
        self.indices = frozenset(address >> 8 for address in self.entries)
        self.guards: dict[Key, Guard] = {}
        self.effects: dict[Key, Effect] = {}
        self.before_upload: Effect = lambda: None  # brings values up to date
        self._defaults: dict[Key, Value] = {entry.key: _with_node(entry, node_id) for entry in every}
        self._defaults |= overrides or {}
        self._stored: dict[Key, Value] | None = None
        self.values: dict[Key, Value] = dict(self._defaults)

    def reset(self, first: int = 0, last: int = 0xFFFF) -> None:
        """Objects ``first`` to ``last`` back to the power-on values: those stored by 1010h, else the defaults."""
        source = self._defaults if self._stored is None else self._stored
        self.values.update({address: value for address, value in source.items() if first <= address >> 8 <= last})

    def store(self) -> None:
        """Keep the writable values over a reset (1010h)."""
        kept = {address: self.values[address] for address, entry in self.entries.items() if entry.access == "rw"}
        self._stored = self._defaults | kept

    def forget(self) -> None:
        """Let the next reset restore the defaults (1011h)."""
        self._stored = None

    def number(self, address: Key) -> int:
        """The value of a numeric object."""
        value = self.values[address]
        assert isinstance(value, int)
        return value

    def entry(self, address: Key) -> Entry:
        """The description of a value; ``SdoAbort`` where there is no such object or subindex."""
        found = self.entries.get(address)
        if found is None:
            raise SdoAbort(Abort.NO_SUBINDEX if address >> 8 in self.indices else self.manner.no_object)
        return found

    def upload(self, address: Key) -> bytes:
        """The bytes that an SDO upload carries; ``SdoAbort`` where it is unknown, or write-only."""
        entry = self.entry(address)
        if entry.access == "wo":
            raise SdoAbort(Abort.WRITE_ONLY)
        self.before_upload()
        if address >> 8 == 0x1003 and 0 < address & 0xFF > self.number(key(0x1003)):
            raise SdoAbort(Abort.NO_SUBINDEX)
        return encode(entry, self.values[address])

    def download(self, address: Key, data: bytes) -> None:
        """Store the bytes of an SDO download; ``SdoAbort`` by access, length, range, or the drive's present state."""
        entry = self.entry(address)
        if entry.access in ("ro", "const"):
            raise SdoAbort(Abort.READ_ONLY)
        value = decode(entry, data)
        if isinstance(value, int):
            low, high = entry.limits
            if not low <= value <= high:
                raise SdoAbort(Abort.TOO_HIGH if value > high else Abort.TOO_LOW)
            if (guard := self.guards.get(address)) is not None:
                guard(value)
        self.values[address] = value
        if (effect := self.effects.get(address)) is not None:
            effect()


def encode(entry: Entry, value: Value) -> bytes:
    """A value as it travels: little-endian, two's complement, or ASCII."""
    if isinstance(value, str):
        return value.encode("ascii", "replace")
    size = SIZE_BYTES[entry.kind]
    return (value & (1 << 8 * size) - 1).to_bytes(size, "little")


def decode(entry: Entry, data: bytes) -> Value:
    """The value of bytes; ``SdoAbort`` for a wrong length, or text that is not printable ASCII."""
    if entry.kind is DataType.STRING:
        if len(data) > MAX_STRING_BYTES:
            raise SdoAbort(Abort.TOO_LONG)
        if any(not 0x20 <= byte < 0x7F for byte in data):
            raise SdoAbort(Abort.INVALID_VALUE)
        return data.decode("ascii")
    if len(data) != (size := SIZE_BYTES[entry.kind]):
        raise SdoAbort(Abort.TOO_LONG if len(data) > size else Abort.TOO_SHORT)
    return int.from_bytes(data, "little", signed=entry.kind in SIGNED)


def _with_node(entry: Entry, node_id: int) -> Value:
    return entry.default + node_id if entry.node_relative and isinstance(entry.default, int) else entry.default
