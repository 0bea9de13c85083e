"""What the drive says when something is wrong: error register, history, error code and EMCY frames.

One error is *present* at a time from the host's view (603Fh); 1001h gathers the classes of all present ones, 1003h
remembers the last eight. An EMCY frame goes out when an error appears, and one with code 0000h, its register telling
what is left, when errors are gone.
"""

from __future__ import annotations

from collections.abc import Callable

from frictid_drivers.virtual.object_dictionary import ObjectDictionary
from frictid_drivers.virtual.objects import ERROR_HISTORY, key

OVERSPEED = 0x8400
FOLLOWING_ERROR = 0x8611
POSITION_LIMIT = 0x8612
HEARTBEAT_LOST = 0x8130
SYNC_LOST = 0x8700
PDO_TOO_SHORT = 0x8210
SYNC_LENGTH = 0x8240
CONNECTION_ABORTED = 0x8100

_GENERIC = 0x01


def register_bits(code: int) -> int:
    """The bits of the error register that an error code belongs to (CiA 301, object 1001h)."""
    major = code >> 12
    if code >> 8 in (0x81, 0x82, 0x87):
        return _GENERIC | 0x10
    return _GENERIC | {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0x8: 0x20, 0xF: 0x80}.get(major, 0x20)


class Emergency:
    """Errors of one node."""

    def __init__(self, dictionary: ObjectDictionary, send: Callable[[bytes], None]) -> None:
        self._dictionary = dictionary
        self._send = send
        self.present: tuple[int, ...] = ()  # error codes, oldest first

    def report(self, code: int, detail: int = 0) -> None:
        """An error appears; said once while it stays."""
        if code in self.present:
            return
        self.present += (code,)
        values = self._dictionary.values
        count = min(self._dictionary.number(key(0x1003)) + 1, ERROR_HISTORY)
        for sub in range(count, 1, -1):
            values[key(0x1003, sub)] = values[key(0x1003, sub - 1)]
        values[key(0x1003, 1)] = (detail & 0xFFFF) << 16 | code
        values[key(0x1003)] = count
        self._publish(code, detail)

    def clear(self, code: int) -> None:
        """One error is gone."""
        if code in self.present:
            self.present = tuple(other for other in self.present if other != code)
            self._publish(0, 0)

    def _publish(self, code: int, detail: int) -> None:
        register = 0
        for present in self.present:
            register |= register_bits(present)
        self._dictionary.values[key(0x1001)] = register
        self._dictionary.values[key(0x603F)] = self.present[-1] if self.present else 0
        self._send(code.to_bytes(2, "little") + bytes([register]) + (detail & 0xFFFF).to_bytes(2, "little") + bytes(3))
