from __future__ import annotations

import gzip
import os
import random
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frictid_hil.errors import FrictidError, InputFileError
from frictid_hil.protocol.driver import EXTENDED, FD_FRAME
from frictid_hil.recording.bus_log import BusLogWriter, Frames, LogBus, logged, read_frames

ROW = np.dtype([("t_ns", "<i8"), ("can_id", "<u4"), ("length", "u1"), ("sent", "u1"), ("pad", "<u2"), ("data", "V64")])


def rows(n: int, start_ns: int = 0, step_ns: int = 123_457) -> np.ndarray:
    packed = b"".join(
        struct.pack("<qIBBH64s", start_ns + k * step_ns, 0x180 + k % 6, k % 9, k % 2, 0, os.urandom(8)[: k % 9])
        for k in range(n)
    )
    return np.frombuffer(packed, ROW)


def write(path: Path, *blocks: np.ndarray) -> None:
    with BusLogWriter(path) as writer:
        for block in blocks:
            writer.append(block)
            writer.flush()


def same(frames: Frames, block: np.ndarray) -> None:
    assert frames.t_ns.tolist() == block["t_ns"].tolist()
    assert frames.can_id.tolist() == block["can_id"].tolist()
    assert frames.length.tolist() == block["length"].tolist()
    assert frames.sent.tolist() == (block["sent"] != 0).tolist()
    width = frames.data.shape[1]
    assert frames.data.tobytes() == b"".join(bytes(d)[:width] for d in block["data"])


def test_what_was_written_is_read_to_the_nanosecond(tmp_path: Path) -> None:
    block = rows(10_000)
    write(tmp_path / "bus.blf", block[:3000], block[3000:3000], block[3000:])
    frames = read_frames(tmp_path / "bus.blf")
    same(frames, block)
    assert (frames.skipped, frames.damage) == (0, "")


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.integers(0, 10**15), st.integers(0, 2**29 - 1), st.booleans(), st.binary(max_size=8), st.booleans()
        ),
        min_size=1,
        max_size=20,
    )
)
def test_any_frame_survives_and_python_can_reads_the_same(
    tmp_path_factory: pytest.TempPathFactory, frames: list[tuple[int, int, bool, bytes, bool]]
) -> None:
    path = tmp_path_factory.mktemp("blf") / "bus.blf"
    with BusLogWriter(path) as writer:
        for t_ns, can_id, extended, data, sent in frames:
            writer.frame(t_ns, can_id | EXTENDED if extended else can_id & 0x7FF, data, sent)
    ours = read_frames(path)
    assert ours.t_ns.tolist() == [t_ns for t_ns, *_ in frames]
    with can.LogReader(path) as reader:
        theirs = list(reader)
    for k, (t_ns, can_id, extended, data, sent) in enumerate(frames):
        assert theirs[k].arbitration_id == (can_id if extended else can_id & 0x7FF) == int(ours.can_id[k]) & 0x1FFFFFFF
        assert theirs[k].is_extended_id == extended == bool(int(ours.can_id[k]) & EXTENDED)
        assert bytes(theirs[k].data) == data == bytes(ours.data[k, : ours.length[k]])
        assert theirs[k].is_rx != sent
        assert bool(ours.sent[k]) == sent
        assert round(theirs[k].timestamp * 1e9) == t_ns


@pytest.mark.slow
@given(
    st.lists(
        st.tuples(
            st.integers(0, 10**12),
            st.integers(0, 0x7FF),
            st.booleans(),
            st.sampled_from([*range(9), 12, 16, 20, 24, 32, 48, 64]),
            st.booleans(),
        ),
        min_size=1,
        max_size=40,
    ),
    st.integers(0, 2**31),
)
@settings(max_examples=50, deadline=None)
def test_can_fd_frames_stay_what_they_are(tmp_path_factory: pytest.TempPathFactory, frames: list, seed: int) -> None:
    path = tmp_path_factory.mktemp("fd") / "fd.blf"
    draw = random.Random(seed)
    written = []
    with BusLogWriter(path) as writer:
        for t_ns, can_id, fd, size, sent in frames:
            data = draw.randbytes(size if fd else min(size, 8))
            written.append((t_ns, can_id | FD_FRAME if fd else can_id, data, sent))
            writer.frame(*written[-1])
    ours = read_frames(path)
    assert list(logged(ours)) == [frame[:3] for frame in written]
    assert ours.sent.tolist() == [sent for *_, sent in written]
    with can.LogReader(path) as reader:
        theirs = list(reader)
    assert [(m.arbitration_id, m.is_fd, m.bitrate_switch, bytes(m.data)) for m in theirs] == [
        (can_id & 0x7FF, bool(can_id & FD_FRAME), bool(can_id & FD_FRAME), data) for _, can_id, data, _ in written
    ]
    with LogBus(ours) as bus:
        for _, can_id, data, _ in written:
            message = bus.recv(0)
            assert message is not None
            assert (message.is_fd, message.bitrate_switch, bytes(message.data)) == (
                bool(can_id & FD_FRAME),
                bool(can_id & FD_FRAME),
                data,
            )


@pytest.mark.parametrize("name", ["a.blf", "a.asc", "a.log"])
def test_can_fd_logs_of_other_tools_are_read(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    with can.Logger(path) as log:
        for k in range(50):
            log(can.Message(timestamp=k * 0.002, arbitration_id=0x80, is_extended_id=False, data=bytes([k % 10])))
            log(
                can.Message(
                    timestamp=k * 0.002 + 1e-4, arbitration_id=0x181, is_extended_id=False, is_fd=True,
                    bitrate_switch=True, data=bytes(12 if k % 2 else 4),
                )
            )  # fmt: skip
    frames = read_frames(path)
    assert frames.can_id.tolist() == [0x80, 0x181 | FD_FRAME] * 50
    assert frames.length.tolist() == [1, 4, 1, 12] * 25


def test_a_log_of_fd_frames_cut_anywhere_gives_back_what_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "bus.blf"
    with BusLogWriter(path) as writer:
        for k in range(300):
            writer.frame(k * 1000, 0x181 | FD_FRAME if k % 3 else 0x80, os.urandom(16 if k % 3 else 1), False)
            if k % 100 == 99:
                writer.flush()
    whole, data = list(logged(read_frames(path))), path.read_bytes()
    most = 0
    for cut in range(144, len(data), 97):
        path.write_bytes(data[:cut])
        try:
            found = list(logged(read_frames(path)))
        except InputFileError:
            found = []
        assert found == whole[: len(found)]
        assert len(found) >= most
        most = len(found)
    assert most > 200


def test_long_frames_are_kept_among_short_ones(tmp_path: Path) -> None:
    with BusLogWriter(tmp_path / "fd.blf") as writer:
        writer.frame(0, 0x181, b"12345678", False)
        writer.frame(1_000_001, 0x182, bytes(range(64)), True)
        writer.frame(2_000_003, 0x183, b"", False)
    frames = read_frames(tmp_path / "fd.blf")
    assert frames.t_ns.tolist() == [0, 1_000_001, 2_000_003]
    assert frames.length.tolist() == [8, 64, 0]
    assert bytes(frames.data[1]) == bytes(range(64))
    assert frames.sent.tolist() == [False, True, False]


@pytest.mark.parametrize(("name", "first_s"), [("a.blf", 1.7e9), ("a.asc", 0.0), ("a.log", 1.7e9), ("a.trc", 0.0)])
def test_logs_of_other_tools_are_read(tmp_path: Path, name: str, first_s: float) -> None:
    path = tmp_path / name
    with can.Logger(path) as log:
        log(can.Message(timestamp=first_s, arbitration_id=0x80, is_extended_id=False, data=b""))
        for k in range(1, 100):
            log(can.Message(timestamp=first_s + k * 0.004, arbitration_id=0x181, is_extended_id=False, data=bytes(8)))
        log(can.Message(timestamp=first_s + 0.4, is_error_frame=True))
        log(can.Message(timestamp=first_s + 0.4, arbitration_id=0x12345678, is_extended_id=True, data=b"ab"))
    frames = read_frames(path)
    assert len(frames) == 101
    assert np.abs(frames.t_ns[:100] - frames.t_ns[0] - np.arange(100) * 4_000_000).max() <= 1000
    assert 0 <= frames.t_ns[0] < 1_000_000_000
    assert frames.can_id[0] == 0x80
    assert frames.can_id[-1] == 0x12345678 | EXTENDED


def test_a_gzipped_text_log_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.log.gz"
    path.write_bytes(gzip.compress(b"(1700000000.000000) can0 181#0102\n(1700000000.001000) can0 182#\n"))
    assert read_frames(path).t_ns.tolist() == [0, 1_000_000]


def test_a_log_cut_anywhere_gives_back_what_is_whole(tmp_path: Path) -> None:
    block = rows(400)
    write(tmp_path / "bus.blf", block[:100], block[100:250], block[250:])
    data = (tmp_path / "bus.blf").read_bytes()
    path, had = tmp_path / "cut.blf", []
    for cut in range(0, len(data), 61):
        path.write_bytes(data[:cut])
        try:
            frames = read_frames(path)
        except InputFileError as error:
            assert "cut.blf" in error.where
            had.append(0)
            continue
        same(frames, block[: len(frames)])
        assert frames.damage or len(frames) in (100, 250, 400), "a cut between containers cannot be seen"
        had.append(len(frames))
    assert had == sorted(had)
    assert had[-1] > 250


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from(["a.blf", "a.asc", "a.log", "a.trc"]))
def test_a_damaged_log_is_read_or_refused_never_worse(
    tmp_path_factory: pytest.TempPathFactory, seed: int, name: str
) -> None:
    dice = random.Random(seed)
    path = tmp_path_factory.mktemp("fuzz") / name
    with can.Logger(path) as log:
        for k in range(30):
            log(
                can.Message(timestamp=k * 0.001, arbitration_id=0x180 + k, is_extended_id=k % 2 == 0, data=bytes(k % 9))
            )
    data = bytearray(path.read_bytes())
    for _ in range(dice.randint(1, 5)):
        at = dice.randrange(len(data))
        data[at : at + dice.randint(0, 9)] = dice.randbytes(dice.randint(0, 9))
    path.write_bytes(data[: dice.choice([len(data), dice.randrange(len(data))])])
    try:
        read_frames(path)
    except InputFileError as error:
        assert name in error.where


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=400), st.sampled_from(["a.blf", "a.asc", "a.log", "a.trc", "a.db", "a.xyz", "a.log.gz"]))
def test_garbage_is_refused(tmp_path_factory: pytest.TempPathFactory, garbage: bytes, name: str) -> None:
    path = tmp_path_factory.mktemp("fuzz") / name
    path.write_bytes(garbage)
    with pytest.raises(InputFileError):
        read_frames(path)


def test_an_absent_log_is_refused(tmp_path: Path) -> None:
    for name in ("a.blf", "a.asc"):
        with pytest.raises(InputFileError, match="cannot be read: No such file"):
            read_frames(tmp_path / name)


KILLED = """
import sys, time
from pathlib import Path
from frictid_hil.recording.bus_log import BusLogWriter
writer = BusLogWriter(Path(sys.argv[1]))
for k in range(10**9):
    writer.frame(k * 1000, 0x181, k.to_bytes(8, "little"), False)
    if k % 50 == 49:
        writer.flush()
        print(k + 1, flush=True)
        time.sleep(0.001)
"""


@pytest.mark.slow
def test_what_was_flushed_survives_sigkill_and_python_can_reads_it_too(tmp_path: Path) -> None:
    path = tmp_path / "killed.blf"
    child = subprocess.Popen([sys.executable, "-c", KILLED, str(path)], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    flushed = [int(child.stdout.readline()) for _ in range(20)]
    time.sleep(0.002)
    os.kill(child.pid, signal.SIGKILL)
    rest = child.stdout.read().split()
    child.wait()
    least = int(rest[-1] if rest else flushed[-1])
    frames = read_frames(path)
    assert len(frames) >= least
    assert frames.t_ns.tolist() == [k * 1000 for k in range(len(frames))]
    with can.LogReader(path) as reader:
        assert sum(1 for _ in reader) >= least


def test_a_full_disk_keeps_what_was_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "full.blf"
    writer = BusLogWriter(path)
    writer.append(rows(100))
    writer.flush()

    class FullFile:
        def __init__(self, file: object) -> None:
            self.file = file

        def write(self, data: bytes) -> int:
            raise OSError(28, "No space left on device")

        def __getattr__(self, name: str) -> object:
            return getattr(self.file, name)

    monkeypatch.setattr(writer._file, "_file", FullFile(writer._file._file))
    writer.append(rows(100))
    with pytest.raises(FrictidError, match="disk is full"):
        writer.flush()
    assert len(read_frames(path)) == 100
    with pytest.raises(FrictidError, match="cannot be written"):
        BusLogWriter(tmp_path / "absent" / "bus.blf")


def test_a_frame_beyond_64_bytes_is_damage_and_no_frame(tmp_path):
    lines = [";$FILEVERSION=2.1", ";$STARTTIME=43008.9", ";$COLUMNS=N,O,T,B,I,d,R,L,D"]
    for k, length in enumerate((8, 100, 8)):
        lines.append(f"{k + 1:7d} {k:13.3f} DT  1     0181 Rx -  {length:3d}  {' '.join(['2A'] * length)}")
    path = tmp_path / "a.trc"
    path.write_text("\r\n".join(lines) + "\r\n")
    frames = read_frames(path)
    assert list(frames.length) == [8, 8] and frames.skipped == 1


@pytest.mark.parametrize("identifier", ["1FFFFFFFFFFFFx", "800"])
def test_an_identifier_that_no_wire_carries_is_skipped(tmp_path, identifier):
    lines = ["date Mon Nov 23 09:00:00.000 2026", "base hex  timestamps absolute", "internal events logged"]
    lines += [f" 0.00{n} 1  {name}             Rx   d 2 01 02" for n, name in enumerate(("181", identifier, "182"))]
    path = tmp_path / "bus.asc"
    path.write_text("\n".join(lines) + "\n")
    frames = read_frames(path)
    assert list(frames.can_id) == [0x181, 0x182] and frames.skipped == 1
