"""Another protocol than the template's, by the guide for driver authors: it passes, in 150 lines, by public names."""

from __future__ import annotations

import ast
import math
import struct
from dataclasses import replace
from pathlib import Path

import odrive_driver as mine
import pytest

from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.testing.driver_conformance import DriverConformance, Truth
from frictid_hil.testing.wire import FakeCanBus, ManualClock

STEP_S, GEAR = 0.0005, 8.0
INERTIA_KG_M2, COULOMB_NM, VISCOUS_NM_S = 0.02, 0.3, 0.05
PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "driver-helpers.md"


class FakeAxis:
    """One ODrive axis; inside it everything is joint side, in the motor's direction."""

    def __init__(self, joint):
        self.node, self.limit_nm = joint.address, joint.max_torque_nm
        self.position, self.velocity, self.torque = joint.direction * joint.locked_position_rad, 0.0, 0.0
        self.state, self.control, self.asked = 1, 3, [0.0, 0.0, 0.0]

    def hear(self, command, data):
        turn = math.tau / GEAR
        if command == 0x07:
            if (state := data[0]) == 8 != self.state:
                self.asked = [self.position, 0.0, 0.0]
            self.state = state
        elif command == 0x0B:
            self.control, self.asked = data[0], [self.position, 0.0, 0.0]
        elif command == 0x0C:
            position, velocity, torque = struct.unpack("<fhh", data)
            self.asked = [position * turn, velocity * 1e-3 * turn, torque * 1e-3 * GEAR]
        elif command == 0x0D:
            velocity, torque = struct.unpack("<ff", data)
            self.asked = [0.0, velocity * turn, torque * GEAR]
        elif command == 0x0E:
            self.asked = [0.0, 0.0, struct.unpack("<f", data)[0] * GEAR]

    def reports(self):
        revolutions = self.position / math.tau * GEAR, self.velocity / math.tau * GEAR
        yield self.node << 5 | 0x01, struct.pack("<IB3x", 0, self.state)
        yield self.node << 5 | 0x09, struct.pack("<ff", *revolutions)
        yield self.node << 5 | 0x1C, struct.pack("<ff", self.asked[2] / GEAR, self.torque / GEAR)

    def advance(self):
        position, velocity, torque = self.asked
        if self.control >= 2:
            torque += 2.0 * (velocity - self.velocity)
        if self.control == 3:
            torque += 60.0 * (position - self.position)
        self.torque = min(max(torque, -self.limit_nm), self.limit_nm) if self.state == 8 else 0.0
        friction = COULOMB_NM * math.tanh(self.velocity / 0.002) + VISCOUS_NM_S * self.velocity
        stiff = 1.0 + STEP_S * COULOMB_NM / 0.002 / INERTIA_KG_M2 / math.cosh(min(abs(self.velocity) / 0.002, 50)) ** 2
        self.velocity += STEP_S * (self.torque - friction) / INERTIA_KG_M2 / stiff
        self.position += STEP_S * self.velocity


class FakeRobot:
    def __init__(self, setup):
        self.axes = {joint.name: FakeAxis(joint) for joint in setup.joints}
        self.steps = 0

    def receive(self, can_id, data):
        for axis in self.axes.values():
            if axis.node == can_id >> 5:
                axis.hear(can_id & 0x1F, data)
                return list(axis.reports())
        return []

    def advance(self, to_ns):
        while self.steps * STEP_S * 1e9 < to_ns:
            self.steps += 1
            for axis in self.axes.values():
                axis.advance()


class Bench:
    def __init__(self):
        first = JointSetup(
            "0", 1, gear_ratio=GEAR, direction=1, max_velocity_rad_s=10.0, max_torque_nm=8.0, rated_torque_nm=3.0,
            position_min_rad=-2.0, position_max_rad=2.0, start_position_rad=0.0, locked_position_rad=0.0,
        )  # fmt: skip
        second = replace(first, name="1", address=2, direction=-1)
        options = {"allow_torque_without_watchdog": True}
        self.setup = RobotSetup("odrive", "fake:0", cycle_hz=400.0, joints=(first, second), options=options)

    def driver(self):
        self.robot = FakeRobot(self.setup)
        clock = ManualClock(self.robot.advance)
        self.bus = FakeCanBus(self.robot, clock)
        return mine.Driver(self.setup, bus_factory=lambda: self.bus, clock=clock)

    def truth(self, joint):
        axis, sign = self.robot.axes[joint], self.setup.joint(joint).direction
        return Truth(sign * axis.position, sign * axis.velocity, sign * axis.torque, axis.state == 8)

    def silence(self, silent):
        self.bus.fault = (lambda frame, to_host: [] if to_host else [frame]) if silent else None

    def decoder(self, driver):
        return mine.decoder(driver.frame_map_values())


class TestOutsider(DriverConformance):
    @pytest.fixture
    def bench(self):
        return Bench()


def test_it_is_short_and_uses_what_the_page_names():
    text, page = Path(mine.__file__).read_text(), PAGE.read_text()
    assert len(text.splitlines()) <= 150
    for node in ast.walk(ast.parse(text)):
        modules = [node.module] if isinstance(node, ast.ImportFrom) else []
        modules += [one.name for one in node.names if "." in one.name] if isinstance(node, ast.Import) else []
        assert all(f"`{module}`" in page or f"from {module} import" in page for module in modules), modules
        if isinstance(node, ast.Attribute):
            assert not node.attr.startswith("_") or node.attr.startswith("__"), node.attr
