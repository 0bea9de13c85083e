import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from frictid_hil.errors import UsageError
from frictid_hil.protocol.driver import by_the_batch
from frictid_hil.runner.ring import FRAME_ROW, PACK_FRAME, PACK_SAMPLE, SAMPLE_ROW, Ring, frame_ring, sample_ring
from frictid_hil.runner.scheduler import Recorder
from frictid_hil.runs import run


def fill(ring: Ring, first: int, count: int) -> None:
    for k in range(first, first + count):
        ring.append(k, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8, 9, 10)


def test_packed_rows_are_what_the_dtype_says() -> None:
    assert PACK_SAMPLE.size == SAMPLE_ROW.itemsize
    assert PACK_FRAME.size == FRAME_ROW.itemsize


def test_rows_come_out_in_order_across_the_wrap() -> None:
    ring = Ring(SAMPLE_ROW, PACK_SAMPLE, 8)
    seen: list[int] = []
    for first in range(0, 60, 6):
        fill(ring, first, 6)
        seen.extend(ring.drain()["t_ns"].tolist())
    assert seen == list(range(60))
    assert ring.dropped == 0


def test_a_full_ring_drops_and_counts_instead_of_overwriting() -> None:
    ring = Ring(SAMPLE_ROW, PACK_SAMPLE, 8)
    fill(ring, 0, 11)
    assert ring.dropped == 3
    assert ring.drain()["t_ns"].tolist() == list(range(8))
    fill(ring, 20, 2)
    assert ring.drain()["t_ns"].tolist() == [20, 21]


def test_a_row_that_has_not_arrived_as_a_whole_waits_and_those_after_it_too() -> None:
    """Whatever order the stores of a writer become visible in, here by taking some bytes away again."""
    with Ring(SAMPLE_ROW, PACK_SAMPLE, 4, shared=True) as ring:
        fill(ring, 0, 3)
        assert ring.drain().size == 3
        fill(ring, 3, 3)
        late = 64 + (4 % 4) * SAMPLE_ROW.itemsize + 8
        there, ring._buffer[late : late + 8] = bytes(ring._buffer[late : late + 8]), bytes(8)
        assert ring.drain()["t_ns"].tolist() == [3]
        assert ring.drain().size == 0
        ring._buffer[late : late + 8] = there
        assert ring.drain()["t_ns"].tolist() == [4, 5]
        assert ring.drained == 6


def test_columns_keep_their_values() -> None:
    ring = Ring(SAMPLE_ROW, PACK_SAMPLE, 8)
    fill(ring, 0, 1)
    (row,) = ring.drain()
    assert list(row.item())[1:] == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8, 9, 10]


def test_another_process_could_attach_by_name() -> None:
    ours = Ring(SAMPLE_ROW, PACK_SAMPLE, 16, shared=True)
    theirs = Ring(SAMPLE_ROW, PACK_SAMPLE, 16, name=ours.name)
    fill(theirs, 0, 3)
    assert ours.drain()["t_ns"].tolist() == [0, 1, 2]
    theirs.close()
    ours.close()
    with pytest.raises(FileNotFoundError):
        Ring(SAMPLE_ROW, PACK_SAMPLE, 16, name="psm_no_such_ring")


def test_leaving_a_with_by_an_error_lets_go_of_shared_memory() -> None:
    with pytest.raises(OSError, match="disk full"), sample_ring(8, shared=True) as ring:
        name = ring.name
        fill(ring, 0, 3)
        raise OSError("disk full")
    with pytest.raises(FileNotFoundError):
        sample_ring(name=name)
    ring.close()


def test_a_run_that_ends_before_its_first_cycle_lets_go_of_its_rings(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def noted(*, shared: bool) -> Ring:
        ring = sample_ring(8, shared=shared)
        made.append(ring.name)
        return ring

    def absent_hand(driver: object) -> None:
        raise UsageError("no hand")

    wall_clock = SimpleNamespace(clock=SimpleNamespace(lock_step=False))
    monkeypatch.setattr(run, "new_driver", lambda name, setup: wall_clock)
    monkeypatch.setattr(run, "sample_ring", noted)
    monkeypatch.setattr(run, "frame_ring", noted)
    nothing: Any = None
    with pytest.raises(UsageError, match="no hand"):
        run.run_plan("x", nothing, nothing, nothing, notify=nothing, proceed=nothing, prepare=absent_hand)
    assert len(made) == 2
    for name in made:
        with pytest.raises(FileNotFoundError):
            sample_ring(name=name)


def test_frames_keep_their_bytes() -> None:
    ring = frame_ring(4)
    ring.append(5, 0x181, 3, True, 0, b"\x01\x02\x03")
    (row,) = ring.drain()
    assert (int(row["can_id"]), int(row["length"]), int(row["sent"])) == (0x181, 3, 1)
    assert bytes(row["data"])[:3] == b"\x01\x02\x03"
    assert np.dtype(FRAME_ROW).itemsize == 80


@pytest.mark.parametrize("shared", [False, True])
def test_frames_by_the_batch_are_what_they_are_one_by_one(shared: bool) -> None:
    """Across the wrap, and where only some of a batch find room."""
    with frame_ring(8, shared=shared) as batches, frame_ring(8, shared=shared) as singles:
        for t_ns, count, drain in (
            (1, 3, True),
            (2, 3, False),
            (3, 3, True),
            (4, 5, False),
            (5, 5, True),
            (6, 0, True),
        ):
            frames = [(0x180 + number, bytes(range(number))) for number in range(count)]
            batches.extend(t_ns, frames, sent=t_ns % 2 == 0)
            for can_id, data in frames:
                singles.append(t_ns, can_id, len(data), t_ns % 2 == 0, 0, data)
            if drain:
                assert batches.drain().tobytes() == singles.drain().tobytes()
        assert batches.dropped == singles.dropped == 2
        assert batches.drained == singles.drained == 17


def test_a_sink_without_a_way_for_batches_hears_frame_by_frame() -> None:
    heard: list[tuple[int, int, bytes, bool]] = []
    by_the_batch(lambda *frame: heard.append(frame))(7, [(1, b"a"), (2, b"")], True)
    assert heard == [(7, 1, b"a", True), (7, 2, b"", True)]
    recorder = Recorder(sample_ring(4), frame_ring(4), offset_ns=100)
    by_the_batch(recorder)(7, [(1, b"a")], True)
    recorder(8, 2, b"b", False)
    assert [(int(row["t_ns"]), int(row["can_id"]), int(row["sent"])) for row in recorder.frames.drain()] == [
        (107, 1, 1), (108, 2, 0),
    ]  # fmt: skip
    by_the_batch(None)(7, [(1, b"a")], True)


APPEND_MANY = """
import sys
from frictid_hil.runner.ring import frame_ring
ring = frame_ring(name=sys.argv[1])
for k in range(int(sys.argv[2])):
    ring.append(k, 0, 8, 0, 0, b"")
ring.close()
"""


@pytest.mark.slow
def test_a_reader_in_another_process_gets_every_row_once_and_in_order() -> None:
    """The reader looks as often as it can, also in the midst of a write."""
    rows = 250_000
    with frame_ring(shared=True) as ring:
        read_while_another_writes(ring, rows)


def read_while_another_writes(ring: Ring, rows: int) -> None:
    writer = subprocess.Popen([sys.executable, "-c", APPEND_MANY, ring.name, str(rows)])
    expected = 0
    while True:
        ended = writer.poll() is not None
        taken = ring.drain()["t_ns"]
        if taken.size:
            assert taken[0] == expected and taken[-1] == expected + taken.size - 1
            assert np.all(np.diff(taken) == 1)
            expected += taken.size
        elif ended:
            break
    assert (writer.returncode, expected, ring.dropped) == (0, rows, 0)
