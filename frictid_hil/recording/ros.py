"""ROS bags: rosbag2 (MCAP and sqlite3) and ROS 1, by the package rosbags; no ROS is needed.

Read are messages that hold lists of numbers beside a list of joint names (``sensor_msgs/JointState`` and the like), by
name, whatever their order; times are those of ``header.stamp``, or of the log where that is zero.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from numpy.typing import NDArray

from frictid_hil.columns import JOINT, ColumnMap, JointColumns, Source
from frictid_hil.errors import InputFileError
from frictid_hil.friction.trajectory import Array
from frictid_hil.recording.arrays import ArrayTable, refusing
from frictid_hil.recording.bounds import check_expansion, check_rows

_NAMES = ("name", "joint_names")
_MAX_FORMS = 200  # messages of one topic may differ in this many ways (order of names, lengths of lists)
_MEANING = {  # where each quantity stands, best first; rad, rad/s and N m by the convention of ROS
    "position_rad": ("position", "feedback.positions", "actual.positions"),
    "velocity_rad_s": ("velocity", "feedback.velocities", "actual.velocities"),
    "torque_nm": ("effort", "feedback.effort", "actual.effort", "output.effort"),
    "position_command_rad": ("reference.positions", "desired.positions"),
}


def is_bag(path: Path) -> bool:
    """A folder of rosbag2, or a ROS 1 bag."""
    return (path / "metadata.yaml").exists() or path.name.lower().endswith(".bag")


def open_bag(path: Path, topic: str | None = None) -> ArrayTable:
    """The joint states in a bag: folder of rosbag2, ``.mcap``, ``.db3`` beside its metadata, or ``.bag``.

    ``topic`` says which where several hold joint states. ``InputFileError``: unreadable, no such messages, several
    topics of them, or rosbags is not installed.
    """
    files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
    for file in files:
        if file.suffix == ".mcap":
            _check_chunks(file)
    size = sum(file.stat().st_size for file in files if file.exists())
    with refusing(path, "bag"):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            topics = {c.topic: c for c in reader.connections if c.msgtype.endswith(("JointState", "ControllerState"))}
            every_state = len(topics)
            if topic is None:
                topics = _of_all_groups(topics)
            else:
                topics = {c.topic: c for c in reader.connections if c.topic == topic}
            if len(topics) != 1:
                every = ", ".join(sorted(f"{c.topic} ({c.msgtype})" for c in reader.connections))
                raise InputFileError(
                    "several topics hold joint states" if topics else "no topic of joint states",
                    where=str(path),
                    cause=f"topics in the file: {every or 'none'}",
                    next_step="say `topic:` in a column map" if topics else "",
                )
            chosen = [c for c in reader.connections if c.topic in topics]
            serialise = reader.typestore.serialize_cdr if reader.is2 else reader.typestore.serialize_ros1
            logged: list[int] = []
            raw: list[bytes] = []
            held = 0
            for _, log_ns, data in reader.messages(connections=chosen):
                logged.append(log_ns)
                raw.append(bytes(data))
                held += len(data)
                if len(raw) % 1000 == 0:
                    check_expansion(size, held, str(path))
            check_rows(len(raw), str(path))
            kind = chosen[0].msgtype
            table = _Decoder(
                lambda data: reader.deserialize(data, kind), lambda message: bytes(serialise(message, kind))
            ).table(raw, path)
    told = [f"read from {chosen[0].topic}, which stands above the topics of single groups"] if every_state > 1 else []
    return _table(path, table, np.array(logged, np.int64), chosen[0].topic, told if topic is None else [])


def _of_all_groups(topics: dict[str, Any]) -> dict[str, Any]:
    """Of ``/joint_states`` and the like of single groups below it (MotoROS2), the first; else as they are."""
    shortest = min(topics, key=len, default="")
    above, name = shortest.rpartition("/")[::2]
    below = all(other.startswith(f"{above}/") and other.endswith(f"/{name}") for other in topics)
    return {shortest: topics[shortest]} if name == "joint_states" and below else topics


@dataclass(frozen=True, slots=True)
class _Form:
    """Messages that differ in nothing but their numbers: byte offset (and length) of each list, and of the stamp."""

    joints: Sequence[str]
    places: Mapping[str, tuple[int, int]]
    stamp: tuple[int, int] | None
    fixed: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class _Decoder:
    """Messages to columns: one of each form is decoded, the others are read where that one holds its numbers.

    The places are found by serialising the message again with marks in place of its numbers.
    """

    deserialise: Any
    serialise: Any

    def table(self, raw: list[bytes], path: Path) -> dict[str, Array | NDArray[np.int64]]:
        """``stamp_ns`` and ``field/joint``, shape (n,) each; NaN where a message does not say."""
        n = len(raw)
        if not n:
            raise InputFileError("the topic holds no messages", where=str(path))
        columns: dict[str, Any] = {"stamp_ns": np.zeros(n, np.int64)}
        lengths = np.array([len(data) for data in raw])
        forms = 0
        for length in np.unique(lengths).tolist():
            rows = np.flatnonzero(lengths == length)
            content = np.frombuffer(b"".join(raw[row] for row in rows.tolist()), np.uint8).reshape(rows.size, length)
            while rows.size:
                forms += 1
                if forms > _MAX_FORMS:
                    raise InputFileError(
                        f"messages of more than {_MAX_FORMS} forms",
                        where=str(path),
                        cause="names that change each time",
                    )
                form = self._form(raw[int(rows[0])], path)
                alike = (content[:, form.fixed] == content[0, form.fixed]).all(axis=1)
                _take(columns, form, rows[alike], content[alike], n)
                rows, content = rows[~alike], content[~alike]
        return columns

    def _form(self, data: bytes, path: Path) -> _Form:
        message = self.deserialise(data)
        joints = next((list(getattr(message, name)) for name in _NAMES if hasattr(message, name)), [])
        if not joints:
            raise InputFileError("a message has no joint names", where=str(path))
        lists = {
            name: values.size
            for name, values in _lists(message)
            if values.dtype.kind == "f" and values.size == len(joints)
        }
        marks = {name: 1e300 + np.arange(size) * 1e290 + k * 1e295 for k, (name, size) in enumerate(lists.items())}
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        marked = message
        for name, mark in marks.items():
            marked = _with(marked, name, mark)
        if stamp is not None:
            header = replace(message.header, stamp=replace(stamp, sec=0x2BADF00D, nanosec=0x2BADCAFE))
            marked = replace(marked, header=header)
        written = self.serialise(marked)
        fixed = np.ones(len(data), np.bool_)
        places: dict[str, tuple[int, int]] = {}
        for name, mark in marks.items():
            at = written.find(mark.astype("<f8").tobytes())
            places[name] = (at, mark.size)
            fixed[at : at + 8 * mark.size] = False
        found = None
        if stamp is not None:
            found = written.find(struct.pack("<I", 0x2BADF00D)), written.find(struct.pack("<I", 0x2BADCAFE))
            for at in found:
                fixed[at : at + 4] = False
        if len(written) != len(data) or any(at < 0 for at, _ in places.values()):
            raise InputFileError("a message that is not written as the library writes it", where=str(path))
        if hasattr(getattr(message, "header", None), "seq"):
            fixed[:4] = False  # ROS 1 counts its messages first
        for name, time in _times(message):
            other = _with(message, name, replace(time, sec=time.sec ^ 0x7FFFFFFF, nanosec=time.nanosec ^ 0xFFFFFFFF))
            fixed &= np.frombuffer(self.serialise(other), np.uint8) == np.frombuffer(self.serialise(message), np.uint8)
        return _Form(joints, places, found, fixed)


def _take(columns: dict[str, Any], form: _Form, rows: NDArray[np.intp], content: NDArray[np.uint8], n: int) -> None:
    if form.stamp is not None:
        sec, nanosec = (content[:, at : at + 4].copy().view("<i4")[:, 0].astype(np.int64) for at in form.stamp)
        columns["stamp_ns"][rows] = sec * 1_000_000_000 + (nanosec & 0xFFFF_FFFF)
    for name, (at, size) in form.places.items():
        values = content[:, at : at + 8 * size].copy().view("<f8")
        for k, joint in enumerate(form.joints):
            column = columns.setdefault(f"{name}/{joint}", np.full(n, np.nan))
            column[rows] = values[:, k]


def _lists(message: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every list of numbers in a message, by its dotted path."""
    for part in fields(message):
        value = getattr(message, part.name)
        if isinstance(value, np.ndarray):
            yield path + part.name, value
        elif is_dataclass(value):
            yield from _lists(value, f"{path}{part.name}.")


def _times(message: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Durations inside a message (``time_from_start``), which change though nothing else does."""
    for part in fields(message):
        value = getattr(message, part.name)
        if is_dataclass(value) and part.name != "header":
            if hasattr(value, "nanosec"):
                yield path + part.name, value
            else:
                yield from _times(value, f"{path}{part.name}.")


def _with(message: Any, path: str, value: Any) -> Any:
    """The message with another value at a dotted path."""
    first, _, rest = path.partition(".")
    return replace(message, **{first: _with(getattr(message, first), rest, value) if rest else value})


def _table(path: Path, columns: dict[str, Any], logged: NDArray[np.int64], topic: str, told: list[str]) -> ArrayTable:
    """Rows in the order of their stamps, times since the first one in nanoseconds."""
    stamp = columns.pop("stamp_ns")
    if np.count_nonzero(stamp <= 0) > 1:
        stamp = logged
        told.append("messages carry no time stamp: times are those of the log")
    order = np.argsort(stamp, kind="stable")
    if (np.diff(stamp) < 0).any():
        told.append(f"{int(np.count_nonzero(np.diff(stamp) < 0))} messages came late and were put in order of stamp")
    if repeated := int(np.count_nonzero(np.diff(stamp[order]) == 0)):
        told.append(f"{repeated} messages repeat a time stamp")
    columns = {name: column[order] for name, column in columns.items()}
    columns["stamp"] = (stamp[order] - stamp.min()).astype(np.float64)
    sources = {
        quantity: Source((f"{place}/{JOINT}",))
        for quantity, places in _MEANING.items()
        for place in [next((p for p in places if any(name.startswith(f"{p}/") for name in columns)), None)]
        if place is not None
    }
    standard = None
    if "position_rad" in sources:
        standard = ColumnMap(f"ROS topic {topic}", Source(("stamp",)), {JOINT: JointColumns(sources)})
    return ArrayTable.of(path, columns, standard=standard, sparse=True, told=tuple(told))


def _check_chunks(path: Path) -> None:
    """Refuse an MCAP file whose chunks unpack to more than they may, by what they say and by what their frames say."""
    size, unpacked = path.stat().st_size, 0
    with refusing(path, "MCAP file"), path.open("rb") as file:
        file.seek(8)
        while len(head := file.read(9)) == 9:
            opcode, length = struct.unpack("<BQ", head)
            if file.tell() + length > size:
                break
            if opcode == 0x06 and length >= 40:
                begin = file.read(min(length, 64))
                said = struct.unpack_from("<QQQII", begin)
                unpacked += max(said[2], _frame_size(begin, said[4]))
                check_expansion(size, unpacked, str(path))
                file.seek(length - len(begin), 1)
            else:
                file.seek(length, 1)


def _frame_size(chunk: bytes, name_length: int) -> int:
    """What the compressed frame at the start of a chunk says it unpacks to; 0 where it does not say."""
    name, data = chunk[32 : 32 + name_length], chunk[32 + name_length + 8 :]
    with suppress(zstandard.ZstdError, RuntimeError):
        if name == b"zstd":
            return max(0, int(zstandard.frame_content_size(data)))
        if name == b"lz4":
            return int(lz4.frame.get_frame_info(data)["content_size"])
    return 0
