"""A bench of simulated MIT-mode actuators for the tests of this room."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from frictid_drivers.mit.driver import MitDriver
from frictid_drivers.mit.simulated import Rack
from frictid_hil.config.robot import Robot, load_robot
from frictid_hil.config.search import find
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.driver import Feedback, JointState, SetPoint
from frictid_hil.testing.wire import FakeCanBus, ManualClock

FAMILIES = {
    "damiao": {"model": "DM-J4310"},
    "robstride": {"model": "RS00"},
    "cybergear": {"model": "CyberGear"},
    "robstride-mit": {"model": "RS00", "protocol": "robstride-mit"},
    "cubemars": {"model": "AK80-9"},
}


def robot_file(folder: Path, family: str, changes: Mapping[str, Any] | None = None, *, joints: int = 1) -> Path:
    """The shipped bench with motors of this family, as a file of its own."""
    values: dict[str, Any] = yaml.safe_load(find("mit-bench.yaml").read_text())
    values["name"], values["bus"] = f"bench-{family}", f"virtual:{family}"
    joint = values["joints"]["0"]
    joint["options"] = {**joint["options"], **FAMILIES[family]}
    values["joints"] = {str(k): {**joint, "id": k + 1} for k in range(joints)}
    path = folder / f"{family}.yaml"
    path.write_text(yaml.safe_dump({**values, **(changes or {})}))
    return path


def robot(folder: Path, family: str, changes: Mapping[str, Any] | None = None, *, joints: int = 1) -> Robot:
    return load_robot(robot_file(folder, family, changes, joints=joints))


class Bench:
    """A driver, its clock, its bus and what hangs on it."""

    def __init__(self, setup: RobotSetup, **options: Any) -> None:
        self.setup = replace(setup, options={**setup.options, **options})
        self.rack = Rack(self.setup)
        self.clock = ManualClock(self.rack.advance)
        self.bus = FakeCanBus(self.rack, self.clock)
        self.frames: list[tuple[int, int, bytes]] = []
        self.driver = MitDriver(self.setup, bus_factory=lambda: self.bus, clock=self.clock)
        self.set_points = [SetPoint() for _ in setup.joints]

    def sink(self, t_ns: int, can_id: int, data: bytes, sent: bool) -> None:
        self.frames.append((t_ns, can_id, data))

    def begin(self, cycle_hz: float = 500.0) -> None:
        self.driver.open(self.sink)
        self.driver.configure(cycle_hz, [joint.name for joint in self.setup.joints])
        for joint in self.setup.joints:
            self.driver.set_limits(joint.name, torque_nm=7.0, position_min_rad=-2.0, position_max_rad=2.0)
        self.period_ns = round(1e9 / cycle_hz)
        self.driver.start_cycling()

    def cycles(self, count: int) -> list[Feedback]:
        for _ in range(count):
            self.clock.wait_until(self.clock.now_ns() + self.period_ns)
            reports = self.driver.exchange(self.set_points)
        return list(reports)

    def enabled(self, mode: Any) -> None:
        for joint in self.setup.joints:
            self.driver.enable(joint.name, mode)
        assert all(report.state is JointState.ENABLED for report in self.cycles(4))
