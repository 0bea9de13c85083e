"""Cyclic traffic on the wall clock."""

from __future__ import annotations

import math
import time

import can
from cia402_wire import ScriptedDrive, WireBus, robot

from frictid_drivers.cia402 import Cia402Driver
from frictid_hil.protocol.driver import SetPoint

RAD = 2 * math.pi / (4096 * 50)


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
