"""A driver on a bench of simulated drives whose wire can be listened to."""

from __future__ import annotations

import math
import os

import yaml
from cia402_wire import HandClock, ScriptedDrive, WireBus, robot

from frictid_drivers.cia402 import Cia402Driver
from frictid_hil.config.search import find
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.driver import JointState, SetPoint

RAD = 2 * math.pi / (4096 * 50)


PROFILE = find("hp3j.yaml").resolve()
FIELDS = (
    "gear_ratio",
    "direction",
    "max_velocity_rad_s",
    "max_torque_nm",
    "rated_torque_nm",
    "position_min_rad",
    "position_max_rad",
    "start_position_rad",
    "locked_position_rad",
    "simulated",
)


def hp3j(**changes):
    plain = yaml.safe_load(PROFILE.read_text())
    joints = tuple(
        JointSetup(name=name, address=joint["node"], **{key: joint[key] for key in FIELDS}, **changes)
        for name, joint in plain["joints"].items()
    )
    return RobotSetup("hp3j", f"virtual:cia402-test-{os.getpid()}", float(plain["cycle_hz"]), joints)


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
