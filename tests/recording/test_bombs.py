"""Small files that would unpack to gigabytes, or that a reader would read for ever: refused, or read up to there."""

import contextlib
import gzip
import struct
import tracemalloc
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import zstandard

from frictid_hil.errors import InputFileError
from frictid_hil.recording import blf
from frictid_hil.recording.bus_log import read_frames
from frictid_hil.recording.read import read

FRAME = blf.frame_objects(
    np.array([1000], np.int64), np.array([0x181], np.uint32), np.array([8], np.uint8), np.zeros(1, bool),
    np.zeros((1, 8), np.uint8),
)  # fmt: skip


def packed(piece: bytes, times: int, head: bytes = b"") -> bytes:
    """gzip of a head and a piece that comes again and again, without ever having it unpacked."""
    packer = zlib.compressobj(9, wbits=31)
    return packer.compress(head) + b"".join(packer.compress(piece) for _ in range(times)) + packer.flush()


def blank_lines(path: Path) -> Path:
    path = path / "blank.csv.gz"
    path.write_bytes(packed(b"\n" * 1_000_000, 100))
    return path


def rows(path: Path) -> Path:
    path = path / "rows.csv.gz"
    path.write_bytes(packed(b"0.001,0.0,1.0\n" * 70_000, 70, b"time_s,position_rad,torque_nm\n"))
    return path


def text_log(path: Path) -> Path:
    path = path / "log.asc.gz"
    head = b"date Mon Jan 1 00:00:00 2024\nbase hex timestamps absolute\n"
    path.write_bytes(packed(b"   0.001000 1 181 Rx d 8 00 00 00 00 00 00 00 00\n" * 20_000, 20, head))
    return path


def container_that_lies(path: Path) -> Path:
    path = path / "lie.blf"
    data = zlib.compress(bytes(200_000_000), 9)
    size = blf.OBJECT_HEAD.size + blf.CONTAINER_HEAD.size + len(data)
    head = blf.OBJECT_HEAD.pack(b"LOBJ", 16, 1, size, blf.CONTAINER) + blf.CONTAINER_HEAD.pack(2, 100)
    path.write_bytes(blf.file_header(0, 0, 0) + head + data + bytes(size % 4))
    return path


def container_that_is_large(path: Path) -> Path:
    path = path / "large.blf"
    path.write_bytes(blf.file_header(0, 0, 0) + blf.container(bytes(90_000_000)))
    return path


def objects_of_no_size(path: Path) -> Path:
    path = path / "zero.blf"
    nothing = blf.OBJECT_HEAD.pack(b"LOBJ", 32, 1, 0, 115) + bytes(32)
    path.write_bytes(blf.file_header(0, 0, 0) + blf.container(nothing * 20))
    return path


def chunk_that_lies(path: Path) -> Path:
    path = path / "lie.mcap"
    data = zstandard.ZstdCompressor(level=3).compress(bytes(200_000_000))
    body = struct.pack("<QQQII", 0, 0, 100, 0, 4) + b"zstd" + struct.pack("<Q", len(data)) + data
    header = struct.pack("<I", 0) + struct.pack("<I", 1) + b"x"
    records = (struct.pack("<BQ", kind, len(data)) + data for kind, data in ((1, header), (6, body)))
    path.write_bytes(b"\x89MCAP0\r\n" + b"".join(records))
    return path


def matrix(path: Path) -> Path:
    path = path / "zeros.mat"
    data = zlib.compress(struct.pack("<II", 14, 80_000_000) + bytes(80_000_000), 1)
    head = b"MATLAB 5.0".ljust(116) + bytes(8) + b"\0\x01IM"
    path.write_bytes(head + struct.pack("<II", 15, len(data)) + data)
    return path


@contextlib.contextmanager
def refused(path: Path, words: str) -> Iterator[None]:
    """By its bound, before it takes memory, and not for what it then turns out to hold."""
    assert path.stat().st_size < 1_000_000
    tracemalloc.start()
    try:
        with pytest.raises(InputFileError, match=words):
            yield
        assert tracemalloc.get_traced_memory()[1] < 150_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.slow
@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    ("made", "words"),
    [
        (blank_lines, "no header within"), (rows, "that unpack to"), (chunk_that_lies, "that unpack to"),
        (matrix, "unpacks to more than"),
    ],
)  # fmt: skip
def test_recordings_that_unpack_to_too_much_are_refused(
    made: Callable[[Path], Path], words: str, tmp_path: Path
) -> None:
    path = made(tmp_path)
    with refused(path, words):
        read(path)


@pytest.mark.slow
@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    ("made", "words"),
    [
        (text_log, "unpack to more than"), (container_that_lies, "holds no frames"),
        (container_that_is_large, "that unpack to"), (objects_of_no_size, "holds no frames"),
    ],
)  # fmt: skip
def test_bus_logs_that_unpack_to_too_much_are_refused(made: Callable[[Path], Path], words: str, tmp_path: Path) -> None:
    path = made(tmp_path)
    with refused(path, words):
        read_frames(path)


def test_a_log_is_read_up_to_the_object_that_cannot_be_one(tmp_path: Path) -> None:
    path = tmp_path / "half.blf"
    nothing = blf.OBJECT_HEAD.pack(b"LOBJ", 32, 1, 0, 115) + bytes(32)
    other = blf.OBJECT_HEAD.pack(b"LOBJ", 32, 1, 48, 115) + bytes(32)
    path.write_bytes(blf.file_header(0, 0, 0) + blf.container(FRAME + other + FRAME + nothing + FRAME))
    frames = read_frames(path)
    assert len(frames) == 2 and "no object where one should be" in frames.damage


def test_an_ordinary_packed_log_is_read(tmp_path: Path) -> None:
    path = tmp_path / "log.log.gz"
    rng = np.random.default_rng(1)
    lines = [f"({n * 1e-3:.6f}) can0 181#{rng.bytes(8).hex()}\n" for n in range(2000)]
    path.write_bytes(gzip.compress("".join(lines).encode()))
    assert len(read_frames(path)) == 2000
