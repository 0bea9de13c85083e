"""Samples to an MCAP file that survives whatever kills the process.

What ``flush`` has written as a chunk and synced is readable after SIGKILL, and after a power failure up to the last
whole record. ``close`` adds the summary by which tools seek; without it a file is read just as well, only slower.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap import records as mcap
from mcap.data_stream import RecordBuilder
from numpy.typing import NDArray

from frictid_hil.recording import mcap_layout as layout
from frictid_hil.recording.growing_file import GrowingLog
from frictid_hil.recording.samples import Mark, Samples
from frictid_hil.version import __version__

MAGIC = b"\x89MCAP0\r\n"
_CHUNK_ROWS = 32_768  # rows that are written without being asked to, so that memory stays bounded

_MARKS_CHANNEL = 1
_ROTARY_SCHEMA, _LINEAR_SCHEMA, _MARK_SCHEMA = 1, 2, 3


class SampleWriter(GrowingLog):
    """Writes one new MCAP file, one channel per joint, in place of an existing one; raises as ``GrowingFile``."""

    def __init__(
        self,
        path: Path,
        joints: Sequence[str],
        meta: Mapping[str, Any] | None = None,  # provenance common to all joints, plain values
        *,
        prismatic: Collection[str] = (),  # names of the linear axes
    ) -> None:
        super().__init__(path)
        self._channels = {joint: number for number, joint in enumerate(joints, start=_MARKS_CHANNEL + 1)}
        self._rows: list[NDArray[np.void]] = []
        self._pending = 0
        self._marks: list[mcap.Message] = []
        self._counts: dict[int, int] = {}
        self._index: list[mcap.ChunkIndex] = []
        self._metadata_index: list[mcap.MetadataIndex] = []
        self._head = [
            mcap.Schema(_ROTARY_SCHEMA, layout.schema_text(prismatic=False).encode(), "ros2msg", layout.ROTARY),
            mcap.Schema(_LINEAR_SCHEMA, layout.schema_text(prismatic=True).encode(), "ros2msg", layout.LINEAR),
            mcap.Schema(_MARK_SCHEMA, layout.MARK_SCHEMA.encode(), "jsonschema", "frictid.Mark"),
            *self._channel_records(prismatic),
        ]
        self._file.write(MAGIC + _bytes(mcap.Header("", f"frictid-hil {__version__}"), *self._head))
        if meta:
            self.metadata("recording", meta)

    def append(self, joint: str, rows: NDArray[np.void]) -> None:
        """Take rows of one joint, shape (n,).

        They are structured, with ``t_ns`` and any of ``mcap_layout.VALUES`` and ``COUNTS``; further fields are ignored.
        """
        if not rows.size:
            return
        records = np.zeros(rows.size, layout.RECORD)
        channel = self._channels[joint]
        start = self._counts.get(channel, 0)
        self._counts[channel] = start + rows.size
        time_ns = rows["t_ns"]
        records["opcode"] = layout.MESSAGE_OPCODE
        records["length"] = layout.RECORD_LENGTH
        records["channel"] = channel
        records["sequence"] = np.arange(start, start + rows.size, dtype=np.int64)
        records["log_time"] = records["publish_time"] = time_ns
        records["encapsulation"] = layout.CDR_LITTLE_ENDIAN
        records["sec"], records["nanosec"] = np.divmod(time_ns, 1_000_000_000)
        names = rows.dtype.names or ()
        for name in layout.VALUES:
            records[name] = rows[name] if name in names else np.nan
        for name in layout.COUNTS:
            if name in names:
                records[name] = rows[name]
        self._rows.append(records)
        self._pending += rows.size
        if self._pending >= _CHUNK_ROWS:
            self._write_rows()

    def mark(self, joint: str, mark: Mark) -> None:
        """Take a mark of one joint."""
        body = {"joint": joint, **{name: getattr(mark, name) for name in ("name", "start_ns", "end_ns")}}
        data = json.dumps(body | {"details": dict(mark.details)}).encode()
        at_ns = mark.start_ns
        self._marks.append(mcap.Message(_MARKS_CHANNEL, at_ns, data, publish_time=at_ns, sequence=len(self._marks)))

    def metadata(self, name: str, values: Mapping[str, Any]) -> None:
        """Write provenance at once: ``recording`` for all joints, ``joint/<name>`` for one."""
        record = mcap.Metadata(name=name, metadata={key: json.dumps(value) for key, value in values.items()})
        data = _bytes(record)
        self._metadata_index.append(mcap.MetadataIndex(offset=self._file.end, length=len(data), name=name))
        self._file.write(data)

    def _write_taken(self) -> None:
        self._write_rows()
        self._write_marks()

    def _finish(self) -> None:
        self._file.write(_bytes(mcap.DataEnd(0)))
        start = self._file.end
        summary = _bytes(*self._head, self._statistics(), *self._index, *self._metadata_index)
        footer = mcap.Footer(summary_start=start, summary_offset_start=0, summary_crc=0)
        self._file.write(summary + _bytes(footer) + MAGIC)

    def _write_rows(self) -> None:
        if not self._rows:
            return
        records = np.concatenate(self._rows)
        self._rows, self._pending = [], 0
        self._write_chunk(
            records.tobytes(),
            records["channel"],
            records["log_time"],
            np.arange(records.size, dtype=np.uint64) * np.uint64(records.itemsize),
        )

    def _write_marks(self) -> None:
        if not self._marks:
            return
        texts = [_bytes(mark) for mark in self._marks]
        times = np.array([mark.log_time for mark in self._marks], dtype=np.uint64)
        self._counts[_MARKS_CHANNEL] = self._counts.get(_MARKS_CHANNEL, 0) + len(texts)
        self._marks = []
        offsets = np.cumsum([0, *map(len, texts[:-1])], dtype=np.uint64)
        self._write_chunk(b"".join(texts), np.full(len(texts), _MARKS_CHANNEL, np.uint16), times, offsets)

    def _write_chunk(
        self, content: bytes, channels: NDArray[Any], times: NDArray[np.uint64], offsets: NDArray[np.uint64]
    ) -> None:
        start, end = int(times.min()), int(times.max())
        chunk = _bytes(
            mcap.Chunk(
                compression="",
                data=content,
                message_start_time=start,
                message_end_time=end,
                uncompressed_crc=zlib.crc32(content),
                uncompressed_size=len(content),
            )
        )
        chunk_at = self._file.end
        index = bytearray()
        places: dict[int, int] = {}
        for channel in map(int, np.unique(channels)):
            mine = channels == channel
            places[channel] = chunk_at + len(chunk) + len(index)
            # The record by which tools find a channel's messages in a chunk: (log time, offset) pairs.
            pairs = np.column_stack([times[mine], offsets[mine]]).astype("<u8").tobytes()
            index += struct.pack("<BQHI", 0x07, 2 + 4 + len(pairs), channel, len(pairs)) + pairs
        self._file.write(chunk + index)
        self._index.append(
            mcap.ChunkIndex(
                chunk_start_offset=chunk_at,
                chunk_length=len(chunk),
                compression="",
                compressed_size=len(content),
                uncompressed_size=len(content),
                message_start_time=start,
                message_end_time=end,
                message_index_length=len(index),
                message_index_offsets=places,
            )
        )

    def _channel_records(self, prismatic: Collection[str]) -> list[mcap.McapRecord]:
        joints = [
            mcap.Channel(
                id=number,
                topic=layout.topic_of(joint),
                message_encoding="cdr",
                metadata={"joint": joint},
                schema_id=_LINEAR_SCHEMA if joint in prismatic else _ROTARY_SCHEMA,
            )
            for joint, number in self._channels.items()
        ]
        return [mcap.Channel(_MARKS_CHANNEL, layout.MARKS_TOPIC, "json", {}, _MARK_SCHEMA), *joints]

    def _statistics(self) -> mcap.Statistics:
        return mcap.Statistics(
            attachment_count=0,
            channel_count=len(self._channels) + 1,
            channel_message_counts=self._counts,
            chunk_count=len(self._index),
            message_count=sum(self._counts.values()),
            message_start_time=min((chunk.message_start_time for chunk in self._index), default=0),
            message_end_time=max((chunk.message_end_time for chunk in self._index), default=0),
            metadata_count=len(self._metadata_index),
            schema_count=3,
        )


def write_samples(path: Path, recordings: Sequence[Samples]) -> None:
    """Write whole recordings, one per joint."""
    linear = [samples.joint for samples in recordings if samples.prismatic]
    with SampleWriter(path, [samples.joint for samples in recordings], prismatic=linear) as writer:
        for samples in recordings:
            columns = samples.columns()
            rows = np.zeros(len(samples), [("t_ns", "<i8"), *((name, "<f8") for name in columns)])
            rows["t_ns"] = samples.time_ns
            for name, column in columns.items():
                rows[name] = column
            writer.append(samples.joint, rows)
            writer.metadata(f"joint/{samples.joint}", samples.meta)
            for mark in samples.marks:
                writer.mark(samples.joint, mark)


def _bytes(*records: mcap.McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]  # mcap leaves this one method untyped
