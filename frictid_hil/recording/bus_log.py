"""Every frame on the wire, to a file and back: what a run can be replayed from, bit for bit.

Written is BLF, in small containers that are synced as they come: it keeps nanoseconds, and a killed file is readable up
to its last flush. Read is whatever python-can reads. A log is also a python-can bus of its own (``LogBus``): nothing
answers on it, and what is sent to it only reaches those who share the ``echo`` bus.
"""

from __future__ import annotations

import gzip
import io
import time
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import can
import numpy as np
from numpy.typing import NDArray

from frictid_hil.errors import InputFileError
from frictid_hil.protocol.driver import EXTENDED, FD_FRAME
from frictid_hil.recording import blf
from frictid_hil.recording.bounds import allowed_bytes, check_expansion
from frictid_hil.recording.growing_file import GrowingLog

LOG_SUFFIXES = (".blf", ".asc", ".log", ".trc", ".db", ".mf4")
LONGEST = 64  # bytes of a CAN FD frame at most; what a damaged log holds beyond is no frame
MOST_TEXT_RATIO = 40
_LEAST_TEXT_BYTES = 1_000_000
_FRAMES_PER_CONTAINER = 2048
_EPOCH_S = 1e8  # times beyond this (three years) are of a wall clock, not run time


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """The frames of a log, in the order of the file."""

    t_ns: NDArray[np.int64]  # run time (since the start of the log, where it tells the time of day), shape (n,)
    # Bit 31 set for extended ids, bit 29 (``driver.FD_FRAME``) for CAN FD frames, shape (n,).
    can_id: NDArray[np.uint32]
    length: NDArray[np.uint8]
    data: NDArray[np.uint8]  # shape (n, 8), or (n, 64) where a frame is a CAN FD one
    sent: NDArray[np.bool_]  # by the host; False throughout where the format does not tell, shape (n,)
    skipped: int = 0  # error and remote frames, which carry no data, and what no wire can carry
    damage: str = ""  # where the log ends before its end ("" for a whole one)

    def __len__(self) -> int:
        return int(self.t_ns.size)


class BusLogWriter(GrowingLog):
    """Writes frames to a new BLF file, in place of an existing one; raises as ``GrowingFile``."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._pending: list[bytes] = []
        self._single: list[tuple[int, int, bytes, bool]] = []
        self._frames = 0
        self._content_size = blf.FILE_HEADER_SIZE
        self._file.write(blf.file_header(0, 0, 0))

    def frame(self, t_ns: int, can_id: int, data: bytes, sent: bool) -> None:
        """Take one frame; a ``driver.FrameSink``."""
        self._single.append((t_ns, can_id, data, sent))

    def append(self, rows: NDArray[np.void]) -> None:
        """Take rows with ``t_ns, can_id, length, sent, data`` (bytes of fixed width), shape (n,)."""
        self._take_singles()
        if rows.size:
            data = np.frombuffer(rows["data"].tobytes(), np.uint8).reshape(rows.size, -1)
            self._take(rows["t_ns"], rows["can_id"], rows["length"], rows["sent"] != 0, data)

    def _write_taken(self) -> None:
        self._take_singles()
        pending, self._pending = self._pending, []
        for objects in pending:
            self._file.write(blf.container(objects))
            self._content_size += blf.OBJECT_HEAD.size + blf.CONTAINER_HEAD.size + len(objects)

    def _finish(self) -> None:
        self._file.rewrite_head(blf.file_header(self._file.end, self._content_size, self._frames))

    def _take_singles(self) -> None:
        if self._single:
            singles, self._single = self._single, []
            width = max(8, *(len(data) for _, _, data, _ in singles))
            self._take(
                np.array([t_ns for t_ns, *_ in singles], np.int64),
                np.array([can_id for _, can_id, *_ in singles], np.uint32),
                np.array([len(data) for _, _, data, _ in singles], np.uint8),
                np.array([sent for *_, sent in singles], np.bool_),
                np.frombuffer(b"".join(d.ljust(width, b"\0") for _, _, d, _ in singles), np.uint8).reshape(-1, width),
            )

    def _take(
        self,
        t_ns: NDArray[np.int64],
        can_id: NDArray[np.uint32],
        length: NDArray[np.uint8],
        sent: NDArray[np.bool_],
        data: NDArray[np.uint8],
    ) -> None:
        for start in range(0, t_ns.size, _FRAMES_PER_CONTAINER):
            part = slice(start, start + _FRAMES_PER_CONTAINER)
            self._pending.append(blf.frame_objects(t_ns[part], can_id[part], length[part], sent[part], data[part]))
        self._frames += t_ns.size


def read_frames(path: Path) -> Frames:
    """All data frames of a ``.blf``, ``.asc``, ``.log`` (candump), ``.trc`` or ``.db``, whole or cut off, also gzipped.

    ``InputFileError``: unreadable, of no known format, or without a single frame.
    """
    try:
        if path.suffix.lower() == ".blf":
            return _from_blf(path)
        if path.suffix.lower() == ".gz":
            _refuse_bombs(path)
        return _from_python_can(path, lambda: can.LogReader(path))
    except (OSError, EOFError, zlib.error) as error:
        raise InputFileError(f"cannot be read: {getattr(error, 'strerror', None) or error}", where=str(path)) from None


def _refuse_bombs(path: Path) -> None:
    """Text of a bus log packs to about a tenth; what unpacks to a multiple of that holds no log."""
    most, unpacked = max(_LEAST_TEXT_BYTES, MOST_TEXT_RATIO * path.stat().st_size), 0
    with gzip.open(path) as file:
        while part := file.read(1 << 20):
            unpacked += len(part)
            if unpacked > most:
                raise InputFileError(
                    f"{path.stat().st_size:,} bytes that unpack to more than {most:,}",
                    where=str(path),
                    cause=f"the limit is {MOST_TEXT_RATIO} times the file",
                    next_step="if the file is sound, unpack it first",
                )


def _from_blf(path: Path) -> Frames:
    """The fast way for logs of data frames alone (such as ours); others as python-can reads what is sound of them."""
    data = path.read_bytes()
    if len(data) < blf.FILE_HEADER.size or not data.startswith(b"LOGG"):
        raise InputFileError("not a BLF file" if data else "the file is empty", where=f"{path}, byte 0")
    contents, damage, unpacked, most = [], "", 0, allowed_bytes(len(data))
    for content, wrong in blf.containers(data, most):
        unpacked += len(content)
        check_expansion(len(data), unpacked, str(path))
        contents.append(content)
        damage = wrong
    content = b"".join(contents)
    found = blf.frames_in(content)
    if found is None:
        return _from_foreign_blf(path, data, content, damage)
    classical, long, places = found
    if not places.size:
        raise InputFileError("holds no frames", where=str(path), cause=damage)
    whole = _in_order(classical, long, places)
    if whole is None:
        return _from_foreign_blf(path, data, content, damage)
    carries_data = (whole["flags"] & blf.REMOTE) == 0
    objects = whole[carries_data]
    if not objects.size:
        raise InputFileError("holds no frames that carry data", where=str(path))
    if int(objects["t_ns"].max()) > np.iinfo(np.int64).max:
        raise InputFileError("a time is out of range", where=str(path))
    return Frames(
        t_ns=objects["t_ns"].astype(np.int64),
        can_id=np.ascontiguousarray(objects["can_id"]),
        length=np.ascontiguousarray(objects["length"]),
        data=np.ascontiguousarray(objects["data"]),
        sent=(objects["flags"] & blf.SENT) != 0,
        skipped=int(np.count_nonzero(~carries_data)),
        damage=damage,
    )


def _from_foreign_blf(path: Path, data: bytes, content: bytes, damage: str) -> Frames:
    """Objects of other kinds: python-can reads them, of content that was unpacked within bounds and is sound."""
    sound = blf.sound_objects(content)
    if len(sound) < len(content):
        damage = f"no object where one should be, at byte {len(sound)} of what the file holds unpacked"
    whole = data[: blf.FILE_HEADER.unpack_from(data)[1]] + blf.container(sound, packed=False)
    frames = _from_python_can(path, lambda: can.BLFReader(io.BytesIO(whole)))
    return replace(frames, damage=frames.damage or damage)


def _in_order(classical: NDArray[np.void], long: NDArray[np.void], places: NDArray[np.intp]) -> NDArray[np.void] | None:
    """Frames of both kinds as they stood in the file; None where one is not as it should be."""
    if not ((classical["time_flags"] == 2) & (classical["dlc"] <= 8)).all():
        return None
    if not ((long["time_flags"] == 2) & (long["length"] <= 64) & (long["fd_flags"] & blf.EDL != 0)).all():
        return None
    columns = ("t_ns", "can_id", "length", "flags")
    kinds = ("<u8", "<u4", "u1", "u1")
    width = 64 if long.size else 8
    whole = np.zeros(places.size, [*zip(columns, kinds, strict=True), ("data", "u1", width)])
    short_at, long_at = places[: classical.size], places[classical.size :]
    for name in ("t_ns", "can_id", "flags"):
        whole[name][short_at], whole[name][long_at] = classical[name], long[name]
    whole["length"][short_at], whole["length"][long_at] = classical["dlc"], long["length"]
    whole["can_id"][long_at] |= np.uint32(FD_FRAME)
    whole["data"][short_at, :8], whole["data"][long_at] = classical["data"], long["data"][:, :width]
    return whole


def _from_python_can(path: Path, opened: Callable[[], AbstractContextManager[Iterable[can.Message]]]) -> Frames:
    messages: list[can.Message] = []
    skipped, damage, start_s = 0, "", 0.0
    try:
        with opened() as reader:
            start_s = float(getattr(reader, "start_timestamp", 0.0) or 0.0) if path.suffix.lower() == ".blf" else 0.0
            for message in reader:
                if message.is_error_frame or message.is_remote_frame or not _possible(message):
                    skipped += 1
                else:
                    messages.append(message)
    except OSError:
        raise
    except Exception as error:  # each of python-can's readers has errors of its own, some of the bare language
        damage = f"reading stopped after {len(messages)} frames: {error or type(error).__name__}"
    if not messages:
        raise InputFileError(
            "holds no frames",
            where=str(path),
            cause=damage or f"not a bus log that can be read ({', '.join(LOG_SUFFIXES)})",
        )
    times_s = np.array([message.timestamp for message in messages], np.float64)
    if not np.all(np.isfinite(times_s)) or abs(times_s - start_s).max() > 9e9:
        raise InputFileError("a time is not finite, or out of range", where=str(path))
    width = LONGEST if any(message.is_fd or len(message.data) > 8 for message in messages) else 8
    return Frames(
        t_ns=_run_time_ns(times_s, start_s),
        can_id=np.array(
            [m.arbitration_id | EXTENDED * m.is_extended_id | FD_FRAME * m.is_fd for m in messages], np.uint32
        ),
        length=np.array([len(m.data) for m in messages], np.uint8),
        data=np.frombuffer(b"".join(bytes(m.data).ljust(width, b"\0") for m in messages), np.uint8).reshape(-1, width),
        sent=np.array([not m.is_rx for m in messages], np.bool_),
        skipped=skipped,
        damage=damage,
    )


def _possible(message: can.Message) -> bool:
    """Of a length and an identifier that a wire can carry; python-can takes what a damaged text says."""
    return len(message.data) <= LONGEST and message.arbitration_id >> (29 if message.is_extended_id else 11) == 0


def _run_time_ns(times_s: NDArray[np.float64], start_s: float) -> NDArray[np.int64]:
    """Nanoseconds of run time; times of day keep the microseconds that a float of them holds, and start at zero."""
    if start_s:
        times_s = times_s - start_s
    elif times_s[0] > _EPOCH_S:
        microseconds = np.rint(times_s * 1e6).astype(np.int64)
        return np.asarray((microseconds - microseconds[0]) * 1000)
    return np.rint(times_s * 1e9).astype(np.int64)


class LogBus(can.BusABC):
    """The frames of a log, received at recorded speed (``paced``) or as fast as taken, and sent again on ``echo``."""

    def __init__(self, frames: Frames, *, paced: bool = False, echo: can.BusABC | None = None) -> None:
        super().__init__(channel="log")
        self.channel_info = f"bus log of {len(frames)} frames"
        self._frames = logged(frames)
        self._paced = paced
        self._echo = echo
        self._first_ns: int | None = None
        self._began_ns = 0
        self._next = next(self._frames, None)

    def take(self, timeout_s: float | None = None) -> tuple[int, int, bytes] | None:
        """The next frame as ``(run time in ns, CAN id, data)``; None when it does not come in time, or none is left."""
        taken = self._next
        if taken is None:
            return None
        if self._paced and not self._wait_for(taken[0], timeout_s):
            return None
        if self._echo is not None:
            self._echo.send(_message(taken))
        self._next = next(self._frames, None)
        return taken

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Goes nowhere: no drive is on this bus."""

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        taken = self.take(timeout)
        return (None if taken is None else _message(taken)), True

    def _wait_for(self, t_ns: int, timeout_s: float | None) -> bool:
        if self._first_ns is None:
            self._first_ns, self._began_ns = t_ns, time.monotonic_ns()
        wait_s = (t_ns - self._first_ns - (time.monotonic_ns() - self._began_ns)) * 1e-9
        if timeout_s is not None and wait_s > timeout_s:
            time.sleep(max(0.0, timeout_s))
            return False
        if wait_s > 0:
            time.sleep(wait_s)
        return True


def logged(frames: Frames) -> Iterator[tuple[int, int, bytes]]:
    """Every frame as ``(run time in ns, CAN id, data)``, in the order of the log."""
    raw, width = frames.data.tobytes(), frames.data.shape[1]
    ends = zip(frames.t_ns.tolist(), frames.can_id.tolist(), frames.length.tolist(), strict=True)
    for number, (t_ns, can_id, length) in enumerate(ends):
        yield t_ns, can_id, raw[number * width : number * width + length]


def _message(frame: tuple[int, int, bytes]) -> Any:
    t_ns, can_id, data = frame
    return can.Message(
        timestamp=t_ns * 1e-9,
        arbitration_id=can_id & ~(EXTENDED | FD_FRAME),
        is_extended_id=bool(can_id & EXTENDED),
        is_fd=bool(can_id & FD_FRAME),
        bitrate_switch=bool(can_id & FD_FRAME),
        data=data,
    )
