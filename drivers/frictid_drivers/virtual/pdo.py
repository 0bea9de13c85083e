"""Process data: which objects travel in which frame, and when (CiA 301, 7.2.2).

The communication and mapping parameters live in the object dictionary and are written by SDO; this file guards that
protocol (make the PDO invalid, set the count to zero, write the entries, set the count, make it valid again), compiles
a valid PDO to one ``struct`` and keeps the counters and timers that decide when it is sent.

With 2023h a drive's PDOs are CAN FD frames of up to 64 bytes, padded to the next length that there is; their COB-IDs
then carry ``FD_FRAME``. It neither sends nor hears PDOs of the other kind.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

from frictid_drivers.virtual.object_dictionary import Abort, ObjectDictionary, SdoAbort
from frictid_drivers.virtual.objects import (
    DUMMIES,
    MAX_MAPPED,
    PDO_COUNT,
    PDO_NO_RTR,
    PDO_NOT_VALID,
    SIZE_BYTES,
    Key,
    key,
)
from frictid_hil.protocol.driver import FD_FRAME

_CODES = dict(zip(SIZE_BYTES, "bhiBHI", strict=True))  # of ``struct``, by data type
_EXTENDED = 1 << 29
_RESTRICTED = ((0x000, 0x080), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x7FF))
"""First and last COB-ID of what CiA 301 does not leave to PDOs."""
_WAITING_FOR_START = -1
_SYNC_MAX = 240
_MS = 1_000_000
_FD_LENGTHS = (12, 16, 20, 24, 32, 48, 64)  # of CAN FD frames above 8 bytes
NEVER_NS = 1 << 62
LIVE = frozenset(key(index) for index in (0x2030, 0x6062, 0x6064, 0x606C, 0x6074, 0x6077, 0x60F4))
"""Actual values: what changes by itself from moment to moment."""


@dataclass(slots=True)
class ReceivePdo:
    """A valid RPDO, compiled; dummies have key 0."""

    cob_id: int  # with ``FD_FRAME`` where it is one
    on_sync: bool  # values count from the next SYNC on; else at once
    keys: tuple[Key, ...]
    layout: struct.Struct
    pending: bytes | None = None  # the latest frame, not yet applied


@dataclass(slots=True)
class TransmitPdo:
    """A valid TPDO, compiled."""

    cob_id: int  # with ``FD_FRAME`` where it is one
    kind: int
    keys: tuple[Key, ...]
    layout: struct.Struct
    start: int  # SYNC counter value that counts as the first, 0 for any
    inhibit_ns: int  # least time between two event-driven frames
    event_ns: int  # longest time between two event-driven frames, 0 for none
    rtr: bool  # answers remote frames
    countdown: int = 0  # SYNCs until it is sent; -1 while waiting for ``start``
    last: bytes | None = None  # what was sent last
    quiet_until_ns: int = 0  # end of the inhibit time
    timer_ns: int = NEVER_NS  # when the event timer sends it

    def pack(self, values: dict[Key, int]) -> bytes:
        """The frame's data now."""
        return self.layout.pack(*[values[k] for k in self.keys])


class ProcessData:
    """All PDOs of one node; ``changed`` is called after a parameter was written."""

    def __init__(
        self, dictionary: ObjectDictionary, send: Callable[[int, bytes], None], changed: Callable[[], None]
    ) -> None:
        self._dictionary = dictionary
        # Mapped objects are numbers; the strings among the values are never looked up here.
        self._values = cast("dict[Key, int]", dictionary.values)
        self._send = send
        self._changed = changed
        self.receive: list[ReceivePdo] = []  # valid ones
        self._cyclic: list[TransmitPdo] = []
        self._event: list[TransmitPdo] = []
        self._running = False
        self.pending = False  # some RPDO waits for SYNC
        self.event_driven = False  # some TPDO is sent on change or by timer
        self.live = False  # some of those carries an actual value, which changes all the time
        self.acyclic = False  # some TPDO is sent at the next SYNC after a change (type 0)
        self.next_timer_ns = NEVER_NS  # when ``send_events`` has something to send by itself
        for number in range(PDO_COUNT):
            self._guard(0x1400 + number, 0x1600 + number, receive=True)
            self._guard(0x1800 + number, 0x1A00 + number, receive=False)

    def start(self, now_ns: int) -> None:
        """Entering NMT operational: counters restart, event-driven PDOs announce themselves."""
        self._running = True
        self.recompile(now_ns)
        for pdo in self._event:
            if pdo.kind >= 254:
                self._transmit(pdo, now_ns)
        self.send_events(now_ns)

    def stop(self) -> None:
        """Leaving NMT operational."""
        self._running = False
        self.pending = False
        self.next_timer_ns = NEVER_NS
        for pdo in self.receive:
            pdo.pending = None

    def recompile(self, now_ns: int) -> None:
        """Read the parameters anew; counters and timers of all PDOs restart."""
        number = self._dictionary.number
        self.receive, self._cyclic, self._event = [], [], []
        counted = number(key(0x1019)) > 1
        longest = self._longest
        frame = FD_FRAME if longest > 8 else 0
        for i in range(PDO_COUNT):
            cob_id = number(key(0x1400 + i, 1))
            keys, layout = self._mapping(0x1600 + i)
            if not cob_id & PDO_NOT_VALID and 0x1400 + i in self._dictionary.indices and layout.size <= longest:
                on_sync = number(key(0x1400 + i, 2)) <= _SYNC_MAX
                self.receive.append(ReceivePdo(cob_id & 0x7FF | frame, on_sync, keys, layout))
        for i in range(PDO_COUNT):
            com = 0x1800 + i
            cob_id = number(key(com, 1))
            keys, layout = self._mapping(0x1A00 + i)
            if cob_id & PDO_NOT_VALID or com not in self._dictionary.indices or layout.size > longest:
                continue
            padding = next((length for length in _FD_LENGTHS if length >= layout.size), 8) - layout.size
            if layout.size > 8 and padding:
                layout = struct.Struct(f"{layout.format}{padding}x")
            kind = number(key(com, 2))
            pdo = TransmitPdo(
                cob_id & 0x7FF | frame, kind, keys, layout,
                start=number(key(com, 6)) if counted else 0,
                inhibit_ns=number(key(com, 3)) * 100_000,
                event_ns=number(key(com, 5)) * _MS if kind >= 254 else 0,
                rtr=not cob_id & PDO_NO_RTR,
            )  # fmt: skip
            pdo.countdown = _WAITING_FOR_START if pdo.start else kind
            if pdo.event_ns:
                pdo.timer_ns = now_ns + pdo.event_ns
            (self._cyclic if 1 <= kind <= _SYNC_MAX else self._event).append(pdo)
        self.pending = False
        self.event_driven = any(pdo.kind >= 254 for pdo in self._event)
        self.acyclic = any(pdo.kind == 0 for pdo in self._event)
        self.live = any(pdo.kind >= 254 and LIVE.intersection(pdo.keys) for pdo in self._event)
        self.next_timer_ns = NEVER_NS

    @property
    def _longest(self) -> int:
        """Bytes of a PDO."""
        return 64 if self._dictionary.number(key(0x2023)) == 1 else 8

    def _mapping(self, index: int) -> tuple[tuple[Key, ...], struct.Struct]:
        keys: list[Key] = []
        codes = "<"
        for sub in range(1, self._dictionary.number(key(index)) + 1):
            entry = self._dictionary.number(key(index, sub))
            dummy = DUMMIES.get(entry >> 16)
            codes += _CODES[dummy or self._dictionary.entries[entry >> 8].kind]
            keys.append(0 if dummy else entry >> 8)
        return tuple(keys), struct.Struct(codes)

    def due_on_sync(self, counter: int | None) -> list[TransmitPdo]:
        """Count one SYNC; the cyclic TPDOs to send now."""
        due = []
        for pdo in self._cyclic:
            if pdo.countdown == _WAITING_FOR_START:
                now = counter == pdo.start
            else:
                pdo.countdown -= 1
                now = pdo.countdown <= 0
            if now:
                pdo.countdown = pdo.kind
                due.append(pdo)
        return due

    def send_due(self, due: list[TransmitPdo]) -> None:
        """Send cyclic TPDOs with the values of this moment."""
        for pdo in due:
            self._send(pdo.cob_id, pdo.pack(self._values))

    def send_acyclic(self, now_ns: int) -> None:
        """At SYNC: TPDOs of type 0 whose values changed."""
        for pdo in self._event:
            if pdo.kind == 0 and pdo.pack(self._values) != pdo.last:
                self._transmit(pdo, now_ns)

    def send_events(self, now_ns: int) -> None:
        """Send the event-driven TPDOs that changed, as far as their inhibit time lets them, or whose timer ran out."""
        if not self._running:
            return
        due_ns = NEVER_NS
        for pdo in self._event:
            if pdo.kind < 254:
                continue
            changed = pdo.pack(self._values) != pdo.last
            if now_ns >= pdo.timer_ns or (changed and now_ns >= pdo.quiet_until_ns):
                self._transmit(pdo, now_ns)
            elif changed:
                due_ns = min(due_ns, pdo.quiet_until_ns)
            due_ns = min(due_ns, pdo.timer_ns)
        self.next_timer_ns = due_ns

    def answer_remote(self, cob_id: int, now_ns: int) -> None:
        """A remote frame asks for a TPDO."""
        if self._running:
            for pdo in self._cyclic + self._event:
                if pdo.rtr and pdo.cob_id == cob_id:
                    self._transmit(pdo, now_ns)

    def apply(self, pdo: ReceivePdo, data: bytes) -> None:
        """Take over the values of one RPDO."""
        values = self._values
        for address, value in zip(pdo.keys, pdo.layout.unpack_from(data), strict=True):
            values[address] = value

    def apply_pending(self) -> None:
        """At SYNC: take over what came before it."""
        self.pending = False
        for pdo in self.receive:
            if pdo.pending is not None:
                self.apply(pdo, pdo.pending)
                pdo.pending = None

    def _transmit(self, pdo: TransmitPdo, now_ns: int) -> None:
        pdo.last = pdo.pack(self._values)
        pdo.quiet_until_ns = now_ns + pdo.inhibit_ns
        if pdo.event_ns:
            pdo.timer_ns = now_ns + pdo.event_ns
        self._send(pdo.cob_id, pdo.last)

    def _guard(self, com: int, mapping: int, *, receive: bool) -> None:
        guards, effects = self._dictionary.guards, self._dictionary.effects
        number = self._dictionary.number

        def valid() -> bool:
            return not number(key(com, 1)) & PDO_NOT_VALID

        def cob_id(value: int) -> None:
            taken = any(first <= value & 0x7FF <= last for first, last in _RESTRICTED)
            if value & _EXTENDED or value & 0x1FFFF800 or taken:
                raise SdoAbort(Abort.INVALID_VALUE)
            if valid() and not value & PDO_NOT_VALID and (value ^ number(key(com, 1))) & 0x7FF:
                raise SdoAbort(Abort.DEVICE_STATE)

        def transmission_type(value: int) -> None:
            if _SYNC_MAX < value < 254 or value not in (self._dictionary.manner.transmission_types or (value,)):
                raise SdoAbort(Abort.INVALID_VALUE)

        def while_invalid(value: int) -> None:
            if valid():
                raise SdoAbort(Abort.DEVICE_STATE)

        def count(value: int) -> None:
            while_invalid(value)
            words = [number(key(mapping, sub)) for sub in range(1, value + 1)]
            for word in words:
                mapped(word)
            if sum(word & 0xFF for word in words) > 8 * self._longest:
                raise SdoAbort(Abort.MAPPING_TOO_LONG)

        def entry(value: int) -> None:
            while_invalid(value)
            if number(key(mapping)):
                raise SdoAbort(Abort.DEVICE_STATE)
            if value:
                mapped(value)

        def mapped(value: int) -> None:
            kind = DUMMIES.get(value >> 16)
            if value == 0:
                raise SdoAbort(Abort.NO_OBJECT)
            if kind is None:
                found = self._dictionary.entry(value >> 8)
                kind = found.kind
                if not (found.receive if receive else found.transmit):
                    raise SdoAbort(Abort.NOT_MAPPABLE)
            elif not receive or value >> 8 & 0xFF:
                raise SdoAbort(Abort.NOT_MAPPABLE)
            if value & 0xFF != 8 * SIZE_BYTES[kind]:
                raise SdoAbort(Abort.INCOMPATIBLE)

        guards[key(com, 1)] = cob_id
        guards[key(com, 2)] = transmission_type
        if not receive:
            guards[key(com, 3)] = guards[key(com, 6)] = while_invalid
        guards[key(mapping)] = count
        for sub in range(1, MAX_MAPPED + 1):
            guards[key(mapping, sub)] = entry
        for address in (*(key(com, sub) for sub in (1, 2, 3, 5, 6)), key(mapping)):
            effects[address] = self._changed
