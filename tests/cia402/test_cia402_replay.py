"""A log gives the rows of the live run bit for bit; what is missing, doubled or foreign is counted."""

from __future__ import annotations

import json
import math
import struct

from cia402_wire import HandClock, ScriptedDrive, WireBus, robot
from hypothesis import given
from hypothesis import strategies as st

from frictid_drivers.cia402 import Cia402Driver, FrameMap
from frictid_drivers.cia402.logs import LogDecoder
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import SetPoint

TWO = {
    "schema": "frictid.frames/1",
    "joints": {
        "0": {
            "node": 1,
            "position_rad_per_unit": 1e-6,
            "velocity_rad_s_per_unit": 1e-3,
            "torque_nm_per_unit": 0.1,
            "reports": [
                {"cob_id": 0x181, "objects": ["6041:00 u16", "6064:00 i32"]},
                {"cob_id": 0x281, "objects": ["606C:00 i32", "6077:00 i16"]},
            ],
            "commands": [{"cob_id": 0x201, "objects": ["6040:00 u16", "607A:00 i32"]}],
        }
    },
}


def copied(row):
    return row.t_ns, [
        (
            report.t_ns,
            report.position_rad,
            report.velocity_rad_s,
            report.torque_nm,
            report.status_raw,
            report.age_cycles,
        )
        for report in row.feedback
    ]


def fast(t_ns, position):
    return [
        (t_ns, 0x80, b""),
        (t_ns + 1, 0x181, struct.pack("<Hi", 0x0237, position)),
        (t_ns + 2, 0x281, struct.pack("<ih", position * 2, 3)),
    ]


def test_live_run_and_log_agree_bit_for_bit():
    """Two joints, power on, motion, a late report, a lost report, a second stretch of cycling."""
    drives = ScriptedDrive(1), ScriptedDrive(2)
    bus = WireBus(*drives)
    clock = HandClock(bus)
    driver = Cia402Driver(robot(1, 2, direction=-1), bus_factory=lambda: bus, clock=clock)
    log, live = [], []
    driver.open(lambda t_ns, can_id, data, sent: log.append((t_ns, can_id, data)))
    set_points = [SetPoint(), SetPoint()]
    for active in ("0", "1"):
        driver.configure(1000.0, [active])
        driver.start_cycling()
        for cycle in range(400):
            clock.wait_until(clock.now_ns() + 1_000_000)
            if cycle == 120:
                driver.enable("0", Mode.POSITION)
                driver.enable("1", Mode.POSITION)
            set_points[0].position_rad = 0.1 * math.sin(cycle / 30)
            drives[0].mute = cycle % 50 == 7
            if cycle % 50 == 8:
                bus.put(0x181, struct.pack("<Hih", 0x0237, 77, 1))
                bus.put(0x281, struct.pack("<i", 5))
            for drive in drives:
                drive.values[0x606C, 0], drive.values[0x6077, 0] = cycle * 991, -cycle
            feedback = driver.exchange(set_points)
            live.append(copied(type("Row", (), {"t_ns": clock.now_ns(), "feedback": feedback})))
        for drive in drives:
            drive.values[0x606C, 0] = 0
        driver.stop_cycling()
    described = json.loads(json.dumps(driver.frame_map().to_mapping()))
    rows = [copied(row) for row in LogDecoder(FrameMap.from_mapping(described)).rows(log)]
    # Each stretch begins at 1 ms; stop_cycling goes on for a while after the last exchange of the test.
    starts = [at for at, row in enumerate(rows) if row[0] == 1_000_000]
    assert len(starts) == 2
    assert rows[starts[0] : starts[0] + 400] == live[:400]
    assert rows[starts[1] : starts[1] + 400] == live[400:]
    assert {row[1][0][-1] for row in live} >= {0, 1} and any(row[1][0][1] > 0.05 for row in live)


def test_commands_of_a_row_are_those_its_sync_put_into_force():
    log = []
    for cycle in range(3):
        t_ns = cycle * 1000
        log.append((t_ns, 0x201, struct.pack("<Hi", 0x0F, cycle * 10)))
        log += fast(t_ns, cycle)
    rows = LogDecoder(FrameMap.from_mapping(TWO)).rows(log)
    assert [row.commands.position_rad[0] for row in rows] == [0.0, 10 * 1e-6, 20 * 1e-6]


def test_missing_doubled_and_foreign_frames_are_counted():
    log = [*fast(0, 1), *fast(1000, 2), *fast(2000, 3), *fast(3000, 4)]
    del log[4]  # the position of the second row
    log.insert(7, log[6])
    log += [(4000, 0x583, b""), (4001, 0x583, b""), (4002, 0x77F, b"\x05"), (4003, 0x321, b""), (10, 1 << 31 | 5, b"")]
    decoder = LogDecoder(FrameMap.from_mapping(TWO))
    ages = [row.feedback[0].age_cycles for row in decoder.rows(log)]
    assert ages == [0, 1, 0, 0]
    assert decoder.repeated == 1 and decoder.backwards == 1
    assert decoder.unknown == {
        "SDO answer of node 3": 2,
        "heartbeat of node 127": 1,
        "frame 0x321": 1,
        "extended frame 0x00000005": 1,
    }


def test_a_sync_that_repeats_its_counter():
    """Before any report it is a doubled frame, after the reports it is a quick stop's: neither makes a row."""
    log = [(t_ns, can_id, bytes([1 + at // 3]) if can_id == 0x80 else data)
           for at, (t_ns, can_id, data) in enumerate([*fast(0, 1), *fast(1000, 2), *fast(2000, 3)])]  # fmt: skip
    log.insert(1, log[0])
    log[7:7] = [(1003, 0x80, b"\x02"), *fast(1003, 99)[1:]]
    rows = [copied(row) for row in LogDecoder(FrameMap.from_mapping(TWO)).rows(log)]
    assert [(row[0], row[1][0][1], row[1][0][-1]) for row in rows] == [
        (0, 1 * 1e-6, 0),
        (1000, 2 * 1e-6, 0),
        (2000, 3 * 1e-6, 0),
    ]


def test_without_sync_a_row_begins_where_a_report_comes_again():
    mapping = {**TWO, "sync_cob_id": None}
    log = [frame for cycle in range(5) for frame in fast(cycle * 1000, cycle)[1:]]
    rows = [copied(row) for row in LogDecoder(FrameMap.from_mapping(mapping)).rows(log)]
    assert [row[0] for row in rows] == [1, 1001, 2001, 3001, 4001]
    assert [row[1][0][1] for row in rows] == [cycle * 1e-6 for cycle in range(5)]


def test_an_empty_log_has_no_rows():
    assert list(LogDecoder(FrameMap.from_mapping(TWO)).rows([])) == []


frames = st.tuples(
    st.integers(0, 1 << 62),
    st.one_of(st.sampled_from([0, 0x80, 0x81, 0x181, 0x281, 0x201, 0x701]), st.integers(0, (1 << 32) - 1)),
    st.binary(max_size=8),
)


@given(st.lists(frames, max_size=40), st.sampled_from([0x80, None]), st.sampled_from([0, 700_000]))
def test_whatever_a_log_holds(log, sync, window_ns):
    mapping = {**TWO, "sync_cob_id": sync, "window_ns": window_ns}
    decoder = LogDecoder(FrameMap.from_mapping(mapping))
    for row in decoder.rows(log):
        for report in row.feedback:
            assert not report.valid or math.isfinite(report.position_rad)
