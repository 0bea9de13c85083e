"""Samples from an MCAP file, whole or cut off: everything up to the last complete record comes back.

A chunk written by this product is an array of equal records, so reading is one look at its bytes; a chunk that another
tool has re-packed (compressed, mixed) is walked record by record. Where a file ends in the middle of a record, or a
chunk fails its checksum, reading stops there and the samples say so in ``meta["damage"]``.
"""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, Metadata, Schema
from numpy.typing import NDArray

from frictid_hil.errors import InputFileError
from frictid_hil.recording import mcap_layout as layout
from frictid_hil.recording.bounds import allowed_bytes
from frictid_hil.recording.samples import Mark, Samples, checked

MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x02, 0x03, 0x04, 0x05, 0x06
_METADATA, _DATA_END = 0x0C, 0x0F
_RECORD = struct.Struct("<BQ")
NO_SAMPLES = "holds no samples of a joint"
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQII")

Rows = NDArray[np.void]


def read_mcap(path: Path, joint: str | None = None) -> list[Samples]:
    """The recordings of all joints in a file, or of the only one wanted.

    ``InputFileError``: no MCAP file of this product, without samples or that joint, or what ``samples.checked``
    refuses.
    """
    contents = _Contents.of(path)
    rows = contents.rows_by_joint(path)
    if joint is not None and joint not in rows:
        raise InputFileError(f"no samples of joint {joint!r}; it has {', '.join(rows)}", where=str(path))
    return [
        checked(contents.samples(name, records, path), where=f"{path}, joint {name}")
        for name, records in rows.items()
        if joint in (None, name)
    ]


def is_ours(path: Path) -> bool | None:
    """Whether this reader wrote the file (or it is no MCAP file, which is told here); None where nothing tells."""
    try:
        with path.open("rb") as file:
            begin = file.read(1 << 12)
    except OSError:
        return True
    if not begin.startswith(MAGIC) or b"frictid" in begin:
        return True
    profile = begin[len(MAGIC) + _RECORD.size :][4:8]
    return False if profile.startswith(b"ros") else None


def read_rows(path: Path) -> dict[str, Rows]:
    """Every field of every sample, by joint: arrays of ``mcap_layout.RECORD``; raises as ``read_mcap``."""
    return _Contents.of(path).rows_by_joint(path)


@dataclass(slots=True)
class _Contents:
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    rows: list[Rows] = field(default_factory=list)
    others: list[tuple[int, bytes]] = field(default_factory=list)
    metadata: dict[str, dict[str, Any]] = field(default_factory=dict)
    damage: str = ""
    size: int = 0
    unpacked: int = 0

    @staticmethod
    def of(path: Path) -> _Contents:
        try:
            data = path.read_bytes()
        except (OSError, MemoryError) as error:
            raise InputFileError(f"cannot be read: {error}", where=str(path)) from None
        if not data.startswith(MAGIC):
            raise InputFileError(
                "not an MCAP file" if data else "the file is empty", where=f"{path}, byte 0", cause="another format?"
            )
        contents = _Contents(size=len(data))
        contents._walk(memoryview(data), len(MAGIC), path)
        return contents

    def _walk(self, data: memoryview, at: int, path: Path) -> None:
        """Top-level records, until the data ends or stops making sense."""
        while at < len(data):
            if at + _RECORD.size > len(data):
                return self._damaged(data, at, "in the head of a record")
            opcode, length = _RECORD.unpack_from(data, at)
            start, end = at + _RECORD.size, at + _RECORD.size + length
            if opcode in (_DATA_END, _FOOTER):
                return None
            if end > len(data):
                if opcode == _CHUNK:
                    self._part_of_chunk(data[start:])
                return self._damaged(data, at, "in the middle of a record")
            try:
                self._record(opcode, data[start:end])
            except (_Damaged, McapError, struct.error, ValueError) as error:
                return self._damaged(data, at, f"at a record that cannot be decoded ({error or type(error).__name__})")
            at = end
        return self._damaged(data, at, "without its summary")

    def _damaged(self, data: memoryview, at: int, how: str) -> None:
        self.damage = f"the file ends {how}: {len(data) - at} bytes lost after byte {at}"

    def _record(self, opcode: int, body: memoryview) -> None:
        if opcode == _CHUNK:
            self._chunk(body)
        elif opcode == _MESSAGE:
            self._messages(memoryview(_RECORD.pack(opcode, len(body)) + bytes(body)))
        elif opcode == _SCHEMA:
            schema = Schema.read(_stream(body))
            self.schemas[schema.id] = schema
        elif opcode == _CHANNEL:
            channel = Channel.read(_stream(body))
            self.channels[channel.id] = channel
        elif opcode == _METADATA:
            record = Metadata.read(_stream(body))
            values = {key: _json(value) for key, value in record.metadata.items()}
            self.metadata.setdefault(record.name, {}).update(values)

    def _chunk(self, body: memoryview) -> None:
        _, _, size, crc, name_length = _CHUNK_HEAD.unpack_from(body)
        self.unpacked += size
        if name_length and self.unpacked > allowed_bytes(self.size):
            raise _Damaged(f"its chunks unpack to {self.unpacked} bytes; {allowed_bytes(self.size)} are read")
        # A copy of an uncompressed chunk would cost more than reading it.
        content = _unpacked(Chunk.read(_stream(body))) if name_length else body[_CHUNK_HEAD.size + 8 :]
        if len(content) != size or (crc and zlib.crc32(content) != crc):
            raise _Damaged("its checksum fails")
        self._messages(content)

    def _part_of_chunk(self, body: memoryview) -> None:
        """What can be had of a chunk that is cut off: its whole messages, where it is not compressed."""
        head = _CHUNK_HEAD.size
        if len(body) < head + 8 or _CHUNK_HEAD.unpack_from(body)[4] != 0:
            return
        content = body[head + 8 :]
        records = np.frombuffer(
            content[: len(content) // layout.RECORD.itemsize * layout.RECORD.itemsize], layout.RECORD
        )
        whole = (records["opcode"] == _MESSAGE) & (records["length"] == layout.RECORD_LENGTH)
        self._take(records if whole.all() else records[: int(np.argmin(whole))])

    def _messages(self, content: memoryview) -> None:
        if len(content) % layout.RECORD.itemsize == 0 and self._take(np.frombuffer(content, layout.RECORD)):
            return
        at = 0
        while at < len(content):
            opcode, length = _RECORD.unpack_from(content, at)
            start, at = at + _RECORD.size, at + _RECORD.size + length
            if at > len(content):
                raise _Damaged("a message does not fit in its chunk")
            if opcode in (_SCHEMA, _CHANNEL):
                self._record(opcode, content[start:at])
            if opcode != _MESSAGE:
                continue
            (channel, *_) = _MESSAGE_HEAD.unpack_from(content, start)
            if length == layout.RECORD_LENGTH and self._is_sample(channel):
                self._take(np.frombuffer(content[start - _RECORD.size : at], layout.RECORD))
            else:
                self.others.append((channel, bytes(content[start + _MESSAGE_HEAD.size : at])))

    def _take(self, records: Rows) -> bool:
        """Keep records if all of them are samples."""
        if not records.size or not bool(
            np.all((records["opcode"] == _MESSAGE) & (records["length"] == layout.RECORD_LENGTH))
        ):
            return False
        if not all(self._is_sample(int(channel)) for channel in np.unique(records["channel"])):
            return False
        self.rows.append(records)
        return True

    def _is_sample(self, channel: int) -> bool:
        known = self.channels.get(channel)
        return known is not None and known.message_encoding == "cdr" and known.topic.startswith("/joint/")

    def rows_by_joint(self, path: Path) -> dict[str, Rows]:
        """All records, sorted out; order within a joint as recorded."""
        if not self.rows:
            topics = ", ".join(sorted(channel.topic for channel in self.channels.values()))
            raise InputFileError(
                NO_SAMPLES,
                where=str(path),
                cause=self.damage or f"topics in the file: {topics or 'none'}",
            )
        records = np.concatenate(self.rows)
        sorted_out = {}
        for number, channel in self.channels.items():
            if self._is_sample(number):
                self._check_layout(channel, path)
                mine = records[records["channel"] == number]
                if mine.size:
                    sorted_out[channel.topic.removeprefix("/joint/")] = mine
        return sorted_out

    def _check_layout(self, channel: Channel, path: Path) -> None:
        schema = self.schemas.get(channel.schema_id)
        expected = layout.schema_text(prismatic=schema is not None and schema.name == layout.LINEAR)
        if schema is None or schema.data.decode(errors="replace") != expected:
            raise InputFileError(
                f"{channel.topic} holds messages of another layout",
                where=str(path),
                cause="written by another tool, or by another version of this one",
                next_step="export it as CSV and give a column map",
            )

    def samples(self, joint: str, records: Rows, path: Path) -> Samples:
        """One joint's columns, marks and provenance."""
        if int(records["log_time"].max()) > np.iinfo(np.int64).max:
            raise InputFileError("a time is out of range", where=str(path))
        columns: dict[str, Any] = {}
        for name in (name for name in Samples.COLUMNS if name in layout.VALUES):
            column = np.ascontiguousarray(records[name])
            if np.isfinite(column[0]) or not np.isnan(column).all():
                columns[name] = column
        topic = layout.topic_of(joint)
        schema_id = next(channel.schema_id for channel in self.channels.values() if channel.topic == topic)
        meta = {**self.metadata.get("recording", {}), **self.metadata.get(f"joint/{joint}", {})}
        if self.damage:
            meta["damage"] = self.damage
        if "position_rad" not in columns:
            raise InputFileError(f"joint {joint} has no position", where=str(path))
        return Samples(
            joint=joint,
            time_ns=records["log_time"].astype(np.int64),
            marks=self._marks(joint),
            prismatic=self.schemas[schema_id].name == layout.LINEAR,
            meta=meta,
            **columns,
        )

    def _marks(self, joint: str) -> tuple[Mark, ...]:
        marks = []
        for channel, body in self.others:
            known = self.channels.get(channel)
            if known is None or known.topic != layout.MARKS_TOPIC:
                continue
            value = _json(body.decode(errors="replace"))
            if isinstance(value, dict) and value.get("joint") == joint:
                marks.append(_mark(value))
        return tuple(sorted((mark for mark in marks if mark), key=lambda mark: mark.start_ns))


class _Damaged(Exception):
    """A record that cannot be what was written."""


def _mark(value: dict[str, Any]) -> Mark | None:
    name, start, end, details = (value.get(key) for key in ("name", "start_ns", "end_ns", "details"))
    if isinstance(name, str) and isinstance(start, int) and isinstance(end, int) and isinstance(details, dict):
        return Mark(name, start, end, details)
    return None


def _stream(body: memoryview) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))


def _json(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


def _unpacked(chunk: Chunk) -> memoryview:
    """The content of a chunk that another tool has compressed; no more is unpacked than it says."""
    most = chunk.uncompressed_size + 1
    try:
        if chunk.compression == "zstd":
            return memoryview(zstandard.ZstdDecompressor().stream_reader(chunk.data).read(most))
        if chunk.compression == "lz4":
            return memoryview(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=most))
    except Exception as error:  # each compressor has errors of its own; all of them mean that the chunk is spoilt
        raise _Damaged(f"{chunk.compression}: {error}") from None
    raise _Damaged(f"an unknown compression {chunk.compression[:20]!r}")
