"""Vector's BLF, the part of it that bus logs need: frames in compressed containers, times in integer nanoseconds.

Layout, as python-can reads it: a file header of 144 bytes, then log containers, each with a stretch of objects::

    container: LOBJ | header 16, version 1, size, type 10 | method (2 = zlib), uncompressed size | data, padded
    frame:     LOBJ | header 32, version 1, size 48, type 1 | flags 2 (ns), time u64 | channel, flags, dlc, id, 8 bytes
    FD frame:  LOBJ | header 32, version 1, size 120, type 100 | flags 2, time | channel, flags, dlc, id, ..., 64 bytes

The start time in the file header stays zero: times are run time. The counts there are filled in at the end.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from frictid_hil.protocol.driver import FD_FRAME

FILE_HEADER = struct.Struct("<4sLBBBBBBBBQQLL8H8H")
FILE_HEADER_SIZE = 144
OBJECT_HEAD = struct.Struct("<4sHHLL")
CONTAINER_HEAD = struct.Struct("<H6xL4x")
CONTAINER, CAN_FRAME, CAN_FD_FRAME = 10, 1, 100
SENT, REMOTE = 0x01, 0x80
EDL, BRS = 0x1, 0x2

_HEAD: list[tuple[str, str]] = [
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
]
FRAME = np.dtype([*_HEAD, ("data", "u1", 8)])  # A classic CAN frame, 48 bytes; bit 31 of the id says extended

FD_FRAME_OBJECT = np.dtype(  # a CAN FD frame, 120 bytes
    [
        *_HEAD,
        ("frame_ns", "<u4"),
        ("bit_count", "u1"),
        ("fd_flags", "u1"),
        ("length", "u1"),
        ("reserved", "u1", 5),
        ("data", "u1", 64),
    ]
)

_FD_LENGTHS = np.array([*range(9), 12, 16, 20, 24, 32, 48, 64], np.uint8)  # by dlc


def file_header(file_size: int, content_size: int, frames: int) -> bytes:
    """The header of the whole file; zeros for a file that is still being written."""
    head = FILE_HEADER.pack(
        b"LOGG", FILE_HEADER_SIZE, 5, 0, 0, 0, 2, 6, 8, 1, file_size, content_size, frames, 0, *[0] * 16
    )
    return head.ljust(FILE_HEADER_SIZE, b"\0")


def frame_objects(
    t_ns: NDArray[np.int64],
    can_id: NDArray[np.uint32],  # bit 31 set for extended ids, bit 29 (``FD_FRAME``) for CAN FD frames
    length: NDArray[np.uint8],  # bytes used
    sent: NDArray[np.bool_],  # by us
    data: NDArray[np.uint8],  # shape (n, 8 or more)
) -> bytes:
    """Frames as objects, in order; more than 8 bytes make a frame a CAN FD frame. Columns of shape (n,)."""
    fd = ((can_id & FD_FRAME) != 0) | (length > 8)
    classical = _objects(FRAME, CAN_FRAME, t_ns[~fd], can_id[~fd], sent[~fd])
    classical["dlc"] = length[~fd]
    classical["data"] = data[~fd, :8]
    if not fd.any():
        return classical.tobytes()
    long = _objects(FD_FRAME_OBJECT, CAN_FD_FRAME, t_ns[fd], can_id[fd] & ~np.uint32(FD_FRAME), sent[fd])
    long["dlc"] = np.searchsorted(_FD_LENGTHS, length[fd])
    long["length"] = length[fd]
    long["fd_flags"] = EDL | BRS
    long["data"][:, : data.shape[1]] = data[fd]
    ends = np.cumsum(np.where(fd, FD_FRAME_OBJECT.itemsize, FRAME.itemsize))
    content = np.empty(ends[-1], np.uint8)
    for objects, kind in ((classical, ~fd), (long, fd)):
        size = objects.dtype.itemsize
        content[ends[kind, None] - size + np.arange(size)] = objects.view(np.uint8).reshape(-1, size)
    return content.tobytes()


def frames_in(content: bytes) -> tuple[NDArray[np.void], NDArray[np.void], NDArray[np.intp]] | None:
    """Classical frames, CAN FD frames, and the place of each of these in the whole; None where other objects are.

    An object that is cut off ends the content.
    """
    if len(content) % FRAME.itemsize == 0:  # as most logs are: classical frames alone
        every = np.frombuffer(content, FRAME)
        alike = (every["signature"] == b"LOBJ") & (every["type"] == CAN_FRAME) & (every["size"] == FRAME.itemsize)
        if alike.all():
            return every, np.zeros(0, FD_FRAME_OBJECT), np.arange(every.size)
    layouts = {CAN_FRAME: FRAME, CAN_FD_FRAME: FD_FRAME_OBJECT}
    begins: list[tuple[int, int]] = []
    at = 0
    while at + OBJECT_HEAD.size <= len(content):
        signature, _, _, size, kind = OBJECT_HEAD.unpack_from(content, at)
        if signature != b"LOBJ" or kind not in layouts or layouts[kind].itemsize != size:
            return None
        if at + size > len(content):
            break
        begins.append((kind, at))
        at += size
    raw, (kinds, starts) = np.frombuffer(content, np.uint8), np.array(begins, np.intp).reshape(-1, 2).T
    places = [np.flatnonzero(kinds == kind) for kind in layouts]
    classical, long = (
        raw[starts[place, None] + np.arange(layout.itemsize)].view(layout)[:, 0]
        for place, layout in zip(places, layouts.values(), strict=True)
    )
    return classical, long, np.concatenate(places)


def _objects(
    layout: np.dtype[np.void],
    kind: int,
    t_ns: NDArray[np.int64],
    can_id: NDArray[np.uint32],
    sent: NDArray[np.bool_],
) -> NDArray[np.void]:
    objects = np.zeros(t_ns.size, layout)
    objects["signature"] = b"LOBJ"
    objects["header_size"] = 32
    objects["header_version"] = 1
    objects["size"] = layout.itemsize
    objects["type"] = kind
    objects["time_flags"] = 2
    objects["t_ns"] = t_ns
    objects["channel"] = 1
    objects["flags"] = sent
    objects["can_id"] = can_id
    return objects


def container(objects: bytes, *, packed: bool = True) -> bytes:
    """A log container holding some objects."""
    content = zlib.compress(objects, 1) if packed else objects
    size = OBJECT_HEAD.size + CONTAINER_HEAD.size + len(content)
    head = OBJECT_HEAD.pack(b"LOBJ", OBJECT_HEAD.size, 1, size, CONTAINER)
    # Padding of size % 4 rather than to a multiple of 4 is what the format has.
    return head + CONTAINER_HEAD.pack(2 if packed else 0, len(objects)) + content + bytes(size % 4)


def containers(data: bytes, most: int) -> Iterator[tuple[bytes, str]]:
    """The content of each container of a whole file, and what is wrong with it ("" when nothing).

    A container that is cut off, or unpacks to more than it says or than ``most``, gives what can be unpacked of it, and
    ends the file.
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
            content, whole = _unpacked(body, most)
            if cut or not whole:
                yield content, f"the file ends in the middle of a container at byte {at}"
                return
            yield content, ""
        elif cut:
            yield b"", f"the file ends in the middle of an object at byte {at}"
            return
        at += size + size % 4


def _unpacked(body: bytes, most: int) -> tuple[bytes, bool]:
    method, size = CONTAINER_HEAD.unpack_from(body)
    packed = body[CONTAINER_HEAD.size :]
    if method == 0:
        return packed, len(packed) >= size
    unpacker = zlib.decompressobj()
    try:
        # One byte more than it says: a container that holds more than it says is none of a logger's.
        content = unpacker.decompress(packed, max(min(size, most), 1) + 1)
    except zlib.error:
        return b"", False
    return content[:size], len(content) == size


def sound_objects(content: bytes) -> bytes:
    """The content up to the first object that cannot be one (a size of nothing would be read for ever)."""
    at = 0
    while (at := content.find(b"LOBJ", at, at + 8)) >= 0 and at + OBJECT_HEAD.size <= len(content):
        size = OBJECT_HEAD.unpack_from(content, at)[3]
        if size < OBJECT_HEAD.size:
            return content[:at]
        at += size
    return content
