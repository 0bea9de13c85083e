"""The decoder: whole rows or none, garbage marked and survived, emergencies at once."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from frictid_drivers.cia402.codec import Command, CommandDecoder, Decoder
from frictid_drivers.cia402.frame_map import FrameMap
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import Feedback, JointState

RAD, RAD_S, NM = 4.79e-7, -1.05e-6, 0.0852


def joint(node):
    return {
        "node": node,
        "position_rad_per_unit": RAD,
        "velocity_rad_s_per_unit": RAD_S,
        "torque_nm_per_unit": NM,
        "temperature_c_per_unit": 0.1,
        "reports": [
            {"cob_id": 0x180 + node, "objects": ["6041:00 u16", "6064:00 i32", "6077:00 i16"]},
            {"cob_id": 0x280 + node, "objects": ["606C:00 i32"]},
            {"cob_id": 0x380 + node, "objects": ["6061:00 i8", "603F:00 u16", "2031:00 i16 temperature"]},
        ],
        "commands": [
            {"cob_id": 0x200 + node, "objects": ["6040:00 u16", "607A:00 i32", "60B2:00 i16"]},
            {"cob_id": 0x300 + node, "objects": ["6060:00 i8", "6071:00 i16", "60FF:00 i32"]},
        ],
    }


FRAMES = FrameMap.from_mapping({"schema": "frictid.frames/1", "joints": {"0": joint(1), "1": joint(2)}})


def first(status=0x1237, position=1000, torque=-20):
    return struct.pack("<Hih", status, position, torque)


def second(velocity=500):
    return struct.pack("<i", velocity)


def test_a_whole_row():
    decoder = Decoder(FRAMES, ["0"])
    decoder.begin(7_000_000)
    assert decoder.missing == 2
    assert decoder.feed(7_000_100, 0x181, first()) and decoder.feed(7_000_200, 0x281, second())
    assert decoder.missing == 0
    moved, other = decoder.finish()
    assert (moved.t_ns, moved.age_cycles, moved.valid) == (7_000_000, 0, True)
    assert (moved.position_rad, moved.velocity_rad_s, moved.torque_nm) == (1000 * RAD, 500 * RAD_S, -20 * NM)
    assert moved.state is JointState.ENABLED and moved.status_raw == 0x1237
    assert not other.valid and other.age_cycles == 2 and math.isnan(other.position_rad)
    assert decoder.position_units(0) == 1000 and decoder.position_units(1) is None


def test_half_a_row_changes_no_figure_but_the_status_counts():
    decoder = Decoder(FRAMES, ["0"])
    decoder.begin(1)
    decoder.feed(1, 0x181, first())
    decoder.feed(1, 0x281, second())
    decoder.finish()
    decoder.begin(2)
    decoder.feed(2, 0x181, first(status=0x0008, position=2000))
    feedback = decoder.finish()[0]
    assert (feedback.t_ns, feedback.age_cycles, feedback.position_rad) == (1, 1, 1000 * RAD)
    assert feedback.state is JointState.FAULT


def test_reports_of_different_syncs_are_never_mixed():
    decoder = Decoder(FRAMES, ["0"])
    decoder.begin(1)
    decoder.feed(1, 0x181, first(position=1))
    decoder.finish()
    decoder.begin(2)
    decoder.feed(2, 0x281, second())
    assert not decoder.finish()[0].valid


def test_late_reports_keep_their_own_time():
    decoder = Decoder(FRAMES, ["0"])
    decoder.begin(10)
    decoder.finish()
    decoder.feed(19, 0x181, first())
    decoder.feed(19, 0x281, second())
    decoder.begin(20)
    feedback = decoder.finish()[0]
    assert (feedback.t_ns, feedback.age_cycles, feedback.valid) == (10, 1, True)


def test_a_repeated_report_is_counted_once():
    decoder = Decoder(FRAMES, ["0"])
    decoder.begin(1)
    decoder.feed(1, 0x181, first())
    decoder.feed(1, 0x181, first())
    assert decoder.missing == 1


def test_slow_figures_and_emergencies_are_taken_at_once():
    decoder = Decoder(FRAMES)
    decoder.begin(1)
    decoder.feed(1, 0x381, struct.pack("<bHh", 8, 0, 312))
    feedback = decoder.feedback[0]
    assert feedback.mode is Mode.POSITION and feedback.temperature_c == 312 * 0.1
    decoder.feed(1, 0x081, bytes.fromhex("1086 01 0000000000"))
    assert feedback.error_code == 0x8610
    decoder.feed(1, 0x081, bytes(8))
    assert feedback.error_code == 0
    decoder.feed(1, 0x081, b"\x01")
    assert feedback.error_code == 0x1000
    decoder.feed(1, 0x381, struct.pack("<bHh", 3, 0, 0))
    assert feedback.mode is Mode.NONE and feedback.error_code == 0


def test_heartbeats_and_boot_up():
    decoder = Decoder(FRAMES)
    assert decoder.heartbeat_ns(0) is None
    assert decoder.feed(5, 0x701, b"\x05") and decoder.heartbeat_ns(0) == 5 and not decoder.restarted(0)
    assert decoder.feed(9, 0x701, b"\x00") and decoder.restarted(0) and not decoder.restarted(1)


def test_a_short_report_marks_the_joint_until_the_next_whole_one():
    decoder = Decoder(FRAMES, ["0"])
    decoder.begin(1)
    assert decoder.feed(1, 0x181, first()[:7])
    decoder.feed(1, 0x281, second())
    assert not decoder.finish()[0].valid and decoder.missing == 1
    decoder.begin(2)
    decoder.feed(2, 0x181, first() + b"more")
    decoder.feed(2, 0x281, second())
    assert decoder.finish()[0].valid


def test_restart_forgets_everything_but_the_objects():
    decoder = Decoder(FRAMES, ["0"])
    kept = decoder.feedback[0]
    decoder.begin(5)
    decoder.feed(5, 0x181, first())
    decoder.feed(5, 0x281, second())
    decoder.feed(5, 0x701, b"\x00")
    decoder.finish()
    decoder.restart()
    assert decoder.feedback[0] is kept and repr(kept) == repr(Feedback())
    assert decoder.position_units(0) is None and decoder.heartbeat_ns(0) is None and not decoder.restarted(0)


ids = st.one_of(st.sampled_from([0x181, 0x281, 0x381, 0x182, 0x282, 0x081, 0x701, 0x80]), st.integers(0, 0x7FF))


@given(st.lists(st.one_of(st.tuples(ids, st.binary(max_size=8)), st.sampled_from(["begin", "finish"])), max_size=40))
def test_whatever_the_wire_brings(events):
    decoder = Decoder(FRAMES, ["0"])
    for t_ns, event in enumerate(events):
        if event == "begin":
            decoder.begin(t_ns)
        elif event == "finish":
            decoder.finish()
        else:
            decoder.feed(t_ns, *event)
        for feedback in decoder.feedback:
            assert isinstance(feedback.state, JointState) and isinstance(feedback.mode, Mode)
            if feedback.valid:
                assert math.isfinite(feedback.position_rad) and math.isfinite(feedback.velocity_rad_s)


@given(
    st.integers(0, 0xFFFF),
    st.integers(-(1 << 31), (1 << 31) - 1),
    st.integers(-(1 << 15), (1 << 15) - 1),
    st.integers(-(1 << 31), (1 << 31) - 1),
)
def test_figures_are_exactly_units_times_factor(status, position, torque, velocity):
    decoder = Decoder(FRAMES, ["1"])
    decoder.begin(3)
    decoder.feed(3, 0x182, first(status, position, torque))
    decoder.feed(3, 0x282, second(velocity))
    feedback = decoder.finish()[1]
    assert (feedback.position_rad, feedback.torque_nm) == (position * RAD, torque * NM)
    assert feedback.velocity_rad_s == velocity * RAD_S


def test_commands_there_and_back():
    command = Command(FRAMES.joints[0].commands[0])
    command.set("controlword", 0x0F)
    command.set("target_position", -123456)
    command.set("torque_offset", 77)
    command.set("target_velocity", 5)  # not in this frame
    read = CommandDecoder(FRAMES)
    assert read.feed(0x201, command.pack())
    assert (read.position_rad[0], read.torque_offset_nm[0]) == (-123456 * RAD, 77 * NM)
    assert math.isnan(read.position_rad[1]) and not read.feed(0x181, b"")
    assert read.feed(0x201, b"\x00")  # too short: kept as it was
    assert read.position_rad[0] == -123456 * RAD


@pytest.mark.parametrize(("value", "stored"), [(40_000, 32_767), (-40_000, -32_768), (12, 12)])
def test_commands_are_cut_to_their_type(value, stored):
    command = Command(FRAMES.joints[0].commands[0])
    command.set("torque_offset", value)
    assert struct.unpack("<Hih", command.pack())[2] == stored
