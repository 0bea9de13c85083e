"""A robot of few servos, and a driver in front of simulated ones, byte by byte."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from frictid_drivers.servos.driver import ServoDriver
from frictid_drivers.servos.models import MODELS
from frictid_drivers.servos.simulated import Chain
from frictid_hil.config.robot import load_robot
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.driver import Feedback, JointState, SetPoint
from frictid_hil.testing.wire import ManualClock


def setup_of(
    model: str,
    joints: int = 2,
    *,
    bus: Mapping[str, object] | None = None,
    stiffness: float = 0.0,
    direction: int = 1,
) -> RobotSetup:
    setup = load_robot("so101.yaml").to_setup()
    options = {"model": model, "zero_counts": MODELS[model].counts_per_turn // 2}
    return replace(
        setup,
        options={**setup.options, **(bus or {})},
        joints=tuple(
            replace(
                joint,
                options=options,
                direction=direction,
                position_min_rad=-1.5,
                position_max_rad=1.5,
                loop_stiffness_nm_per_rad=stiffness,
            )
            for joint in setup.joints[:joints]
        ),
    )


class Bench:
    def __init__(self, setup: RobotSetup) -> None:
        self.setup = setup
        self.chain = Chain(setup)
        self.clock = ManualClock(self.chain.advance)
        self.chain.clock = self.clock
        self.frames: list[tuple[int, int, bytes]] = []
        self.driver = ServoDriver(setup, port_factory=lambda: self.chain, clock=self.clock)
        self.set_points = [SetPoint() for _ in setup.joints]

    def begin(self, cycle_hz: float = 200.0) -> None:
        self.driver.open(lambda t_ns, can_id, data, sent: self.frames.append((t_ns, can_id, data)))
        self.driver.configure(cycle_hz, [joint.name for joint in self.setup.joints])
        self.period_ns = round(1e9 / cycle_hz)
        self.driver.start_cycling()
        self.next_ns = self.clock.now_ns()

    def cycles(self, count: int) -> list[Feedback]:
        for _ in range(count):
            self.next_ns += self.period_ns
            self.clock.wait_until(self.next_ns)
            reports = self.driver.exchange(self.set_points)
        return list(reports)

    def enabled(self) -> None:
        for joint in self.setup.joints:
            self.driver.enable(joint.name, Mode.POSITION)
        assert all(report.state is JointState.ENABLED for report in self.cycles(4))

    def servo(self, at: int) -> Any:
        return list(self.chain.servos.values())[at]
