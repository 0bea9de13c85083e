from __future__ import annotations

import io
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from frictid_hil.errors import FrictidError, InputFileError
from frictid_hil.recording.mcap import SampleWriter, write_samples
from frictid_hil.recording.mcap_layout import RECORD, schema_text
from frictid_hil.recording.mcap_reader import read_mcap, read_rows
from frictid_hil.recording.samples import Mark, Samples


def samples(joint: str = "0", n: int = 1000, **changes: object) -> Samples:
    time_s = np.arange(n) * 1e-3
    values: dict[str, object] = {
        "joint": joint,
        "time_ns": np.arange(n, dtype=np.int64) * 1_000_000 + 7,
        "position_rad": np.sin(time_s),
        "velocity_rad_s": np.cos(time_s),
        "torque_nm": 8.0 * np.sign(np.cos(time_s)),
        "position_command_rad": np.sin(time_s + 1e-3),
        "marks": (Mark("cycles", 100, 500_000_000, {"amplitude_rad": 0.349, "cycles": 10}), Mark("hold", 0, 100)),
        "meta": {"torque_source": "6077", "timing": {"torque_delay_s": 0.001}},
    }
    return Samples(**{**values, **changes})  # type: ignore[arg-type]


def same(one: Samples, other: Samples) -> None:
    assert (one.joint, one.prismatic, dict(one.meta)) == (other.joint, other.prismatic, dict(other.meta))
    assert np.array_equal(one.time_ns, other.time_ns)
    assert one.columns().keys() == other.columns().keys()
    for name, column in one.columns().items():
        assert np.array_equal(column, other.columns()[name]), name
    assert sorted(one.marks, key=lambda m: m.start_ns) == list(other.marks)


def test_what_is_written_is_read_to_the_last_bit(tmp_path: Path) -> None:
    written = [samples("0"), samples("shoulder", 500, temperature_c=np.full(500, 30.5), velocity_rad_s=None)]
    write_samples(tmp_path / "s.mcap", written)
    for one, other in zip(written, read_mcap(tmp_path / "s.mcap"), strict=True):
        same(one, other)
    (only,) = read_mcap(tmp_path / "s.mcap", "shoulder")
    assert only.joint == "shoulder"
    with pytest.raises(InputFileError, match="no samples of joint '9'; it has 0, shoulder"):
        read_mcap(tmp_path / "s.mcap", "9")


def test_a_linear_axis_stays_one(tmp_path: Path) -> None:
    write_samples(tmp_path / "s.mcap", [samples("axis", prismatic=True)])
    (axis,) = read_mcap(tmp_path / "s.mcap")
    assert axis.prismatic
    assert "float64 force_n" in schema_text(prismatic=True)
    assert "_nm" not in schema_text(prismatic=True)


def decode_cdr(schema: str, data: bytes) -> dict[str, float]:
    """An independent, slow decoder of the message by its schema text, as Foxglove or PlotJuggler would."""
    assert data[:4] == b"\x00\x01\x00\x00"
    at, values = 4, {}
    kinds = {"int32": "<i4", "uint32": "<u4", "float64": "<f8"}
    for line in schema.split("=" * 80)[0].splitlines():
        kind, name = line.split()
        fields = [("int32", "sec"), ("uint32", "nanosec")] if kind.endswith("Time") else [(kind, name)]
        for each, field in fields:
            size = np.dtype(kinds[each]).itemsize
            at += -(at - 4) % size
            values[field] = np.frombuffer(data, kinds[each], 1, at)[0]
            at += size
    assert at == len(data)
    return values


def test_a_tool_that_knows_only_the_standard_reads_it(tmp_path: Path) -> None:
    original = samples()
    write_samples(tmp_path / "s.mcap", [original])
    with (tmp_path / "s.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == 1002
        read = [
            (message.log_time, decode_cdr(schema.data.decode(), message.data))
            for schema, _, message in reader.iter_messages(topics=["/joint/0"])
            if schema is not None
        ]
        marks = [message.data for _, _, message in reader.iter_messages(topics=["/marks"])]
        metadata = list(reader.iter_metadata())
    assert [time_ns for time_ns, _ in read] == original.time_ns.tolist()
    assert [values["torque_nm"] for _, values in read] == original.torque_nm.tolist()
    assert all(v["sec"] * 10**9 + v["nanosec"] == t for t, v in read)
    assert np.isnan(read[0][1]["temperature_c"])
    assert len(marks) == 2
    assert metadata[0].name == "joint/0"


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE])
def test_a_file_repacked_by_other_tools_is_read_the_same(tmp_path: Path, compression: CompressionType) -> None:
    write_samples(tmp_path / "s.mcap", [samples("0"), samples("1")])
    with (tmp_path / "s.mcap").open("rb") as source, (tmp_path / "r.mcap").open("wb") as target:
        reader, writer = make_reader(source), Writer(target, compression=compression, chunk_size=10_000)
        writer.start()
        known: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            if channel.id not in known and schema is not None:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                known[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, schema_id)
            writer.add_message(known[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    for one, other in zip(read_mcap(tmp_path / "s.mcap"), read_mcap(tmp_path / "r.mcap"), strict=True):
        assert np.array_equal(one.position_rad, other.position_rad)
        assert np.array_equal(one.time_ns, other.time_ns)
        assert one.marks == other.marks


ROW = [("t_ns", "<i8"), ("position_rad", "<f8"), ("torque_nm", "<f8"), ("status", "<u4"), ("joint", "<u2")]


def rows(start: int, n: int) -> np.ndarray:
    values = np.zeros(n, ROW)
    values["t_ns"] = (start + np.arange(n)) * 1_000_000
    values["position_rad"] = start + np.arange(n)
    values["status"] = 0x1237
    return values


def test_rows_of_the_ring_are_taken_as_they_come(tmp_path: Path) -> None:
    with SampleWriter(tmp_path / "s.mcap", ["0", "1"], {"robot": "hp3j"}) as writer:
        for start in range(0, 1000, 100):
            writer.append("0", rows(start, 100))
            writer.append("1", rows(start, 10))
            writer.append("1", rows(0, 0))
            writer.flush()
    by_joint = read_rows(tmp_path / "s.mcap")
    assert {name: len(r) for name, r in by_joint.items()} == {"0": 1000, "1": 100}
    assert set(by_joint["0"]["status"].tolist()) == {0x1237}
    assert by_joint["0"]["sequence"].tolist() == list(range(1000))
    (zero, _) = read_mcap(tmp_path / "s.mcap")
    assert zero.meta == {"robot": "hp3j"}
    assert zero.velocity_rad_s is None


def whole_file(folder: Path, flushes: int = 5) -> bytes:
    with SampleWriter(folder / "whole.mcap", ["0"]) as writer:
        for k in range(flushes):
            writer.append("0", rows(100 * k, 100))
            writer.mark("0", Mark("hold", k * 100_000_000, (k + 1) * 100_000_000))
            writer.flush()
    return (folder / "whole.mcap").read_bytes()


@pytest.mark.slow
def test_a_file_cut_anywhere_gives_back_every_whole_record_before_the_cut(tmp_path: Path) -> None:
    data = whole_file(tmp_path)
    path = tmp_path / "cut.mcap"
    recovered = []
    for cut in range(0, len(data), 97):
        path.write_bytes(data[:cut])
        try:
            (one,) = read_mcap(path)
        except InputFileError as error:
            assert str(path) in error.where
            recovered.append(0)
            continue
        assert one.position_rad.tolist() == list(range(len(one)))
        assert len(one) == 500 or "bytes lost after byte" in one.meta["damage"]
        recovered.append(len(one))
    assert recovered == sorted(recovered), "a longer file never gives fewer samples"
    # Every message that is whole before the cut is had, but for the last piece of at most one record.
    assert recovered[-1] == 500
    assert max(np.diff(recovered)) <= 2


def test_a_flipped_bit_in_a_chunk_ends_the_reading_there(tmp_path: Path) -> None:
    data = bytearray(whole_file(tmp_path))
    at = data.find(np.array([250.0, np.nan]).tobytes())
    data[at] ^= 1
    (tmp_path / "bad.mcap").write_bytes(data)
    (one,) = read_mcap(tmp_path / "bad.mcap")
    assert len(one) == 200
    assert "checksum" in one.meta["damage"]


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**32))
def test_a_damaged_file_is_read_or_refused_never_worse(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    dice = random.Random(seed)
    folder = tmp_path_factory.mktemp("fuzz")
    data = bytearray(whole_file(folder, 2))
    for _ in range(dice.randint(1, 5)):
        at = dice.randrange(8, dice.choice([200, 1500, len(data)]))
        data[at : at + dice.randint(0, 9)] = dice.randbytes(dice.randint(0, 9))
    (folder / "bad.mcap").write_bytes(data[: dice.choice([len(data), dice.randrange(len(data))])])
    try:
        read_mcap(folder / "bad.mcap")
    except InputFileError as error:
        assert "bad.mcap" in error.where


@settings(max_examples=50, deadline=None)
@given(st.binary(max_size=300), st.booleans())
def test_garbage_is_refused(tmp_path_factory: pytest.TempPathFactory, garbage: bytes, magic: bool) -> None:
    path = tmp_path_factory.mktemp("fuzz") / "g.mcap"
    path.write_bytes((b"\x89MCAP0\r\n" if magic else b"") + garbage)
    with pytest.raises(InputFileError):
        read_mcap(path)


def test_another_tool_s_messages_are_named(tmp_path: Path) -> None:
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    schema = writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", b"float64[] position")
    writer.add_message(writer.register_channel("/joint_states", "cdr", schema), 1, b"\0\1\0\0" + bytes(8), 1)
    writer.add_message(writer.register_channel("/joint/0", "cdr", schema), 1, bytes(RECORD.itemsize - 31), 1)
    writer.finish()
    (tmp_path / "ros.mcap").write_bytes(stream.getvalue())
    with pytest.raises(InputFileError, match="another layout"):
        read_mcap(tmp_path / "ros.mcap")
    with pytest.raises(InputFileError, match="cannot be read"):
        read_mcap(tmp_path / "absent.mcap")


def test_samples_that_no_one_should_trust_are_refused(tmp_path: Path) -> None:
    backwards = samples(time_ns=np.arange(1000, 0, -1, dtype=np.int64))
    write_samples(tmp_path / "b.mcap", [backwards])
    with pytest.raises(InputFileError, match="time does not increase"):
        read_mcap(tmp_path / "b.mcap")
    gap = np.where(np.arange(1000) == 500, np.nan, 1.0)
    write_samples(tmp_path / "n.mcap", [samples(torque_nm=gap)])
    with pytest.raises(InputFileError, match=r"torque_nm has 1 values that are not finite, the first at row 500"):
        read_mcap(tmp_path / "n.mcap")


KILLED = """
import sys, time, numpy as np
from pathlib import Path
from frictid_hil.recording.mcap import SampleWriter
row = [("t_ns", "<i8"), ("position_rad", "<f8")]
writer = SampleWriter(Path(sys.argv[1]), ["0"])
k = 0
while True:
    rows = np.zeros(10, row)
    rows["t_ns"] = np.arange(10 * k, 10 * k + 10)
    writer.append("0", rows)
    k += 1
    if k % 5 == 0:
        writer.flush()
        print(10 * k, flush=True)
    time.sleep(0.001)
"""


def test_what_was_flushed_survives_sigkill(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    child = subprocess.Popen([sys.executable, "-c", KILLED, str(path)], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    flushed = [int(child.stdout.readline()) for _ in range(20)]
    time.sleep(0.003)
    os.kill(child.pid, signal.SIGKILL)
    rest = child.stdout.read().split()
    child.wait()
    (one,) = read_mcap(path)
    assert len(one) >= int(rest[-1] if rest else flushed[-1])
    assert one.time_ns.tolist() == list(range(len(one)))


def test_a_full_disk_keeps_what_was_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "full.mcap"
    writer = SampleWriter(path, ["0"])
    writer.append("0", rows(0, 100))
    writer.flush()

    class FullFile:
        def __init__(self, file: io.FileIO) -> None:
            self.file = file
            self.left = 500

        def write(self, data: bytes) -> int:
            if not self.left:
                raise OSError(28, "No space left on device")
            taken = self.file.write(data[: self.left])
            self.left -= taken
            return taken

        def __getattr__(self, name: str) -> object:
            return getattr(self.file, name)

    monkeypatch.setattr(writer._file, "_file", FullFile(writer._file._file))
    writer.append("0", rows(100, 100))
    with pytest.raises(FrictidError, match="disk is full"):
        writer.flush()
    (one,) = read_mcap(path)
    assert len(one) == 100
    with pytest.raises(FrictidError, match="cannot be written"):
        SampleWriter(tmp_path / "absent" / "s.mcap", ["0"])
