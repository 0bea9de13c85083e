"""The driver against scripted drives, frame by frame: what it writes, what it refuses, how it stops."""

from __future__ import annotations

import itertools
import math
import struct
import threading
import time

import can
import pytest
from cia402_wire import HandClock, ScriptedDrive, WireBus, robot

from frictid_drivers.cia402 import Cia402Driver
from frictid_drivers.cia402.network import BusLock
from frictid_hil.driver import Driver, JointState, Mode, SetPoint, Severity
from frictid_hil.errors import HardwareBusy, HardwareError, InvalidFields, PlanRefused, SafetyAbort, UsageError

RAD = 2 * math.pi / (4096 * 50)


class Bench:
    """A driver, its drives, and a loop."""

    def __init__(self, *drives, setup=None, **options):
        self.drives = drives
        self.bus = WireBus(*drives)
        self.clock = HandClock(self.bus)
        self.frames = []
        self.setup = setup or robot(*[drive.node for drive in drives], **options)
        self.driver = Cia402Driver(self.setup, bus_factory=lambda: self.bus, clock=self.clock)
        self.set_points = [SetPoint() for _ in self.setup.joints]

    def open(self):
        self.driver.open(lambda *frame: self.frames.append(frame))
        return self

    def start(self, active=("0",), cycle_hz=1000.0):
        self.driver.configure(cycle_hz, list(active))
        self.driver.start_cycling()
        self.cycle_ns = round(1e9 / cycle_hz)
        return self

    def cycle(self, count=1):
        for _ in range(count):
            self.clock.wait_until(self.clock.now_ns() + self.cycle_ns)
            self.feedback = self.driver.exchange(self.set_points)
        return self.feedback

    def power(self, mode=Mode.POSITION):
        self.cycle(110)
        for joint in self.setup.joints:
            self.driver.enable(joint.name, mode)
        for _ in range(400):
            if all(report.state is JointState.ENABLED for report in self.cycle()):
                return self
        raise AssertionError([report.state for report in self.feedback])


def bench(*nodes, **options):
    return Bench(*[ScriptedDrive(node) for node in nodes], **options)


# -- the protocol and the robot file ----------------------------------------------------------------------------------


def test_is_a_driver():
    assert isinstance(bench(1).driver, Driver)


@pytest.mark.parametrize(
    ("options", "path"),
    [
        ({"options": {"sdo_timeout_s": "fast"}}, ("options", "sdo_timeout_s")),
        ({"options": {"bitrate": 8_000_000}}, ("options", "bitrate")),
        ({"options": {"quick_stop_option": 2}}, ("options", "quick_stop_option")),
        ({"joint_options": {"following_window_rad": 0}}, ("joints", "0", "options", "following_window_rad")),
        ({"joint_options": {"external_torque_object": "2030"}}, ("joints", "0", "options", "external_torque_object")),
        (
            {"joint_options": {"external_torque_object": "2030:00 i32"}},
            ("joints", "0", "options", "external_torque_nm_per_unit"),
        ),
        ({"joint_options": {"timing": {"torque_delay": 1}}}, ("joints", "0", "options", "timing")),
    ],
)
def test_wrong_options_are_named(options, path):
    with pytest.raises(InvalidFields) as caught:
        bench(1, **options)
    assert path in [problem.path for problem in caught.value.problems]


@pytest.mark.parametrize("nodes", [(1, 1), (0,), (128,), (127,)])
def test_wrong_node_ids_are_named(nodes):
    with pytest.raises(InvalidFields) as caught:
        bench(*nodes)
    assert caught.value.problems[-1].path[-1] == "node"


# -- reaching the drives ----------------------------------------------------------------------------------------------


def test_open_and_check_write_nothing():
    b = bench(1, 2).open()
    b.driver.identify()
    findings = b.driver.check(None)
    downloads = [data for can_id, data in b.bus.sent if can_id > 0x600 and data[0] >> 5 == 1]
    others = [can_id for can_id, _ in b.bus.sent if not 0x600 < can_id < 0x680]
    assert downloads == [] and others == []
    assert not [finding for finding in findings if finding.severity is Severity.ERROR], findings


def test_a_transcript_of_the_first_question():
    b = bench(3).open()
    sent = [frame[1:] for frame in b.frames[:2]]
    assert sent == [
        (0x603, bytes.fromhex("40 0010 00 00000000"), True),
        (0x583, bytes.fromhex("43 0010 00 92010200"), False),
    ]
    assert {frame[0] for frame in b.frames} == {0}


def test_identity():
    identity = bench(1, joint_options={"timing": {"torque_delay_s": 0.002}}).open().driver.identify()["0"]
    assert (identity.serial, identity.firmware) == ("99", "7.1 revision 0x1")
    assert "Scripted drive 402" in identity.product
    assert identity.rated_torque_nm == pytest.approx(50.0) and identity.gear_ratio == 50
    assert identity.position_resolution_rad == pytest.approx(RAD)
    assert identity.torque_resolution_nm == pytest.approx(0.05)
    assert (identity.timing.torque_delay_s, identity.timing.source) == (0.002, "robot file")


def test_a_silent_drive_is_named():
    b = Bench(ScriptedDrive(1), ScriptedDrive(5, silent=True), options={"sdo_timeout_s": 0.02})
    with pytest.raises(HardwareError) as caught:
        b.open()
    error = caught.value
    assert "node 5" in error.where and "1000:00" in error.where and "0.02 s" in error.what and error.next_step
    assert b.bus.closed


def test_a_bus_that_is_not_there():
    with pytest.raises(HardwareError) as caught:
        Cia402Driver(robot(1).__class__("r", "socketcan:no_such_can", 1000.0, robot(1).joints)).open()
    assert "no_such_can" in caught.value.where
    assert "ip link set no_such_can up type can bitrate 1000000" in caught.value.next_step


def test_an_interface_that_does_not_exist():
    with pytest.raises(HardwareError, match="no working interface 'cansocket'") as caught:
        Cia402Driver(robot(1).__class__("r", "cansocket:can0", 1000.0, robot(1).joints)).open()
    assert "socketcan" in caught.value.next_step


def test_a_bus_without_a_channel():
    with pytest.raises(UsageError, match="interface:channel"):
        Cia402Driver(robot(1).__class__("r", "can0", 1000.0, robot(1).joints)).open()


def test_a_bus_held_by_somebody_else():
    setup = robot(1).__class__("r", "virtual:cia402-held", 1000.0, robot(1).joints)
    other = BusLock(setup.bus)
    other.acquire()
    try:
        with pytest.raises(HardwareBusy, match="another process"):
            Cia402Driver(setup).open()
    finally:
        other.release()


def test_nobody_answers_on_a_real_python_can_bus():
    setup = robot(1, options={"sdo_timeout_s": 0.05})
    setup = setup.__class__("r", "virtual:cia402-empty", 1000.0, setup.joints, setup.options)
    for _ in range(2):  # the first failure must have given the bus back
        with pytest.raises(HardwareError, match="no answer to SDO"):
            Cia402Driver(setup).open()


def test_check_finds_what_is_wrong():
    drive = ScriptedDrive(1, without={0x1016, 0x1019, 0x605A})
    drive.values[0x6041, 0], drive.values[0x603F, 0] = 0x0218, 0x7305
    drive.values[0x6502, 0] = 0x80
    drive.values[0x6072, 0] = 100
    drive.values[0x607D, 1], drive.values[0x607D, 2] = -1000, 1000
    drive.values[0x6085, 0] = 1
    said = "\n".join(
        f"{finding.severity.value}: {finding.message}" for finding in Bench(drive).open().driver.check(None)
    )
    for words in (
        "error: error 0x7305 is pending",
        "warning: no cyclic synchronous torque mode",
        "warning: no heartbeat consumer (1016)",
        "warning: no SYNC counter (1019, 18xx:06) on joint 0",
        "warning: the drive has no 605A:00",
        "torque limit is 5 N m (6072), the robot file's 60 N m",
        "position limits are -1.758 deg..1.758 deg (607D)",
        "a quick stop from full speed would take",
    ):
        assert words in said, said


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({(0x6091, 1): 100}, "gear ratio is 50 in the robot file and 100 in the drive (6091 = 100:1)"),
        ({(0x6076, 0): 2000}, "rated torque is 50 N m in the robot file and 100 N m in the drive (6076 = 2000 mN m"),
        ({(0x60A9, 0): 0x00410000}, "0x00410000"),
    ],
)
def test_a_drive_that_is_not_the_robot_files(values, words):
    drive = ScriptedDrive(1, refuses={(0x60A9, 0): 0x06090030})
    drive.values.update(values)
    b = Bench(drive).open()
    with pytest.raises(HardwareError) as caught:
        b.driver.configure(1000.0, ["0"])
    assert words in str(caught.value) and "joint 0" in str(caught.value)


def test_position_units_with_feed_or_without_gear():
    drive = ScriptedDrive(1)
    drive.values[0x6091, 1] = 1
    b = Bench(drive).open()
    assert b.driver.identify()["0"].position_resolution_rad == pytest.approx(RAD)
    assert any("does not know the gear" in finding.message for finding in b.driver.check(None))
    b = bench(1, joint_options={"position_units_per_revolution": 360_000}).open()
    assert b.driver.identify()["0"].position_resolution_rad == pytest.approx(2 * math.pi / 360_000)


# -- configuring ------------------------------------------------------------------------------------------------------


def test_everything_is_written_and_read_back():
    drive = ScriptedDrive(1)
    b = Bench(drive, options={"watchdog_ms": 120}).open()
    b.driver.configure(500.0, ["0"])
    b.driver.set_limits("0", torque_nm=40.0, position_min_rad=-1.0, position_max_rad=0.5)
    expected = {
        (0x1006, 0): 2000,
        (0x1016, 1): 127 << 16 | 120,
        (0x1017, 0): 100,
        (0x6007, 0): 3,
        (0x605A, 0): 6,
        (0x60A9, 0): 0xFDB44700,
        (0x60C2, 2): -5,
        (0x60C2, 1): 200,
        (0x6060, 0): 8,
        (0x6072, 0): 800,
        (0x607D, 1): round(-1.0 / RAD),
        (0x607D, 2): round(0.5 / RAD),
        (0x1A00, 0): 3,
        (0x1A00, 1): 0x60410010,
        (0x1A00, 2): 0x60640020,
        (0x1A00, 3): 0x60770010,
        (0x1800, 1): 0x40000181,
        (0x1800, 2): 1,
        (0x1600, 2): 0x607A0020,
        (0x1400, 1): 0x201,
    }
    assert {key: drive.values[key] for key in expected} == expected
    requests = [struct.unpack_from("<BHB", data) for can_id, data in b.bus.sent if can_id == 0x601]
    for at, (command, *address) in enumerate(requests):
        if command >> 5 == 1 and address != [0x607A, 0]:
            assert [command >> 5 == 2 and rest == address for command, *rest in requests[at + 1 : at + 2]] == [True]


def test_decelerations_keep_their_worth_when_the_velocity_unit_changes():
    drive = ScriptedDrive(1)
    Bench(drive).open().driver.configure(1000.0, ["0"])
    assert (drive.values[0x6084, 0], drive.values[0x6085, 0]) == (100_000, 200_000)


def test_a_fixed_coarse_velocity_unit_is_lived_with():
    drive = ScriptedDrive(1, refuses={(0x60A9, 0): 0x06010002})
    b = Bench(drive).open()
    b.driver.configure(1000.0, ["0"])
    unit = b.driver.frame_map().joints[0].velocity_rad_s_per_unit
    assert unit == pytest.approx(2 * math.pi / 60)
    assert drive.values[0x6085, 0] == 200


@pytest.mark.parametrize("direction", [1, -1])
def test_limits_follow_the_direction(direction):
    drive = ScriptedDrive(1)
    b = Bench(drive, direction=direction).open()
    b.driver.configure(1000.0, ["0"])
    b.driver.set_limits("0", torque_nm=60.0, position_min_rad=-1.0, position_max_rad=0.5)
    low, high = (-1.0, 0.5) if direction == 1 else (-0.5, 1.0)
    assert (drive.values[0x607D, 1], drive.values[0x607D, 2]) == (round(low / RAD), round(high / RAD))


@pytest.mark.parametrize("key", [(0x6007, 0), (0x605A, 0), (0x1016, 1), (0x1A00, 2), (0x1800, 2), (0x6065, 0)])
def test_a_value_that_reads_back_otherwise_is_refused(key):
    drive = ScriptedDrive(4, reads_back={key: 5})
    b = Bench(drive).open()
    with pytest.raises(HardwareError) as caught:
        b.driver.configure(1000.0, ["0"])
    assert "node 4" in caught.value.where and f"{key[0]:04X}:{key[1]:02X}" in caught.value.where
    assert "wrote" in caught.value.what and "read back" in caught.value.what


def test_a_refused_write_is_named():
    b = Bench(ScriptedDrive(1, refuses={(0x6007, 0): 0x06090030})).open()
    with pytest.raises(HardwareError, match=r"refuses abort connection option code = 3.*0609") as caught:
        b.driver.configure(1000.0, ["0"])
    assert "6007:00" in caught.value.where


def test_a_powered_drive_is_not_touched():
    drive = ScriptedDrive(1)
    drive.values[0x6041, 0] = 0x0237
    b = Bench(drive).open()
    assert any("already on" in finding.message for finding in b.driver.check(None))
    before = len(b.bus.sent)
    with pytest.raises(HardwareError, match="power stage is already on"):
        b.driver.configure(1000.0, ["0"])
    assert not [can_id for can_id, data in b.bus.sent[before:] if can_id < 0x600 or data[0] >> 5 == 1]


def test_a_drive_that_its_watchdog_stopped_is_switched_off_and_used():
    drive = ScriptedDrive(1)
    drive.values[0x6041, 0], drive.values[0x603F, 0] = 0x0217, 0x8130
    b = Bench(drive).open()
    findings = b.driver.check(None)
    assert any("an earlier run was cut off" in finding.message for finding in findings)
    assert not [finding for finding in findings if finding.severity is Severity.ERROR]
    b.driver.configure(1000.0, ["0"])
    assert drive.values[0x6041, 0] == 0x0250


def test_a_drive_that_stays_in_quick_stop_is_told():
    drive = ScriptedDrive(1, refuses={(0x6040, 0): 0x08000021})
    drive.values[0x6041, 0] = 0x0217
    with pytest.raises(HardwareError, match="controlword"):
        Bench(drive).open().driver.configure(1000.0, ["0"])


def test_a_layout_that_no_wire_can_carry_is_refused_with_the_rate_that_fits():
    b = bench(*range(1, 7)).open()
    before = len(b.bus.sent)
    with pytest.raises(PlanRefused, match=r"6 of 6 joints.*% on average") as caught:
        b.driver.configure(1000.0, [str(joint) for joint in range(6)])
    assert len(b.bus.sent) == before
    rate = float(caught.value.next_step.split("at most ")[1].split(" Hz")[0])
    assert 250 <= rate < 340
    b.driver.configure(rate, [str(joint) for joint in range(6)])


def test_half_the_bitrate_refuses_1_khz():
    b = bench(*range(1, 7), options={"bitrate": 500_000}).open()
    with pytest.raises(PlanRefused):
        b.driver.configure(1000.0, ["0"])
    assert b.driver.capabilities().max_cycle_hz < 600


def test_the_second_joint_costs_only_what_differs():
    b = bench(*range(1, 7)).open()
    b.driver.configure(1000.0, ["0"])
    first = len(b.bus.sent)
    b.driver.configure(1000.0, ["1"])
    second = len(b.bus.sent) - first
    assert second < 0.25 * first
    assert b.drives[1].values[0x1800, 2] == 1 and b.drives[0].values[0x1800, 2] == 10


def test_a_drive_that_was_reset_is_configured_anew():
    b = bench(1).open()
    b.driver.configure(1000.0, ["0"])
    b.drives[0].values[0x1A00, 0] = 0
    b.drives[0].values[0x1800, 1] |= 1 << 31
    b.bus.put(0x701, b"\x00")
    b.driver.configure(1000.0, ["0"])
    assert b.drives[0].values[0x1A00, 0] == 3


def test_unused_pdos_are_switched_off():
    drive = ScriptedDrive(1)
    drive.values[0x1803, 1] = 0x481
    Bench(drive).open().driver.configure(1000.0, ["0"])
    assert drive.values[0x1803, 1] >> 31


# -- cycling ----------------------------------------------------------------------------------------------------------


def test_power_comes_on_without_a_jump_and_the_set_point_is_followed():
    drive = ScriptedDrive(1)
    drive.values[0x6064, 0] = 12_345
    b = Bench(drive).open().start()
    b.power()
    assert [word for at, word in enumerate(drive.controlwords) if word != drive.controlwords[at - 1] or not at] == [
        0x00, 0x06, 0x07, 0x0F,
    ]  # fmt: skip
    b.cycle(5)
    assert drive.values[0x6064, 0] == 12_345, "held where it stood while the set-point was not moved"
    b.set_points[0].position_rad = 12_400 * RAD
    b.cycle(2)
    assert drive.values[0x6064, 0] == 12_400
    assert b.feedback[0].position_rad == pytest.approx(12_400 * RAD)


def test_time_stamps_are_those_of_sync_and_run_time_starts_at_zero():
    b = bench(1).open().start()
    b.cycle(3)
    assert b.feedback[0].t_ns == 3_000_000
    syncs = [frame for frame in b.frames if frame[1] == 0x80]
    assert [frame[0] for frame in syncs] == [1_000_000, 2_000_000, 3_000_000]
    assert all(frame[0] == 0 for frame in b.frames[: b.frames.index(syncs[0])])


def test_locked_joints_stay_and_report_now_and_then():
    b = bench(*range(1, 7)).open().start(active=["2"])
    b.power()
    for joint in "01345":
        b.driver.lock(joint)
    for set_point in b.set_points:
        set_point.position_rad = 0.1
    oldest = 0
    for _ in range(100):
        feedback = b.cycle()
        oldest = max(oldest, *[report.age_cycles for report in feedback])
        assert feedback[2].age_cycles == 0
    assert oldest == 9
    assert [drive.values[0x607A, 0] for drive in b.drives] == [0, 0, round(0.1 / RAD), 0, 0, 0]
    b.driver.unlock("3")
    b.cycle(30)
    b.set_points[3].position_rad = 0.05
    b.cycle(30)
    assert b.drives[3].values[0x607A, 0] == round(0.05 / RAD)


def test_never_more_than_one_frame_besides_the_active_ones():
    b = bench(*range(1, 7)).open().start(active=["2"])
    b.cycle(110)
    for joint in b.setup.joints:
        b.driver.enable(joint.name, Mode.POSITION)
    for _ in range(300):
        before = len(b.bus.sent)
        b.cycle()
        rpdos = [can_id for can_id, _ in b.bus.sent[before:] if 0x200 <= can_id < 0x380 and can_id != 0x203]
        assert len(rpdos) <= 1
    assert all(report.state is JointState.ENABLED for report in b.feedback)


def test_torque_mode_starts_at_zero_and_is_cut_to_the_limit():
    drive = ScriptedDrive(1)
    b = Bench(drive).open().start()
    b.set_points[0].torque_nm = 20.0
    b.power(Mode.TORQUE)
    at_power_on = [struct.unpack_from("<bh", data)[1] for number, data in drive.commands if number == 1]
    assert set(at_power_on) == {0}
    b.cycle(2)
    assert drive.values[0x6071, 0] == 400
    b.set_points[0].torque_nm, b.set_points[0].torque_offset_nm = -80.0, -5.0
    b.cycle(2)
    assert drive.values[0x6071, 0] == -1200 and drive.values[0x60B2, 0] == 0
    assert b.feedback[0].mode is Mode.TORQUE


def test_torque_offset_in_position_mode():
    b = bench(1).open().start()
    b.power()
    b.set_points[0].torque_offset_nm = 2.5
    b.cycle(2)
    assert b.drives[0].values[0x60B2, 0] == 50


def test_torque_mode_needs_the_drives_watchdog():
    b = Bench(ScriptedDrive(1, without={0x1016})).open().start()
    assert Mode.TORQUE not in b.driver.capabilities().modes and not b.driver.capabilities().drive_watchdog
    with pytest.raises(HardwareError, match="no 1016") as caught:
        b.driver.enable("0", Mode.TORQUE)
    assert "allow_torque_without_watchdog" in caught.value.next_step
    b.driver.enable("0", Mode.POSITION)
    allowed = Bench(ScriptedDrive(1, without={0x1016}), options={"allow_torque_without_watchdog": True}).open().start()
    allowed.driver.enable("0", Mode.TORQUE)


def test_no_power_before_the_first_heartbeat():
    b = bench(1).open().start()
    b.driver.enable("0", Mode.POSITION)
    b.cycle(99)
    assert 0x0F not in b.drives[0].controlwords and b.drives[0].controlwords[-1] == 0x07
    b.cycle(5)
    assert b.drives[0].controlwords[-1] == 0x0F


def test_no_power_in_another_mode_than_asked():
    drive = ScriptedDrive(1)
    drive.shows_mode = False
    b = Bench(drive).open().start()
    drive.values[0x6061, 0] = 1
    b.driver.enable("0", Mode.POSITION)
    b.cycle(300)
    assert b.feedback[0].mode is Mode.NONE and b.feedback[0].state is JointState.DISABLED


def test_a_fault_is_reset_once_on_request_and_only_then():
    drive = ScriptedDrive(1)
    drive.values[0x6041, 0], drive.values[0x603F, 0] = 0x0218, 0x3210
    b = Bench(drive).open().start()
    b.cycle(200)
    assert set(drive.controlwords) == {0x00} and b.feedback[0].state is JointState.FAULT
    assert b.feedback[0].error_code == 0x3210
    b.driver.enable("0", Mode.POSITION)
    b.cycle(30)
    assert b.feedback[0].state is JointState.ENABLED and b.feedback[0].error_code == 0
    drive.values[0x6041, 0] = 0x0218
    b.cycle(300)
    assert drive.controlwords[-1] == 0x00 and b.feedback[0].state is JointState.FAULT


def test_a_fault_that_stays_is_told():
    drive = ScriptedDrive(1)
    drive.resets = False
    drive.values[0x6041, 0], drive.values[0x603F, 0] = 0x0218, 0x7305
    b = Bench(drive).open().start()
    b.cycle(110)
    b.driver.enable("0", Mode.POSITION)
    with pytest.raises(HardwareError, match="still in fault 0x7305 after one fault reset"):
        b.cycle(600)
    b.cycle(20)
    words = drive.controlwords
    assert sum(a == 0x00 and b == 0x80 for a, b in itertools.pairwise(words)) == 1


def test_emergencies_show_at_once():
    b = bench(1).open().start()
    b.power()
    b.bus.put(0x081, bytes.fromhex("1186 20 0000000000"))
    assert b.cycle()[0].error_code == 0x8611


def test_a_boot_up_in_mid_run_stops_everything():
    b = bench(1, 2).open().start()
    b.power()
    b.bus.put(0x702, b"\x00")
    before = len(b.bus.sent)
    with pytest.raises(SafetyAbort, match="booted up") as caught:
        b.cycle()
    assert "node 2" in caught.value.where
    stops = [can_id for can_id, data in b.bus.sent[before:] if can_id in (0x201, 0x202) and data[0] == 0x02]
    assert set(stops) == {0x201, 0x202}
    b.cycle(20)  # told once; the loop can watch the stop
    assert b.feedback[0].state is JointState.STOPPING


@pytest.mark.parametrize(("dead_after", "words"), [(0, "no heartbeat within 0.5 s"), (250, "no heartbeat for 0.2")])
def test_a_lost_heartbeat_stops_everything(dead_after, words):
    b = bench(1, 2).open().start()
    if dead_after:
        b.cycle(dead_after)
    b.clock.dead.add(2)
    with pytest.raises(SafetyAbort, match=words) as caught:
        b.cycle(700)
    assert "joint 1 (node 2)" in caught.value.where


def test_a_missing_report_ages_and_the_next_one_does_not():
    b = bench(1).open().start()
    b.cycle(3)
    b.drives[0].mute = True
    assert [b.cycle()[0].age_cycles for _ in range(3)] == [1, 2, 3]
    assert b.feedback[0].t_ns == 3_000_000
    b.drives[0].mute = False
    assert b.cycle()[0].age_cycles == 0


def test_foreign_and_broken_frames_do_not_disturb():
    b = bench(1).open().start()
    b.cycle(2)
    b.bus.put(0x181, b"\x37")
    b.bus.put(0x081, b"\x01\x02\x03")
    b.bus.put(0x6FF, b"junk")
    b.bus.put(0x581, b"")
    b.bus.put(0x181, b"", is_remote_frame=True)
    b.bus.put(0x181, b"\xff" * 8, is_error_frame=True)
    b.bus.put(0x701, b"")
    feedback = b.cycle()[0]
    assert feedback.valid and feedback.age_cycles == 0 and feedback.position_rad == 0.0


def test_one_failed_send_is_a_missed_cycle_and_three_end_it():
    b = bench(1).open().start()
    b.cycle(3)
    b.bus.fail = 1
    assert b.cycle()[0].age_cycles == 1
    assert b.cycle()[0].age_cycles == 0
    b.bus.fail = 100
    with pytest.raises(HardwareError, match="3 cycles in a row"):
        b.cycle(3)


@pytest.mark.parametrize("field", ["position_rad", "torque_offset_nm"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_set_point_that_is_no_number_stops(field, value):
    b = bench(1).open().start()
    b.power()
    setattr(b.set_points[0], field, value)
    with pytest.raises(SafetyAbort, match="the commanded"):
        b.cycle()
    assert b.drives[0].controlwords[-1] == 0x02


def test_quick_stop_as_a_transcript():
    b = bench(1, 2).open().start()
    b.power()
    before = len(b.bus.sent)
    b.driver.quick_stop()
    ids = [can_id for can_id, _ in b.bus.sent[before:]]
    assert ids == [0x201, 0x202, 0x080] * 2, "active joint first, SYNC puts them into force"
    assert all(struct.unpack_from("<Hih", data)[::2] == (0x02, 0) for _, data in b.bus.sent[before : before + 2])
    assert [drive.values[0x6041, 0] for drive in b.drives] == [0x0217, 0x0217]
    b.cycle(200)
    assert all(report.state is JointState.STOPPING for report in b.feedback)
    for joint in b.setup.joints:
        b.driver.disable(joint.name)
    b.cycle(60)
    assert all(report.state is JointState.DISABLED for report in b.feedback)


def test_quick_stop_in_torque_mode_takes_the_torque_away_first():
    b = bench(1).open().start()
    b.set_points[0].torque_nm = 10.0
    b.power(Mode.TORQUE)
    b.cycle(3)
    before = len(b.bus.sent)
    b.driver.quick_stop()
    (first, data), (second, word), *_ = b.bus.sent[before:]
    assert (first, struct.unpack_from("<bh", data)) == (0x301, (10, 0)) and (second, word[0]) == (0x201, 0x02)


def test_quick_stop_from_another_thread_never_raises():
    b = bench(1).open()
    b.driver.quick_stop()  # nothing is cycling yet
    b.start()
    b.power()
    b.bus.fail = 10**9
    thread = threading.Thread(target=b.driver.quick_stop)
    thread.start()
    thread.join(2.0)
    assert not thread.is_alive()
    b.bus.fail = 0
    b.cycle(2)
    assert b.drives[0].controlwords[-1] == 0x02


def test_stop_cycling_powers_off_and_leaves_pre_operational():
    b = bench(1, 2).open().start()
    b.power()
    b.driver.stop_cycling()
    assert [drive.values[0x6041, 0] for drive in b.drives] == [0x0250, 0x0250]
    assert not any(drive.operational for drive in b.drives)
    b.driver.configure(1000.0, ["1"])
    b.driver.start_cycling()
    assert b.clock.now_ns() == 0
    b.power()


def test_a_joint_that_will_not_stop_loses_its_voltage_and_is_told():
    drive = ScriptedDrive(1)
    b = Bench(drive).open().start()
    b.power()
    drive.values[0x606C, 0] = 10_000_000
    b.cycle(2)
    with pytest.raises(SafetyAbort, match="did not come to rest"):
        b.driver.stop_cycling()
    assert drive.controlwords[-1] == 0x00


def test_close_brings_everything_to_rest_twice():
    b = bench(1).open().start()
    b.power()
    b.driver.close()
    b.driver.close()
    drive = b.drives[0]
    assert drive.values[0x6041, 0] == 0x0250 and 0x02 in drive.controlwords
    assert drive.values[0x1016, 1] == 0 and b.bus.closed and not drive.operational


def test_close_survives_a_dead_bus():
    b = bench(1, options={"sdo_timeout_s": 0.02}).open().start()
    b.power()
    b.bus.fail = 10**9
    b.driver.close()
    assert b.bus.closed


@pytest.mark.parametrize("call", ["exchange", "start_cycling", "enable", "set_limits", "frame_map", "identify"])
def test_calls_out_of_order_are_told(call):
    driver = bench(1).driver
    calls = {
        "exchange": lambda: driver.exchange([SetPoint()]),
        "start_cycling": driver.start_cycling,
        "enable": lambda: driver.enable("0", Mode.POSITION),
        "set_limits": lambda: driver.set_limits("0", torque_nm=1, position_min_rad=0, position_max_rad=1),
        "frame_map": driver.frame_map,
        "identify": driver.identify,
    }
    with pytest.raises(HardwareError):
        calls[call]()


def test_an_unknown_joint_lists_the_known_ones():
    b = bench(1, 2).open().start()
    with pytest.raises(InvalidFields, match="this robot has 0, 1"):
        b.driver.enable("7", Mode.POSITION)


# -- the wall clock ---------------------------------------------------------------------------------------------------


def test_on_the_wall_clock_the_host_is_heard_while_nobody_cycles():
    drive = ScriptedDrive(1)
    bus = WireBus(drive)
    driver = Cia402Driver(robot(1, options={"watchdog_ms": 30}), bus_factory=lambda: bus)
    driver.open()
    driver.configure(100.0, ["0"])
    bus.sent.clear()
    bus.fail = 2  # a full buffer passes
    time.sleep(0.2)
    beats = [data for can_id, data in bus.sent if can_id == 0x77F]
    driver.close()
    assert len(beats) >= 8 and set(beats) == {b"\x7f"}
    bus.sent.clear()
    time.sleep(0.05)
    assert not bus.sent


def test_on_the_wall_clock_a_missing_report_costs_the_window_and_no_more():
    drive = ScriptedDrive(1)
    bus = WireBus(drive)
    recv = bus._recv_internal
    bus._recv_internal = lambda timeout: (recv(timeout)[0] or time.sleep(timeout or 0), False)
    driver = Cia402Driver(robot(1), bus_factory=lambda: bus)
    driver.open()
    driver.configure(100.0, ["0"])
    driver.start_cycling()
    driver.exchange([SetPoint()])
    drive.mute = True
    begin = time.monotonic()
    assert driver.exchange([SetPoint()])[0].age_cycles == 1
    assert 0.004 < time.monotonic() - begin < 0.1
    driver.close()


def test_interfaces_are_those_of_python_can():
    assert "socketcan" in can.VALID_INTERFACES
