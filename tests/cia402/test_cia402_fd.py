"""CAN FD: the robot file's options, how interfaces are told, which frames are FD ones, drives that do not join in."""

from __future__ import annotations

import os
from dataclasses import replace

import can
import pytest
from cia402_bench import Bench, bench, hp3j
from cia402_wire import OBJECTS, ScriptedDrive

from frictid_drivers.cia402.logs import LogDecoder
from frictid_drivers.virtual import VirtualDriver
from frictid_hil.errors import HardwareError, InvalidFields, PlanRefused
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol import can_bus
from frictid_hil.protocol.driver import FD_FRAME, SetPoint

FD = {"fd": True, "data_bitrate": 4_000_000}
PDOS = {base + node for base in (0x180, 0x280, 0x380, 0x480, 0x200, 0x300) for node in range(1, 7)}


@pytest.mark.parametrize(
    ("options", "key", "words"),
    [
        ({"fd": "yes"}, "fd", "true or false"),
        ({"data_bitrate": 4_000_000}, "data_bitrate", "without `fd: true`"),
        ({"fd": False, "pdo_bytes": 64}, "pdo_bytes", "without `fd: true`"),
        ({"fd": True, "data_bitrate": 500_000}, "data_bitrate", "below the bitrate of arbitration"),
        ({"fd": True, "data_bitrate": 12_000_000}, "data_bitrate", "10000..8000000"),
        ({"fd": True, "data_bitrate": 2e6}, "data_bitrate", "whole number"),
        ({"fd": True, "pdo_bytes": 65}, "pdo_bytes", "8..64"),
        ({"fd": True, "data_bit_rate": 2_000_000}, "data_bit_rate", "did you mean data_bitrate"),
    ],
)
def test_what_contradicts_itself_is_named(options, key, words):
    with pytest.raises(InvalidFields) as caught:
        bench(1, options=options)
    assert [(problem.path, words in problem.message) for problem in caught.value.problems] == [(("options", key), True)]


def test_the_object_that_switches_a_drive_must_be_one():
    with pytest.raises(InvalidFields, match="2023:00 u8"):
        bench(1, options=FD, joint_options={"fd_object": "2023"})


# -- the bus ------------------------------------------------------------------------------------------------------


class Opened(can.BusABC):
    """Nothing but what it says it is."""

    def __init__(self, protocol):
        super().__init__(channel="fake")
        self.channel_info, self._can_protocol = "fake", protocol

    def send(self, msg, timeout=None):
        raise AssertionError


@pytest.fixture
def interfaces(monkeypatch):
    """python-can's vendor interfaces need hardware; ours stands in their place and keeps the arguments."""

    def opened(protocol):
        calls = []
        monkeypatch.setattr(can, "Bus", lambda **told: calls.append(told) or Opened(protocol))
        return calls

    return opened


@pytest.mark.parametrize("interface", ["socketcan", "udp_multicast", "ixxat", "neovi", "pcan", "kvaser", "vector"])
def test_every_family_of_interfaces_is_told_in_its_own_way(interfaces, interface):
    calls = interfaces(can.CanProtocol.CAN_FD)
    can_bus.open_bus(f"{interface}:absent", {"bitrate": 1_000_000, **FD})
    can_bus.open_bus(f"{interface}:absent", {"bitrate": 1_000_000})
    told, classical = calls
    timing = told.get("timing")
    if timing is not None:
        assert (timing.nom_bitrate, timing.data_bitrate, timing.f_clock) == (1_000_000, 4_000_000, 80_000_000)
        assert "bitrate" not in told
    else:
        assert told["fd"] is True
        assert interface in ("socketcan", "udp_multicast") or told["data_bitrate"] == 4_000_000
    assert not {"fd", "timing", "data_bitrate"} & set(classical)


def test_an_interface_without_can_fd_is_refused(interfaces):
    interfaces(can.CanProtocol.CAN_FD)
    with pytest.raises(HardwareError, match=r"robotell.*not known to speak CAN FD"):
        can_bus.open_bus("robotell:absent", FD)
    interfaces(can.CanProtocol.CAN_20)
    with pytest.raises(HardwareError, match="classical CAN frames only") as caught:
        can_bus.open_bus("socketcan:can7", FD)
    assert "dbitrate 4000000 fd on" in caught.value.next_step


def test_a_link_that_holds_8_bytes_is_refused(interfaces, monkeypatch, tmp_path):
    interfaces(can.CanProtocol.CAN_FD)
    monkeypatch.setattr(can_bus, "_LINKS", tmp_path)
    (tmp_path / "can7").mkdir()
    (tmp_path / "can7/mtu").write_text("16\n")
    with pytest.raises(HardwareError, match="classical CAN frames only"):
        can_bus.open_bus("socketcan:can7", FD)
    (tmp_path / "can7/mtu").write_text("72\n")
    can_bus.open_bus("socketcan:can7", FD)


def test_python_cans_own_bus_carries_fd_frames():
    with can_bus.open_bus("virtual:fd-test", FD) as first, can_bus.open_bus("virtual:fd-test", FD) as second:
        first.send(can.Message(arbitration_id=0x181, data=bytes(12), is_fd=True, is_extended_id=False))
        assert second.recv(1).is_fd


# -- traffic ------------------------------------------------------------------------------------------------------


def session(options, cycles=200, cycle_hz=500.0, **changes):
    """Six joints of the virtual HP3J, all reporting, held where they stand: bus log, rows and frame map."""
    robot = hp3j(**changes)
    robot = replace(robot, bus=f"virtual:cia402-fd-{os.getpid()}", options=options)
    driver, log = VirtualDriver(robot), []
    names = [joint.name for joint in robot.joints]
    try:
        driver.open(lambda *frame: log.append(frame))
        driver.configure(cycle_hz, names)
        driver.start_cycling()
        for name in names:
            driver.enable(name, Mode.POSITION)
        points = [SetPoint(position_rad=joint.locked_position_rad) for joint in robot.joints]
        rows = []
        for n in range(cycles):
            driver.clock.wait_until(round((n + 1) * 1e9 / cycle_hz))
            rows.append([(r.position_rad, r.torque_nm, r.velocity_rad_s) for r in driver.exchange(points)])
        frame_map = driver._host.frame_map()
        driver.stop_cycling()
    finally:
        driver.close()
    return log, rows, frame_map


@pytest.mark.slow
def test_pdos_are_fd_frames_and_nothing_else_is():
    log, rows, frame_map = session(FD)
    kinds = {}
    for _, can_id, data, _ in log:
        kinds.setdefault(can_id & ~FD_FRAME, set()).add((bool(can_id & FD_FRAME), len(data) > 8))
    assert {can_id for can_id, kind in kinds.items() if kind & {(True, True), (True, False)}} <= PDOS
    assert all(kind <= {(True, False), (True, True)} for can_id, kind in kinds.items() if can_id in PDOS)
    assert kinds[0x181] == {(True, True)} and kinds[0x201] == {(True, False)} and 0x281 not in kinds
    assert kinds[0x80] == kinds[0x601] == kinds[0x581] == kinds[0x701] == {(False, False)}
    assert [frame.size for frame in frame_map.joints[0].reports] == [16, 5]
    decoded = [
        [(r.position_rad, r.torque_nm, r.velocity_rad_s) for r in row.feedback]
        for row in LogDecoder(frame_map).rows((t_ns, can_id, data) for t_ns, can_id, data, _ in log)
    ]
    assert decoded[: len(rows)] == rows


@pytest.mark.slow
def test_fd_frames_change_no_figure():
    """The kind of frame is a matter of the wire: at a rate that both carry, the same joints report the same."""
    (_, classical, _), (_, fd, _) = (session(options, cycles=60, cycle_hz=200.0) for options in ({}, FD))
    assert classical == fd


def test_pdos_stay_short_where_the_drives_are():
    log, _, frame_map = session({**FD, "pdo_bytes": 8}, cycles=20, cycle_hz=250.0)
    assert max(len(data) for _, _, data, _ in log) <= 8
    assert [frame.size for frame in frame_map.joints[0].reports] == [8, 8, 5]
    assert any(can_id == 0x281 | FD_FRAME for _, can_id, _, _ in log)


@pytest.mark.parametrize(("options", "cycle_hz"), [({}, 500.0), ({"fd": True}, 800.0), (FD, 1000.0)])
def test_what_the_wire_cannot_carry_is_refused(options, cycle_hz):
    with pytest.raises(PlanRefused, match="load the bus") as caught:
        session(options, cycle_hz=cycle_hz)
    assert "CAN FD" in caught.value.what or not options


@pytest.mark.slow
def test_faults_of_the_wire_meet_fd_frames_too():
    fault = {"kind": "drop", "frames": "tpdo1", "joint": "2", "at_s": 0.1, "count": 3}
    (whole, *_), (lossy, *_) = (session({**FD, "faults": faults}, cycles=100) for faults in ([], [fault]))
    counts = [sum(can_id == 0x183 | FD_FRAME for _, can_id, _, _ in log) for log in (whole, lossy)]
    assert counts[0] - counts[1] == 3


def test_a_drive_that_cannot_be_switched_is_named():
    fault = {"kind": "missing", "joint": "3", "index": 0x2023}
    with pytest.raises(HardwareError, match="cannot be told to send its PDOs as CAN FD frames") as caught:
        session({**FD, "faults": [fault]})
    assert "joint 3 (node 4), object 2023:00" in caught.value.where


def test_a_drive_without_the_object_does_classical_frames_all_the_same():
    session({"faults": [{"kind": "missing", "index": 0x2023}]}, cycles=20, cycle_hz=250.0)


def test_a_drive_that_answers_in_classical_frames_ends_the_run():
    b = bench(1, 2, options=FD).open().start(active=["0", "1"])
    with pytest.raises(
        HardwareError, match="reports in classical frames, the robot file's options say `fd: true`"
    ) as e:
        b.cycle()
    assert "joint 0 (node 1)" in e.value.where and "fd_object" in e.value.next_step
    assert all(drive.values[0x6041, 0] != 0x0237 for drive in b.drives), "no drive ever got power"


def test_a_drive_that_was_left_on_fd_frames_is_found():
    b = bench(1).open().start()
    b.bus.put(0x181, bytes(12), is_fd=True)
    with pytest.raises(HardwareError, match="reports in CAN FD frames, the robot file's options say no `fd: true`"):
        b.cycle()


def test_it_is_switched_back_where_the_robot_file_names_the_object(monkeypatch):
    drive = ScriptedDrive(1)
    monkeypatch.setitem(OBJECTS, (0x2023, 0), ("<B", 1))
    drive.values[0x2023, 0] = 1
    Bench(drive, joint_options={"fd_object": "2023:00 u8"}).open().start()
    assert drive.values[0x2023, 0] == 0
