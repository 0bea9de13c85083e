"""Preallocated rings between the cyclic loop and whoever writes files: samples and frames.

One process appends, another (or the same, in lock-step) drains. The loop never waits for a file: where the reader falls
a whole ring behind, rows are dropped and **counted**, and the count fails the run's quality gate.

Layout of the memory: ``tail`` (i64, rows ever drained), ``dropped`` (i64), padding to 64 bytes, then ``capacity`` rows,
then ``capacity`` check words. One writer per counter; 8 aligned bytes are stored at once, as an element of a memoryview
is (``struct.pack_into`` fills bytes one by one).

Processors other than x86 may show another process a row's bytes in any order, and later than a counter that was written
after them. So no counter says that a row is there: its check word does, the CRC of the row's bytes begun with the row's
number. A reader copies the next row and takes it only if the word fits the copy; a row of the last lap has another
number, and a row that has not arrived as a whole another CRC. Whichever store becomes visible first, the row is taken
when all of it is there, at the next look. The other way round the writer may not write before the reader has copied:
``tail`` is stored after the copy was compared, and no processor stores what hangs on a comparison before it.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Sequence
from multiprocessing import shared_memory
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

SAMPLE_ROW = np.dtype(
    [
        ("t_ns", "<i8"),
        ("position_rad", "<f8"),
        ("velocity_rad_s", "<f8"),
        ("torque_nm", "<f8"),
        ("position_command_rad", "<f8"),
        ("torque_command_nm", "<f8"),
        ("external_torque_nm", "<f8"),
        ("temperature_c", "<f8"),
        ("status", "<u4"),
        ("joint", "<u2"),
        ("error_code", "<u2"),
    ]
)
FRAME_ROW = np.dtype(
    [("t_ns", "<i8"), ("can_id", "<u4"), ("length", "u1"), ("sent", "u1"), ("pad", "<u2"), ("data", "V64")]
)
PACK_SAMPLE = struct.Struct("<q7dIHH")
PACK_FRAME = struct.Struct("<qIBBH64s")

_SHARED = Path("/dev/shm")  # where Linux keeps shared memory by name
_HEADER_BYTES = 64
_WORD = 0xFFFFFFFF
_TAIL, _DROPPED = range(2)

Rows = NDArray[np.void]


class Ring:
    """A single-producer single-consumer ring of fixed-size rows."""

    def __init__(
        self,
        row: np.dtype[Any],
        pack: struct.Struct,  # the compiled form of the same row: it must produce exactly these bytes
        capacity: int,  # rows held
        *,
        shared: bool = False,  # live in shared memory, so that another process can attach by ``name``
        name: str | None = None,  # attach to this existing shared memory instead of creating it
    ) -> None:
        assert row.itemsize == pack.size, f"row of {row.itemsize} bytes, packed {pack.size}"
        checks_at = _HEADER_BYTES + capacity * row.itemsize
        size = checks_at + capacity * 4
        self._own: shared_memory.SharedMemory | None = None
        self._attached: mmap.mmap | None = None
        if name is not None:
            # Not by SharedMemory: it would have the memory removed when the process that attached to it ends.
            with (_SHARED / name).open("r+b") as file:
                self._attached = mmap.mmap(file.fileno(), size)
            whole = memoryview(self._attached)
        elif shared:
            self._own = shared_memory.SharedMemory(create=True, size=size)
            assert self._own.buf is not None, "shared memory is open"
            whole = self._own.buf
        else:
            whole = memoryview(bytearray(size))
        self._buffer: memoryview[int] = whole
        self._pack_into = pack.pack_into
        self._row, self._row_bytes = row, row.itemsize
        self._capacity = capacity
        self._head = 0
        self._checked = shared or name is not None
        self._counters = whole[:_HEADER_BYTES].cast("q")
        self._checks = whole[checks_at:size].cast("I")

    @property
    def name(self) -> str:
        """Name of the shared memory."""
        assert self._own is not None, "this ring is private to its process, or another's"
        return self._own.name

    @property
    def drained(self) -> int:
        """Rows that were ever taken out."""
        return self._counters[_TAIL]

    @property
    def dropped(self) -> int:
        """Rows lost because the reader fell behind."""
        return self._counters[_DROPPED]

    @property
    def half_full(self) -> bool:
        """The reader is far behind; for the process that appends."""
        return 2 * (self._head - self._counters[_TAIL]) > self._capacity

    def append(self, *values: Any) -> None:
        """Pack one row; drops and counts it where the ring is full."""
        head = self._head
        if head - self._counters[_TAIL] >= self._capacity:
            self._counters[_DROPPED] += 1
            return
        slot, size = head % self._capacity, self._row_bytes
        at = _HEADER_BYTES + slot * size
        self._pack_into(self._buffer, at, *values)
        self._head = head + 1
        if self._checked:
            self._checks[slot] = zlib.crc32(self._buffer[at : at + size], self._head & _WORD)

    def drain(self) -> Rows:
        """All rows since the last drain, in order, as a copy."""
        tail = self._counters[_TAIL]
        first = tail % self._capacity
        rows = np.frombuffer(self._buffer, dtype=self._row, count=self._capacity, offset=_HEADER_BYTES)
        if self._checked:
            parts = [self._arrived(rows, first, self._capacity, tail)]
            if parts[0].size == self._capacity - first:
                parts.append(self._arrived(rows, 0, first, tail + parts[0].size))
        else:
            count = self._head - tail
            parts = [rows[first : first + count], rows[: max(0, first + count - self._capacity)]]
        taken = np.concatenate(parts)
        self._counters[_TAIL] = tail + taken.size
        return taken

    def _arrived(self, rows: Rows, first: int, last: int, number: int) -> Rows:
        """A copy of the slots from ``first`` up to ``last``, as far as they hold row ``number`` and those after it."""
        size, count, step = self._row.itemsize, 0, 64
        copies = []
        while first + count < last:
            copy = rows[first + count : min(last, first + count + step)].copy()
            data, words = copy.tobytes(), self._checks[first + count : first + count + copy.size]
            fit = 0
            for word in words:
                if zlib.crc32(data[fit * size : (fit + 1) * size], (number + count + fit + 1) & _WORD) != word:
                    break
                fit += 1
            copies.append(copy[:fit])
            count += fit
            if fit < copy.size:
                break
        return np.concatenate(copies) if copies else rows[:0].copy()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the memory; the creator also removes it. Safe to call twice; leaving a ``with`` does it."""
        own, attached = self._own, self._attached
        self._own = self._attached = None
        if own is None and attached is None:
            return
        self._counters.release()
        self._checks.release()
        self._buffer.release()
        if attached is not None:
            attached.close()
        if own is not None:
            own.close()
            own.unlink()


class FrameRing(Ring):
    """A ring of ``FRAME_ROW``."""

    def extend(self, t_ns: int, frames: Sequence[tuple[int, bytes]], sent: bool) -> None:
        """Pack the frames of one moment (identifier, data), as ``append`` does one."""
        head, count, capacity = self._head, len(frames), self._capacity
        slot, last = head % capacity, head + count
        if slot + count > capacity or last - self._counters[_TAIL] > capacity:
            for can_id, data in frames:
                self.append(t_ns, can_id, len(data), sent, 0, data)
            return
        buffer, pack_into, size = self._buffer, self._pack_into, self._row_bytes
        at = first = _HEADER_BYTES + slot * size
        for can_id, data in frames:
            pack_into(buffer, at, t_ns, can_id, len(data), sent, 0, data)
            at += size
        self._head = last
        if self._checked:
            for number in range(count):
                at = first + number * size
                self._checks[slot + number] = zlib.crc32(buffer[at : at + size], (head + number + 1) & _WORD)


def sample_ring(capacity: int = 1 << 16, *, shared: bool = False, name: str | None = None) -> Ring:
    """A ring of ``SAMPLE_ROW``; the default holds a minute of one joint at 1 kHz."""
    return Ring(SAMPLE_ROW, PACK_SAMPLE, capacity, shared=shared, name=name)


def frame_ring(capacity: int = 1 << 18, *, shared: bool = False, name: str | None = None) -> FrameRing:
    """A ring of ``FRAME_ROW``; the default holds half a minute of a 1 kHz bus."""
    return FrameRing(FRAME_ROW, PACK_FRAME, capacity, shared=shared, name=name)
