"""moteus by the guide for driver authors: CAN FD, 29-bit identifiers, a watchdog in every command.

The fake is written from the maker's protocol pages: it reads whatever subframes come, in any order and type it knows.
"""

from __future__ import annotations

import ast
import math
import struct
from dataclasses import replace
from pathlib import Path

import moteus_driver as mine
import pytest
import yaml

from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.compensate import CompensateOptions, compensate
from frictid_hil.jobs.compensation.wanted import Wanted
from frictid_hil.jobs.watch import Silent
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.driver import EXTENDED, FD_FRAME
from frictid_hil.testing.driver_conformance import DriverConformance, Truth
from frictid_hil.testing.wire import FakeCanBus, ManualClock

STEP_S = 0.0005
INERTIA_KG_M2, COULOMB_NM, VISCOUS_NM_S = 0.02, 0.3, 0.05
PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "driver-helpers.md"
FORMATS = {0: "<b", 4: "<h", 8: "<i", 12: "<f"}


def subframes(data):
    """Kind (write, read), type, first register and values of each."""
    at = 0
    while at < len(data) and data[at] != 0x50:
        kind, layout, count = data[at] & 0xF0, FORMATS[data[at] & 0x0C], data[at] & 3
        at += 1
        if not count:
            count, at = data[at], at + 1
        register, at, size = data[at], at + 1, struct.calcsize(layout)
        values = (
            [struct.unpack_from(layout, data, at + k * size)[0] for k in range(count)] if kind == 0 else [None] * count
        )
        at += size * count if kind == 0 else 0
        yield kind, layout, register, values


class FakeController:
    """One of them; inside it everything is at the output shaft, in its own direction, in rad."""

    def __init__(self, joint):
        self.id, self.most_nm = joint.address, joint.max_torque_nm
        self.position, self.velocity, self.torque = joint.direction * joint.locked_position_rad, 0.0, 0.0
        self.mode, self.left_s, self.asked = 0, 0.0, {}

    def hear(self, data):
        wanted, asked = None, {}
        answer = b""
        for kind, layout, register, values in subframes(data):
            if kind == 0x00:
                for number, value in enumerate(values, register):
                    wanted = value if number == 0 else wanted
                    asked[number] = value
            elif kind == 0x10:
                told = {
                    0: self.mode,
                    1: self.position / math.tau,
                    2: self.velocity / math.tau,
                    3: self.torque,
                    13: 48,
                    14: 31,
                    15: 0,
                }
                head = 0x20 | next(code for code, one in FORMATS.items() if one == layout)
                count = len(values)
                answer += bytes([head | count, register] if count < 4 else [head, count, register])
                answer += b"".join(struct.pack(layout, told[register + k]) for k in range(count))
        if wanted is not None and not (self.mode == 11 and wanted != 0):
            if wanted == 10:
                place = asked[0x20] * math.tau
                hold = self.asked.get("place", self.position) if self.mode == 10 else self.position
                asked["place"] = hold if math.isnan(place) else place
            self.mode, self.asked, self.left_s = wanted, asked, asked.get(0x27, math.inf)
        return answer

    def advance(self):
        self.left_s -= STEP_S
        if self.mode == 10 and self.left_s < 0:
            self.mode = 11
        torque = 0.0
        if self.mode == 10:
            asked = self.asked
            torque = 60.0 * asked[0x23] * (asked["place"] - self.position)
            torque += 1.5 * min(asked[0x23], asked[0x24]) * (asked[0x21] * math.tau - self.velocity) + asked[0x22]
            torque = min(max(torque, -asked[0x25]), asked[0x25])
        elif self.mode in (11, 15):
            torque = -1.5 * self.velocity
        self.torque = min(max(torque, -self.most_nm), self.most_nm)
        friction = COULOMB_NM * math.tanh(self.velocity / 0.002) + VISCOUS_NM_S * self.velocity
        stiff = 1.0 + STEP_S * COULOMB_NM / 0.002 / INERTIA_KG_M2 / math.cosh(min(abs(self.velocity) / 0.002, 50)) ** 2
        self.velocity += STEP_S * (self.torque - friction) / INERTIA_KG_M2 / stiff
        self.position += STEP_S * self.velocity


class FakeRobot:
    def __init__(self, setup):
        self.controllers = {joint.name: FakeController(joint) for joint in setup.joints}
        self.steps = 0

    def receive(self, can_id, data):
        assert can_id & FD_FRAME and can_id & EXTENDED and len(data) in (8, 12, 16, 20, 24, 32, 48, 64)
        for controller in self.controllers.values():
            if can_id & 0xFF == controller.id:
                answer = controller.hear(data)
                answered = controller.id << 8 | (EXTENDED if controller.id > 7 else 0)
                return [(FD_FRAME | answered, answer)] if can_id & 0x8000 else []
        return []

    def advance(self, to_ns):
        while self.steps * STEP_S * 1e9 < to_ns:
            self.steps += 1
            for controller in self.controllers.values():
                controller.advance()


class Bench:
    def __init__(self):
        first = JointSetup(
            "0", 1, gear_ratio=8.0, direction=1, max_velocity_rad_s=10.0, max_torque_nm=8.0, rated_torque_nm=3.0,
            position_min_rad=-2.0, position_max_rad=2.0, start_position_rad=0.0, locked_position_rad=0.0,
        )  # fmt: skip
        second = replace(first, name="1", address=12, direction=-1)
        self.setup = RobotSetup("moteus", "fake:0", cycle_hz=500.0, joints=(first, second))

    def driver(self):
        self.robot = FakeRobot(self.setup)
        clock = ManualClock(self.robot.advance)
        self.bus = FakeCanBus(self.robot, clock)
        return mine.Driver(self.setup, bus_factory=lambda: self.bus, clock=clock)

    def truth(self, joint):
        one, sign = self.robot.controllers[joint], self.setup.joint(joint).direction
        return Truth(sign * one.position, sign * one.velocity, sign * one.torque, one.mode not in (0, 1, 11))

    def silence(self, silent):
        self.bus.fault = (lambda frame, to_host: [] if to_host else [frame]) if silent else None

    def decoder(self, driver):
        return mine.decoder(driver.frame_map_values())


class TestMoteus(DriverConformance):
    @pytest.fixture
    def bench(self):
        return Bench()


class SimulatedDriver(mine.Driver):
    """As a package would bring one beside the driver: the same, with the fake on its wire."""

    kind = replace(mine.Driver.kind, simulated=True)

    def __init__(self, setup):
        robot = FakeRobot(setup)
        clock = ManualClock(robot.advance)
        super().__init__(setup, bus_factory=lambda: FakeCanBus(robot, clock), clock=clock)


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Registered as any installed package does it; the robot file of one joint."""
    info = tmp_path / "frictid_moteus-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: frictid-moteus\nVersion: 1.0\n")
    points = "[frictid_hil.drivers]\nmoteus = test_moteus:SimulatedDriver\n"
    (info / "entry_points.txt").write_text(points + "[frictid_hil.frame_decoders]\nmoteus = moteus_driver\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    joint = {
        "id": 1, "gear_ratio": 8, "max_velocity_rad_s": 6.0, "max_torque_nm": 8.0, "rated_torque_nm": 3.0,
        "position_min_rad": -2.0, "position_max_rad": 2.0, "start_position_rad": 0.0, "locked_position_rad": 0.0,
    }  # fmt: skip
    values = {
        "schema": "frictid.robot/1", "name": "bench", "driver": "moteus", "bus": "socketcan:absent", "cycle_hz": 500,
        "procedure": {"amplitude_rad": 0.6, "velocity_rad_s": 2.0, "cycles": 4, "ratio": 0.8}, "joints": {"0": joint},
    }  # fmt: skip
    path = tmp_path / "bench.yaml"
    path.write_text(yaml.safe_dump(values))
    return path


@pytest.mark.slow
def test_a_joint_behind_it_is_calibrated_and_compensated(installed):
    run = installed.parent / "run"
    result = calibrate(CalibrateOptions(str(installed), out=run), Silent()).to_json()
    assert result["outcome"] == "ok", result.get("error", result)
    assert result["joints"]["0"]["coulomb_nm"] == pytest.approx(COULOMB_NM, rel=0.05)
    # The fake slides at once: there is no presliding stiffness to be found.
    wanted = Wanted("track", ("nc", "mop"), duration_s=3.0, stiffness_nm_per_rad=30.0, ratio=0.6)
    options = CompensateOptions(str(installed), run / "profile.yaml", "0", wanted, out=run.parent / "compensated")
    result = compensate(options, Silent()).to_json()
    assert result["outcome"] == "ok", result.get("error", result)
    assert result["modes"]["mop"]["tracking_rms_rad"] < 0.8 * result["modes"]["nc"]["tracking_rms_rad"]


def test_frames_of_the_makers_page():
    """Its example of a command and of an answer, taken apart by the fake."""
    command = bytes.fromhex("01000a07206000200150ff140400130d")
    kinds = [(kind, register, values) for kind, _, register, values in subframes(command)]
    assert kinds[:2] == [(0, 0x00, [10]), (0, 0x20, [96, 288, -176])]
    assert [(kind, register, len(values)) for kind, register, values in kinds[2:]] == [(0x10, 0, 4), (0x10, 0x0D, 3)]
    one = FakeController(Bench().setup.joints[0])
    one.mode, one.position = 10, 0.0050 * math.tau
    assert one.hear(bytes.fromhex("1c0400130d"))[:7] == bytes.fromhex("2c0400") + struct.pack("<f", 10.0)


def test_it_is_short_and_uses_what_the_page_names():
    text, page = Path(mine.__file__).read_text(), PAGE.read_text()
    assert len(text.splitlines()) <= 150
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom):
            assert f"`{node.module}`" in page or f"from {node.module} import" in page, node.module
        if isinstance(node, ast.Attribute):
            assert not node.attr.startswith("_"), node.attr
