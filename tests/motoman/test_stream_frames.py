"""Frames of the streaming extension: the published one, both codecs against each other, and garbage."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from serial_bench import make_bench

from frictid_drivers.motoman import stream_frames as host
from frictid_drivers.motoman.emulator import jobs
from frictid_drivers.motoman.emulator.streaming import StreamApplication
from frictid_drivers.motoman.stream_frames import Flag, FrameReader, Nack, Stopped, TickReport, Welcome

GOLDEN = bytes.fromhex("a55a11080100070164 00f4010000 5b39".replace(" ", ""))


def test_check_value_of_the_crc_on_both_sides() -> None:
    assert host.crc16(b"123456789") == jobs.crc16(b"123456789") == 0x29B1


def test_golden_set_point_as_the_driver_writes_it() -> None:
    assert host.encode_set_point(1, 7, 1, 100, [500]) == GOLDEN


@pytest.mark.parametrize(("axes", "set_point", "feedback"), [(1, 16, 36), (6, 36, 96)])
def test_sizes_of_the_published_table(axes: int, set_point: int, feedback: int) -> None:
    assert host.set_point_bytes(axes) == set_point
    assert host.feedback_bytes(axes) == feedback
    assert len(host.encode_set_point(1, 1, (1 << axes) - 1, 0, [0] * axes)) == set_point


class Application:
    """The emulator's end, its frames collected."""

    def __init__(self, axes: int) -> None:
        self.said: list[bytes] = []
        self.emulator = make_bench(axes=axes).emulator
        self.emulator.panel.power(True)
        self.app = StreamApplication(
            self.emulator.panel,
            (1 << axes) - 1,
            lambda kind, frame: self.said.append(frame),
            lambda: None,
        )

    def heard(self, frame: bytes) -> list[host.Frame]:
        self.said.clear()
        self.app.hear(frame)
        return FrameReader().take(b"".join(self.said))


def test_golden_set_point_as_the_emulator_reads_it() -> None:
    side = Application(1)
    side.emulator.axes[0].issued = 480
    side.app.tick_number = 90
    (welcome,) = side.heard(host.encode_hello(0, 7, 1))
    assert isinstance(welcome, Welcome)
    assert side.heard(GOLDEN) == []
    side.app.tick_number = 98
    side.app.tick(0)
    assert side.emulator.axes[0].issued == 500


def test_what_the_emulator_says_is_what_the_driver_reads() -> None:
    side = Application(2)
    (welcome,) = side.heard(host.encode_hello(0, 9, 3))
    assert isinstance(welcome, Welcome)
    assert (welcome.session, welcome.axis_mask, welcome.tick_us, welcome.averaging_ms) == (9, 3, 4000, 0)
    plate = side.emulator.axes[0].plate
    assert welcome.limits[1] == host.AxisLimits(plate.lowest, plate.highest, plate.step)
    side.said.clear()
    side.app.tick(0)
    (report,) = FrameReader().take(side.said[0])
    assert isinstance(report, TickReport)
    assert (report.tick, report.session, report.axis_mask, report.flags) == (1, 9, 3, Flag(0))
    assert report.axes[0].pulses == side.emulator.axes[0].pulses
    assert side.heard(host.encode_stop(1, 9, leave=True)) == [Stopped(9, True)]
    (nack,) = side.heard(host.encode_set_point(2, 8, 3, 50, [0, 0]))
    assert isinstance(nack, Nack)
    assert (nack.reason, nack.refused_seq, nack.due_tick) == ("session", 2, 50)


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (host.encode_set_point(1, 9, 1, 3, [11459]), None),
        (host.encode_set_point(1, 9, 1, 1, [11459]), "late"),
        (host.encode_set_point(1, 9, 1, 3, [60000]), "limit"),
        (host.encode_set_point(1, 9, 1, 3, [12459]), "limit"),
        (host.encode_set_point(1, 8, 1, 3, [11459]), "session"),
        (host.encode_set_point(3, 9, 1, 3, [11459]), "gap"),
        (host.encode_set_point(0xFFFF, 9, 1, 3, [11459]), "gap"),
        (host.encode_set_point(1, 9, 1, 3, [11459])[:-1] + b"\x00", "crc"),
    ],
)
def test_refusals_name_their_reason(frame: bytes, reason: str | None) -> None:
    side = Application(1)
    side.heard(host.encode_hello(0, 9, 1))
    answers = side.heard(frame)
    assert [answer.reason for answer in answers if isinstance(answer, Nack)] == ([reason] if reason else [])


def test_another_version_is_refused() -> None:
    side = Application(1)
    body = bytes([2 << 4 | 4, 4, 0, 0, 2, 2, 1, 5])
    (nack,) = side.heard(b"\xa5\x5a" + body + host.crc16(body).to_bytes(2, "little"))
    assert isinstance(nack, Nack)
    assert nack.reason == "version"


def test_an_old_session_cannot_be_opened_again() -> None:
    side = Application(1)
    side.heard(host.encode_hello(0, 9, 1))
    side.heard(host.encode_hello(0, 10, 1))
    (nack,) = side.heard(host.encode_hello(0, 9, 1))
    assert isinstance(nack, Nack)
    assert nack.reason == "session"


def feedback_frame(tick: int, pulses: int) -> bytes:
    payload = struct.pack("<IHBBHBBBBHiii", tick, 0, 0, 0, 0, 0, 0, 1, 1, 0, pulses, 0, 0)
    return host.encode_frame(host.FrameType.FEEDBACK, tick, payload)


@given(
    st.lists(st.tuples(st.binary(max_size=30), st.integers(0, 2**32 - 1), st.integers(-(2**31), 2**31 - 1))), st.data()
)
def test_every_frame_is_found_between_any_garbage_in_any_portions(
    parts: list[tuple[bytes, int, int]], data: st.DataObject
) -> None:
    # Garbage that holds the start of a frame may swallow what follows until its length has come; leave that out here.
    stream = b"".join(garbage.replace(b"\xa5", b"") + feedback_frame(tick, pulses) for garbage, tick, pulses in parts)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=10)))
    reader, frames = FrameReader(), list[host.Frame]()
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        frames += reader.take(stream[start:end])
    found = [(frame.tick, frame.axes[0].pulses) for frame in frames if isinstance(frame, TickReport)]
    assert found == [(tick, pulses) for _, tick, pulses in parts]


@given(st.integers(0, 35), st.integers(1, 255))
def test_a_damaged_frame_is_dropped_and_those_behind_it_are_found(position: int, damage: int) -> None:
    frames = [feedback_frame(tick, 7 * tick) for tick in range(12)]
    broken = bytearray(frames[0])
    broken[position] ^= damage
    got = FrameReader().take(bytes(broken) + b"".join(frames[1:]))
    ticks = [frame.tick for frame in got if isinstance(frame, TickReport)]
    assert ticks == list(range(1, 12))


@given(st.binary(max_size=400))
def test_arbitrary_bytes_never_raise(garbage: bytes) -> None:
    FrameReader().take(garbage)
