"""MATLAB files: every numeric vector or matrix column is a column, every scalar a constant, ``struct.field`` a field.

A file of version 5 (``save -v6`` and ``-v7``) is a header of 128 bytes and a row of elements, each with a tag of type
and size; a matrix is an element made of elements: flags, dimensions, name, values. Every size is checked against what
is there (scipy's reader was seen to crash the interpreter on a spoilt file). Version 7.3 is HDF5 inside.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from frictid_hil.errors import InputFileError
from frictid_hil.friction.trajectory import Array
from frictid_hil.recording.array_files import open_hdf5
from frictid_hil.recording.arrays import ArrayTable
from frictid_hil.recording.bounds import allowed_bytes

HEADER_SIZE = 128
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_STRUCT, _FIRST_NUMERIC, _LAST_NUMERIC = 2, 6, 15
_COMPLEX = 0x0800


def open_mat(path: Path) -> ArrayTable:
    """The numeric variables of a ``.mat`` file; ``InputFileError`` where unreadable, or larger than it may be."""
    try:
        data = path.read_bytes()
    except (OSError, MemoryError) as error:
        raise InputFileError(f"cannot be read: {error}", where=str(path)) from None
    if data.startswith(b"MATLAB 7.3"):
        return open_hdf5(path)
    try:
        values = read_numbers(data)
    except (SpoiltMatFile, MemoryError) as error:
        raise InputFileError(
            f"not a readable MATLAB file: {error}",
            where=str(path),
            cause="truncated or spoilt, or older than version 5",
        ) from None
    return ArrayTable.of(path, values)


class SpoiltMatFile(ValueError):
    """The file does not hold what its tags say."""


def read_numbers(data: bytes) -> dict[str, Array]:
    """All real numeric variables of a whole file by name, of the type in which they stand there.

    Arrays have two or more dimensions; fields of a struct of one element are ``struct.field``. What is no such file,
    cut off or spoilt, is a ``SpoiltMatFile``.
    """
    if len(data) < HEADER_SIZE or data[126:128] not in (b"IM", b"MI"):
        raise SpoiltMatFile("no MATLAB 5 header")
    order = "<" if data[126:128] == b"IM" else ">"
    values: dict[str, Array] = {}
    left = allowed_bytes(len(data))
    for kind, content in _elements(memoryview(data)[HEADER_SIZE:], order):
        if kind == _COMPRESSED:
            unpacked = _unpacked(content, left)
            left -= len(unpacked)
            ((kind, content),) = list(_elements(unpacked, order))[:1] or [(0, memoryview(b""))]
        if kind == _MATRIX:
            values.update(_matrix(content, order))
    return values


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Type and content of each element in a row of them."""
    at = 0
    while at < len(data):
        if len(data) - at < 8:
            if not any(data[at:]):
                return  # padding
            raise SpoiltMatFile("the file ends in the middle of a tag")
        kind, size = struct.unpack_from(order + "II", data, at)
        if kind >> 16:  # four bytes or fewer, packed into the tag
            kind, size = kind & 0xFFFF, kind >> 16
            if size > 4:
                raise SpoiltMatFile(f"a small element of {size} bytes")
            yield kind, data[at + 4 : at + 4 + size]
            at += 8
            continue
        start, end = at + 8, at + 8 + size
        if end > len(data):
            raise SpoiltMatFile(f"an element of {size} bytes where {len(data) - start} are left")
        yield kind, data[start:end]
        at = end if kind == _COMPRESSED else end + -size % 8


def _unpacked(packed: memoryview, most: int) -> memoryview:
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(packed, max(most, 1))
    except zlib.error as error:
        raise SpoiltMatFile(f"a compressed variable: {error}") from None
    if not unpacker.eof and len(content) >= most:
        raise SpoiltMatFile(f"it unpacks to more than {most:,} bytes, 100 times its size or 2 GB")
    if not unpacker.eof:
        raise SpoiltMatFile("a compressed variable is cut off")
    return memoryview(content)


def _matrix(content: memoryview, order: str, name: str = "", *, inside: bool = False) -> dict[str, Array]:
    """A variable by its name; nothing for kinds that hold no real numbers (text, cells, objects, sparse)."""
    parts = list(_elements(content, order))
    if len(parts) < 3 or len(parts[0][1]) != 8:
        return {}
    (flags, _) = struct.unpack(order + "II", parts[0][1])
    kind = flags & 0xFF
    shape = tuple(int(n) for n in _numbers(*parts[1], order))
    name = name or bytes(parts[2][1]).decode("utf-8", errors="replace")
    if kind == _STRUCT and not inside and math.prod(shape) == 1:
        return _fields(parts[3:], order, name)
    if not _FIRST_NUMERIC <= kind <= _LAST_NUMERIC or flags & _COMPLEX or len(parts) < 4:
        return {}
    values = _numbers(*parts[3], order)
    if len(shape) < 2 or min(shape) < 0 or math.prod(shape) != values.size:
        raise SpoiltMatFile(f"variable {name}: {values.size} values for the shape {shape}")
    return {name: values.reshape(shape, order="F")}


def _fields(parts: list[tuple[int, memoryview]], order: str, name: str) -> dict[str, Array]:
    if len(parts) < 2:
        return {}
    (width,) = _numbers(*parts[0], order)[:1].tolist() or [0]
    text = bytes(parts[1][1])
    if not 0 < width <= len(text):
        return {}
    names = [text[at : at + width].split(b"\0")[0].decode("utf-8", "replace") for at in range(0, len(text), width)]
    values: dict[str, Array] = {}
    for field, (kind, content) in zip(names, parts[2:], strict=False):
        if kind == _MATRIX:
            values.update(_matrix(content, order, f"{name}.{field}", inside=True))
    return values


def _numbers(kind: int, content: memoryview, order: str) -> Array:
    if kind not in _NUMBERS:
        raise SpoiltMatFile(f"numbers of an unknown type {kind}")
    dtype = np.dtype(order + _NUMBERS[kind])
    if len(content) % dtype.itemsize:
        raise SpoiltMatFile(f"{len(content)} bytes are no whole number of {dtype.name}")
    return np.frombuffer(content, dtype)
