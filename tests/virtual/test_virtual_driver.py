"""The ``virtual`` driver from outside: lock-step and wall clock, one owner per bus, drives that outlive their host."""

import math
import os
import signal
import struct
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial

import can
import pytest

from frictid_drivers.virtual import VirtualDriver, channel
from frictid_drivers.virtual.driver import write_object
from frictid_drivers.virtual.rack_launcher import encode_setup, start_rack
from frictid_drivers.virtual.socket_bus import SocketBus
from frictid_hil.errors import HardwareBusy, HardwareError, InvalidFields, SafetyAbort, UsageError
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import Driver, JointState, SetPoint, WallClock

MS = 1_000_000


@pytest.fixture(autouse=True)
def own_folder(runtime_folder):
    return runtime_folder


class Run:
    """A driver being cycled."""

    def __init__(self, setup, active="0"):
        self.driver = VirtualDriver(setup)
        self.driver.open()
        self.driver.configure(setup.cycle_hz, [active])
        self.driver.start_cycling()
        self.points = [SetPoint(position_rad=joint.locked_position_rad) for joint in setup.joints]
        for joint in setup.joints:
            self.driver.enable(joint.name, Mode.POSITION)
        self.deadline_ns = 0
        self.feedback = self.cycle(200)  # the drives are enabled once their heartbeat was heard

    def cycle(self, count=1, move=None):
        for n in range(count):
            self.deadline_ns += MS
            self.driver.clock.wait_until(self.deadline_ns)
            if move is not None:
                self.points[0].position_rad = move(n)
            self.feedback = self.driver.exchange(self.points)
        return self.feedback


def swing(n):
    return 0.1 * (1 - math.cos(2 * math.pi * n / 600))


def test_is_a_driver(make_robot):
    driver = VirtualDriver(make_robot())
    assert isinstance(driver, Driver)
    driver.close()
    driver.close()


def test_lock_step_run(make_robot):
    run = Run(make_robot())
    assert [joint.state for joint in run.feedback] == [JointState.ENABLED] * 2
    run.cycle(600, swing)
    assert run.feedback[0].position_rad == pytest.approx(0.0, abs=0.003)
    assert run.feedback[1].position_rad == pytest.approx(0.1, abs=1e-4)
    assert run.driver.capabilities().lock_step and run.driver.capabilities().drive_watchdog
    run.driver.stop_cycling()
    said = run.driver.identify()["0"]
    assert said.product.startswith("frictid virtual servo") and said.gear_ratio == 100.0
    assert said.rated_torque_nm == pytest.approx(30.0)
    run.driver.close()


def noted(frames, *frame):
    frames.append(frame)


def test_two_runs_are_equal_to_the_bit(make_robot):
    logs = []
    for _ in range(2):
        frames = []
        driver = VirtualDriver(make_robot())
        driver.open(partial(noted, frames))
        driver.configure(1000.0, ["0"])
        driver.start_cycling()
        frames.clear()
        driver.enable("0", Mode.POSITION)
        points = [SetPoint(), SetPoint(position_rad=0.1)]
        for n in range(300):
            driver.clock.wait_until((n + 1) * MS)
            points[0].position_rad = swing(n)
            driver.exchange(points)
        logs.append(list(frames))
        driver.close()
    assert len(logs[0]) > 900 and logs[0] == logs[1]


def test_hand_and_payload_of_a_simulated_robot(make_robot):
    run = Run(make_robot())
    before = run.cycle(50)[0].torque_nm
    run.driver.mount_payload("0", True)
    assert run.cycle(200)[0].torque_nm == pytest.approx(before + 6.0, abs=1.0)
    run.driver.mount_payload("0", False)
    run.driver.simulate_hand("0", 0.0, 0.2, 0.5)
    pulls = [run.cycle(10)[0].external_torque_nm for _ in range(60)]
    assert max(pulls) > 10 and math.isfinite(min(pulls))
    run.driver.simulate_hand("0")
    assert run.cycle(5)[0].external_torque_nm == 0.0
    run.driver.stop_cycling()
    run.driver.close()


def test_hand_needs_to_be_in_the_robot_file(make_robot):
    setup = make_robot()
    bare = {key: value for key, value in setup.joints[0].simulated.items() if key != "hand"}
    driver = VirtualDriver(replace(setup, joints=tuple(replace(joint, simulated=bare) for joint in setup.joints)))
    driver.open()
    with pytest.raises(UsageError, match="no simulated hand"):
        driver.simulate_hand("0", 0.0, 0.1, 0.5)
    driver.close()


def test_two_buses_of_one_name_in_lock_step_know_nothing_of_each_other(make_robot):
    def reported(run):
        return [(report.t_ns, report.position_rad, report.torque_nm) for report in run.cycle(100, swing)]

    first, second = Run(make_robot()), Run(make_robot())
    told = [reported(first), reported(second)]
    alone = Run(make_robot())
    assert told == [reported(alone)] * 2
    for run in (first, second, alone):
        run.driver.stop_cycling()
        run.driver.close()


def test_a_driver_can_be_opened_again(make_robot):
    run = Run(make_robot())
    run.cycle(10)
    run.driver.stop_cycling()
    run.driver.close()
    run.driver.open()
    assert run.driver.identify()["1"].rated_torque_nm == pytest.approx(30.0)
    run.driver.close()


@pytest.mark.slow
def test_one_bus_on_the_wall_clock_has_one_owner(make_robot, own_folder):
    code = (
        "import sys; from frictid_drivers.virtual import channel\n"
        "lock = channel.take('bench'); print('held', flush=True); sys.stdin.read()"
    )
    holder = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert holder.stdout.readline() == "held\n"
    driver = VirtualDriver(make_robot(realtime=True))
    with pytest.raises(HardwareBusy):
        driver.open()
    holder.communicate("")
    driver.open()
    driver.close()


def test_wrong_simulated_joint_is_named(make_robot):
    setup = make_robot()
    joints = (setup.joints[0], replace(setup.joints[1], simulated={"inertia_kg_m2": -1.0}))
    for realtime in (False, True):
        driver = VirtualDriver(replace(setup, joints=joints, realtime=realtime))
        with pytest.raises(InvalidFields) as error:
            driver.open()
        assert "joints.1.simulated.inertia_kg_m2" in str(error.value)
        driver.close()


def test_faults_of_the_robot_file_reach_the_run(make_robot):
    run = Run(make_robot(options={"faults": [{"kind": "fault", "joint": "0", "at_s": 0.3, "code": 0x7305}]}))
    run.cycle(80)
    assert run.feedback[0].state is JointState.ENABLED
    run.cycle(400)
    assert run.feedback[0].state is JointState.FAULT and run.feedback[0].error_code == 0x7305
    assert run.feedback[1].state is JointState.ENABLED
    run.driver.stop_cycling()
    run.driver.close()


# -- wall clock --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_wall_clock_run(make_robot):
    """Drives in a process of their own; how exactly they keep time is ``test_virtual_wall_clock``'s business."""
    began_s = time.monotonic()
    run = Run(make_robot(realtime=True))
    assert isinstance(run.driver.clock, WallClock) and not run.driver.capabilities().lock_step
    run.cycle(600, swing)
    assert run.feedback[0].state is JointState.ENABLED
    run.cycle(50)
    assert run.feedback[0].position_rad == pytest.approx(run.points[0].position_rad, abs=0.002)
    assert time.monotonic() - began_s > 0.85, "run time is the wall clock's"
    run.driver.stop_cycling()
    run.driver.close()


@pytest.mark.slow
def test_faults_strike_across_two_processes_too(make_robot):
    """The drives' own process spoils what they say, and this one what is sent."""
    faults = [{"kind": "mute", "joint": "1", "at_s": 0.4}, {"kind": "stall", "at_s": 0.3, "delay_s": 0.02}]
    run = Run(make_robot(realtime=True, options={"faults": faults}))
    with pytest.raises(SafetyAbort, match="no heartbeat"):
        run.cycle(1000, swing)
    run.driver.close()


def sdo(bus, node, index, subindex=0):
    """One upload by a member of the bus."""
    bus.send(can.Message(arbitration_id=0x600 + node, data=struct.pack("<BHB4x", 0x40, index, subindex), is_extended_id=False))  # fmt: skip  # noqa: E501
    deadline_s = time.monotonic() + 2
    while time.monotonic() < deadline_s:
        reply = bus.recv(0.5)
        if reply is not None and reply.arbitration_id == 0x580 + node:
            return int.from_bytes(reply.data[4:8], "little", signed=True)
    raise AssertionError("no answer")


HOST = """
import sys, time
from frictid_drivers.virtual.rack_launcher import decode_setup
from frictid_drivers.virtual import VirtualDriver
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import SetPoint
setup = decode_setup(sys.stdin.readline())
driver = VirtualDriver(setup)
driver.open()
driver.configure(500.0, ["0"])
driver.start_cycling()
driver.enable("0", Mode.VELOCITY)
points = [SetPoint(position_rad=joint.locked_position_rad) for joint in setup.joints]
n = 0
while True:
    n += 1
    driver.clock.wait_until(n * 2_000_000)
    points[0].velocity_rad_s = min(0.5, max(0.0, (n - 100) * 0.01))
    feedback = driver.exchange(points)
    if n == 250:
        print("moving", feedback[0].velocity_rad_s, flush=True)
"""


@pytest.mark.slow
def test_killed_host_leaves_a_joint_that_its_drive_stops(make_robot):
    """SIGKILL of the host: nobody is left but the drive's own watchdog, seen by a second member of the bus."""
    host = subprocess.Popen([sys.executable, "-c", HOST], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    host.stdin.write(encode_setup(make_robot(realtime=True)) + "\n")
    host.stdin.flush()
    word, _, speed = host.stdout.readline().partition(" ")
    assert word == "moving" and float(speed) == pytest.approx(0.5, abs=0.05)
    with SocketBus("bench") as witness:
        assert sdo(witness, 1, 0x6041) & 0x6F == 0x27
        os.kill(host.pid, signal.SIGKILL)
        killed_s = time.monotonic()
        host.wait()
        host.stdin.close()
        host.stdout.close()
        while sdo(witness, 1, 0x6041) & 0x6F == 0x27:
            assert time.monotonic() - killed_s < 2
            time.sleep(0.01)
        stopped_by_s = time.monotonic() - killed_s
        positions = []
        while time.monotonic() - killed_s < 1.5:
            positions.append(sdo(witness, 1, 0x6064))
            time.sleep(0.05)
        assert stopped_by_s < 0.5
        assert len(set(positions[-5:])) == 1, "at a standstill"
        assert sdo(witness, 1, 0x606C) == 0
        assert sdo(witness, 1, 0x603F) & 0xFFFF == 0x8130, "by the heartbeat watchdog"
    deadline_s = time.monotonic() + 8
    while channel.socket_path("bench").exists():
        assert time.monotonic() < deadline_s, "the drives outlive their owner for ever"
        time.sleep(0.05)


@pytest.mark.slow
def test_drives_end_with_their_owner_in_good_order(make_robot):
    rack = start_rack(make_robot(realtime=True))
    bus = SocketBus("bench")
    assert sdo(bus, 2, 0x1000) == 0x20192
    write_object(bus, 2, 0x6065, 0, 4321)
    assert sdo(bus, 2, 0x6065) == 4321
    with pytest.raises(HardwareError, match="06010002h"):
        write_object(bus, 2, 0x6041, 0, 0)
    bus.shutdown()
    rack.stop()
    with pytest.raises(ProcessLookupError):
        os.kill(rack.pid, 0)
    with pytest.raises(can.CanInitializationError):
        SocketBus("bench")
