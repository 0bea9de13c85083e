"""Cyclic traffic: power, set-points, locked joints, faults, silence, quick stop, and the way out."""

from __future__ import annotations

import itertools
import math
import struct
import threading

import can
import pytest
from cia402_bench import RAD, Bench, bench
from cia402_wire import ScriptedDrive

from frictid_hil.errors import HardwareError, InvalidFields, SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import JointState, SetPoint


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
    with pytest.raises(HardwareError, match=r"still in fault 0x7305 \(sensor: .*\) after one fault reset"):
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
    assert b.driver.may_be_powered == ("0",)


class DeafDrive(ScriptedDrive):
    """It does not hear its PDOs any more, and perhaps no SDO either."""

    deaf: tuple[int, ...] = ()

    def receive(self, can_id, data):
        return () if can_id in self.deaf else super().receive(can_id, data)


def test_a_drive_that_misses_its_pdo_is_stopped_by_sdo_and_then_by_nmt_within_300_ms():
    drive = DeafDrive(1)
    b = Bench(drive).open().start()
    b.power()
    drive.deaf = (0x201,)
    b.driver.quick_stop()
    b.cycle(80)
    assert drive.values[0x6041, 0] & 0x6F == 0x27, "deaf, indeed"
    b.cycle(20)
    assert drive.values[0x6041, 0] & 0x6F == 0x07, "stopped by SDO"
    drive.values[0x6041, 0] = 0x0237  # and on again, by another master
    sent = len(b.frames)
    b.cycle(200)
    assert [data.hex() for _, can_id, data, out in b.frames[sent:] if out and can_id == 0] == ["8001"]
    assert drive.values[0x6041, 0] & 0x4F == 0x40


def test_a_command_that_somebody_else_sends_stops_all_in_the_same_cycle():
    b = bench(1, 2).open().start()
    b.power()
    b.bus.put(0x202, bytes.fromhex("0f00 10270000 0000"))
    with pytest.raises(SafetyAbort, match=r"joint 1 .*somebody else commands.*0x202"):
        b.cycle(1)
    b.cycle(1)
    assert all(drive.values[0x6041, 0] & 0x6F == 0x07 for drive in b.drives)


def test_an_adapter_that_echoes_our_own_frames_is_no_second_master():
    b = bench(1).open().start()
    b.power()
    send = b.bus.send

    def echoed(message, timeout=None):
        send(message)
        b.bus.put(message.arbitration_id, bytes(message.data))

    b.bus.send = echoed
    for step in range(20):
        b.set_points[0].position_rad += 1e-4 * step
        b.cycle(1)
    b.driver.quick_stop()
    b.cycle(3)
    assert b.drives[0].values[0x6041, 0] & 0x6F == 0x07


def test_a_drive_that_keeps_its_power_keeps_its_watchdog_and_is_named():
    drive = DeafDrive(1)
    b = Bench(drive, options={"sdo_timeout_s": 0.02}).open().start()
    b.power()
    drive.deaf = (0x201, 0x601)
    b.driver.close()
    assert b.driver.may_be_powered == ("0",)
    assert drive.values[0x1016, 1] != 0
    assert drive.values[0x6041, 0] & 0x6F == 0x27


@pytest.mark.parametrize("error", [OSError("network is down"), RuntimeError("driver"), ValueError("bad frame")])
def test_whatever_a_bus_raises_in_motion_is_a_hardware_error(error):
    b = bench(1).open().start()
    b.power()

    def broken(message, timeout=None):
        raise error

    b.bus.send = broken
    with pytest.raises(HardwareError, match="in a row failed"):
        b.cycle(3)
    del b.bus.send
    b.driver.close()
    assert b.driver.may_be_powered == ()


def test_an_emergency_before_the_report_of_the_same_cycle_is_seen():
    drive = ScriptedDrive(1)
    b = Bench(drive).open().start()
    b.power()
    send = b.bus.send

    def announced(message, timeout=None):
        if message.arbitration_id == 0x80:
            b.bus.put(0x81, bytes.fromhex("1023010000000000"))
            b.bus.put(0x81, bytes(8))
        send(message, timeout)

    b.bus.send = announced
    (report,) = b.cycle()
    assert report.error_code == 0x2310
    b.bus.send = send
    (report,) = b.cycle()
    assert report.error_code == 0


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


def test_an_interface_that_pads_data_in_place_changes_no_later_frame():
    b = bench(1).open().start()
    plain = b.bus.send

    def padding(message, timeout=None):
        plain(message, timeout)
        message.data.extend(bytes(8 - len(message.data)))

    b.bus.send = padding
    b.power()
    assert {len(data) for _, can_id, data, sent in b.frames if can_id == 0x80} == {1}
    assert {len(data) for _, can_id, data, sent in b.frames if can_id == 0x301} == {7}


def test_an_error_code_beside_a_healthy_statusword_is_history():
    drive = ScriptedDrive(1)
    drive.values[0x603F, 0] = 0x3210
    b = Bench(drive).open().start().power()
    assert b.feedback[0].error_code == 0 and b.feedback[0].state is JointState.ENABLED
    drive.values[0x6041, 0] = 0x0218
    b.cycle(20)
    assert b.feedback[0].error_code == 0x3210


def test_an_active_limit_is_told():
    drive = ScriptedDrive(1)
    b = Bench(drive).open().start().power()
    assert not b.feedback[0].limited
    drive.values[0x6041, 0] |= 0x0800
    assert b.cycle()[0].limited


def test_bus_off_is_told_by_name():
    b = bench(1).open().start().power()
    b.bus.waiting.append(can.Message(arbitration_id=0x040, is_error_frame=True, data=bytes(8)))
    with pytest.raises(HardwareError, match="bus-off") as caught:
        b.cycle(2)
    assert "restart-ms" in caught.value.next_step and b.bus.sent[-2][1][:2] == b"\x02\x00"


def test_error_passive_is_the_likely_cause_of_silence():
    b = bench(1).open().start().power()
    b.bus.waiting.append(can.Message(arbitration_id=0x004, is_error_frame=True, data=b"\x00\x20" + bytes(6)))
    b.clock.dead.add(1)
    with pytest.raises(SafetyAbort, match="no heartbeat") as caught:
        b.cycle(400)
    assert "error-passive" in caught.value.cause
