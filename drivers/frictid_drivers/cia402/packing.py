"""Integers into the bytes of a PDO and back, by the layout that a drive's own mapping says.

Entries follow each other without gaps, least significant bit first. Layouts of whole 8, 16, 32 or 64-bit entries (all
that drives use in practice) compile to ``struct``; anything else is cut out bit by bit. Both have the same three
members, so that the cycle does not care which it got.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Protocol

from frictid_drivers.cia402.objects import IntegerType


class Packing(Protocol):
    """Bytes of one PDO to integers and back."""

    @property
    def size(self) -> int:
        """Bytes of the PDO."""
        ...

    def pack_into(self, buffer: bytearray, offset: int, /, *values: int) -> None:
        """Write all values; ``struct.error`` when one does not fit its type."""
        ...

    def unpack_from(self, buffer: bytes | bytearray, /) -> tuple[int, ...]:
        """Read all values from the first ``size`` bytes; ``struct.error`` when there are fewer."""
        ...


def packing(types: Sequence[IntegerType]) -> Packing:
    """Compile a layout."""
    codes = [kind.code for kind in types]
    if None in codes:
        return _BitPacking(types)
    return struct.Struct("<" + "".join(code for code in codes if code))


class _BitPacking:
    """The general case: entries of 1 to 64 bits at any bit."""

    def __init__(self, types: Sequence[IntegerType]) -> None:
        self._types = tuple(types)
        self.size = (sum(kind.bits for kind in self._types) + 7) // 8

    def pack_into(self, buffer: bytearray, offset: int, /, *values: int) -> None:
        word = shift = 0
        for kind, value in zip(self._types, values, strict=True):
            if not kind.low <= value <= kind.high:
                raise struct.error(f"{value} does not fit {kind}")
            word |= (value & ((1 << kind.bits) - 1)) << shift
            shift += kind.bits
        buffer[offset : offset + self.size] = word.to_bytes(self.size, "little")

    def unpack_from(self, buffer: bytes | bytearray, /) -> tuple[int, ...]:
        if len(buffer) < self.size:
            raise struct.error(f"{len(buffer)} bytes for a PDO of {self.size}")
        word = int.from_bytes(buffer[: self.size], "little")
        values = []
        for kind in self._types:
            value = word & ((1 << kind.bits) - 1)
            word >>= kind.bits
            values.append(value - (1 << kind.bits) if value > kind.high else value)
        return tuple(values)
