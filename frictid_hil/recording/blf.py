"""Vector's BLF, the part of it that bus logs need: frames in compressed containers, times in integer nanoseconds.

Layout, as python-can reads it: a file header of 144 bytes, then log containers, each with a stretch of objects::

    container: LOBJ | header 16, version 1, size, type 10 | method (2 = zlib), uncompressed size | data, padded
    frame:     LOBJ | header 32, version 1, size 48, type 1 | flags 2 (ns), time u64 | channel, flags, dlc, id, 8 bytes

The start time in the file header stays zero, so a time read back is the run time written, to the nanosecond; the
counts in the header are filled in at the end, and a file that was never closed is read by their absence.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

FILE_HEADER = struct.Struct("<4sLBBBBBBBBQQLL8H8H")
FILE_HEADER_SIZE = 144
OBJECT_HEAD = struct.Struct("<4sHHLL")
CONTAINER_HEAD = struct.Struct("<H6xL4x")
CONTAINER, CAN_FRAME, CAN_FD_FRAME = 10, 1, 100
SENT, EDL, REMOTE = 0x01, 0x1, 0x80

FRAME = np.dtype(
    [
        ("signature", "S4"),
        ("header_size", "<u2"),
        ("header_version", "<u2"),
        ("size", "<u4"),
        ("type", "<u4"),
        ("time_flags", "<u4"),
        ("client", "<u2"),
        ("version", "<u2"),
        ("t_ns", "<u8"),
        ("channel", "<u2"),
        ("flags", "u1"),
        ("dlc", "u1"),
        ("can_id", "<u4"),
        ("data", "u1", 8),
    ]
)
"""A classic CAN frame, 48 bytes; bit 31 of the id says extended."""

_FD_BODY = struct.Struct("<LHHQHBBLLBBB5x64s")
_FD_SIZE = OBJECT_HEAD.size + _FD_BODY.size
_DLC_OF_LENGTH = {12: 9, 16: 10, 20: 11, 24: 12, 32: 13, 48: 14, 64: 15}


def file_header(file_size: int, content_size: int, frames: int) -> bytes:
    """The header of the whole file; zeros for a file that is still being written."""
    head = FILE_HEADER.pack(
        b"LOGG", FILE_HEADER_SIZE, 5, 0, 0, 0, 2, 6, 8, 1, file_size, content_size, frames, 0, *[0] * 16
    )
    return head.ljust(FILE_HEADER_SIZE, b"\0")


def frame_objects(
    t_ns: NDArray[np.int64],
    can_id: NDArray[np.uint32],
    length: NDArray[np.uint8],
    sent: NDArray[np.bool_],
    data: NDArray[np.uint8],
) -> bytes:
    """Frames as objects, in order; more than 8 bytes make a frame a CAN FD frame.

    Args:
        t_ns: run time, shape (n,).
        can_id: bit 31 set for extended ids, shape (n,).
        length: bytes used, shape (n,).
        sent: by us, shape (n,).
        data: shape (n, 8 or more).
    """
    if length.max(initial=0) > 8:
        every = zip(t_ns.tolist(), can_id.tolist(), length.tolist(), sent.tolist(), data, strict=True)
        return b"".join(_fd_object(*one) for one in every)
    objects = np.zeros(t_ns.size, FRAME)
    objects["signature"] = b"LOBJ"
    objects["header_size"] = 32
    objects["header_version"] = 1
    objects["size"] = FRAME.itemsize
    objects["type"] = CAN_FRAME
    objects["time_flags"] = 2
    objects["t_ns"] = t_ns
    objects["channel"] = 1
    objects["flags"] = sent
    objects["dlc"] = length
    objects["can_id"] = can_id
    objects["data"] = data[:, :8]
    return objects.tobytes()


def container(objects: bytes) -> bytes:
    """A log container holding some objects."""
    packed = zlib.compress(objects, 1)
    size = OBJECT_HEAD.size + CONTAINER_HEAD.size + len(packed)
    head = OBJECT_HEAD.pack(b"LOBJ", OBJECT_HEAD.size, 1, size, CONTAINER)
    # Padding of size % 4 rather than to a multiple of 4 is what the format has.
    return head + CONTAINER_HEAD.pack(2, len(objects)) + packed + bytes(size % 4)


def containers(data: bytes) -> Iterator[tuple[bytes, str]]:
    """The content of each container of a file, and what is wrong with it ("" when nothing).

    A container that is cut off gives what can be unpacked of it, and ends the file.
    """
    at = FILE_HEADER.unpack_from(data)[1]
    while at < len(data):
        if len(data) - at < OBJECT_HEAD.size:
            yield b"", f"the file ends in the head of a container at byte {at}"
            return
        signature, _, _, size, kind = OBJECT_HEAD.unpack_from(data, at)
        if signature != b"LOBJ" or size < OBJECT_HEAD.size:
            yield b"", f"no object where one should be, at byte {at}"
            return
        body = data[at + OBJECT_HEAD.size : at + size]
        cut = at + size > len(data)
        if kind == CONTAINER and len(body) >= CONTAINER_HEAD.size:
            content, whole = _unpacked(body)
            if cut or not whole:
                yield content, f"the file ends in the middle of a container at byte {at}"
                return
            yield content, ""
        elif cut:
            yield b"", f"the file ends in the middle of an object at byte {at}"
            return
        at += size + size % 4


def _unpacked(body: bytes) -> tuple[bytes, bool]:
    method, size = CONTAINER_HEAD.unpack_from(body)
    packed = body[CONTAINER_HEAD.size :]
    if method == 0:
        return packed, len(packed) >= size
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(packed, max(size, 1))
    except zlib.error:
        return b"", False
    return content, len(content) == size


def _fd_object(t_ns: int, can_id: int, length: int, sent: bool, data: NDArray[np.uint8]) -> bytes:
    flags = SENT if sent else 0
    if length <= 8:
        head = OBJECT_HEAD.pack(b"LOBJ", 32, 1, FRAME.itemsize, CAN_FRAME)
        return head + struct.pack("<LHHQHBBL8s", 2, 0, 0, t_ns, 1, flags, length, can_id, data[:8].tobytes())
    head = OBJECT_HEAD.pack(b"LOBJ", 32, 1, _FD_SIZE, CAN_FD_FRAME)
    dlc = _DLC_OF_LENGTH[length]
    return head + _FD_BODY.pack(2, 0, 0, t_ns, 1, flags, dlc, can_id, 0, 0, EDL, length, data[:64].tobytes())
