"""A bench for the serial driver: it and an emulated controller on one virtual wire, an ideal joint behind."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from frictid_drivers.motoman import MotomanDriver
from frictid_drivers.motoman.emulator.axis import Axis, Plate
from frictid_drivers.motoman.emulator.faults import Fault, FaultPlan
from frictid_drivers.motoman.emulator.loopback import LoopbackPort
from frictid_drivers.motoman.emulator.machine import Emulator
from frictid_drivers.motoman.emulator.panel import Settings
from frictid_drivers.motoman.host_control import PROFILES, HostControl
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.driver import Feedback, SetPoint

PULSES_PER_DEGREE = 1000.0
GEAR = 100.0
START_RAD = 0.2


class IdealServo:
    """A joint that is where it is told to be; its torque is a known function of its velocity."""

    def __init__(self, position_rad: float) -> None:
        self.measured_position_rad = position_rad
        self.velocity_rad_s = 0.0
        self.torque_nm = 0.0
        self.powered = False
        self._mode = 8

    def power(self, on: bool) -> None:
        self.powered = on

    def brake(self, engaged: bool) -> None:
        pass

    def set_mode(self, mode: int) -> None:
        self._mode = mode

    def advance(
        self, duration_s: float, *, position_rad: float = 0.0, torque_nm: float = 0.0, torque_offset_nm: float = 0.0
    ) -> None:
        if self.powered and self._mode == 8:
            self.velocity_rad_s = (position_rad - self.measured_position_rad) / duration_s
            self.measured_position_rad = position_rad
        else:
            self.velocity_rad_s = 0.0
        self.torque_nm = 10.0 * math.tanh(self.velocity_rad_s / 0.01) + 3.0 * self.velocity_rad_s


def joint(name: str = "0", axis: int = 0, *, direction: int = 1, **options: Any) -> JointSetup:
    return JointSetup(
        name=name,
        address=axis,
        gear_ratio=GEAR,
        direction=direction,
        max_velocity_rad_s=3.0,
        max_torque_nm=50.0,
        rated_torque_nm=20.0,
        position_min_rad=-1.0,
        position_max_rad=1.0,
        start_position_rad=START_RAD,
        locked_position_rad=START_RAD,
        options={"pulses_per_degree": PULSES_PER_DEGREE, **options},
    )


@dataclass
class Bench:
    """One driver, one controller, one wire; and what really happened on axis 0, by tick of the stream."""

    setup: RobotSetup
    emulator: Emulator
    opened: list[LoopbackPort] = field(default_factory=list)
    truth_rad: dict[int, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        axis = self.emulator.axes[0]
        run = axis.run

        def remember_and_run(duration_s: float) -> None:
            if self.emulator.stream is not None:
                self.truth_rad[self.emulator.stream.tick_number] = axis.pulses / axis.plate.pulses_per_rad
            run(duration_s)

        axis.run = remember_and_run  # type: ignore[method-assign]

    def still_moving(self) -> bool:
        """Let two seconds pass; whether the arm moved in the last of them, or the controller thinks it does."""
        emulator = self.emulator
        emulator.advance(emulator.now_s + 1.0)
        before = [axis.issued for axis in emulator.axes]
        emulator.advance(emulator.now_s + 1.0)
        return emulator.panel.operating or before != [axis.issued for axis in emulator.axes]

    def port(self, path: str, baud: int, parity: str) -> LoopbackPort:
        port = LoopbackPort(self.emulator, baud, parity)
        self.opened.append(port)
        return port

    def driver(self) -> MotomanDriver:
        return MotomanDriver(self.setup, port_factory=self.port)

    def host(self, profile: str = "nx", **arguments: Any) -> HostControl:
        return HostControl(self.port("loopback", *self.emulator.line), PROFILES[profile], **arguments)


def make_bench(
    *,
    axes: int = 1,
    faults: Sequence[str] = (),
    settings: dict[str, Any] | None = None,
    direction: int = 1,
    **options: Any,
) -> Bench:
    """``make_bench(axes=2, layer="batch", faults=["nak@3"], settings={...})``; the rest are options of the driver."""
    joints = tuple(joint(str(k), k, direction=direction) for k in range(axes))
    setup = RobotSetup("bench", "serial:loopback", 250.0, joints, {"stream_baud": 921600, "lead_ticks": 4, **options})
    per_rad = direction * math.degrees(PULSES_PER_DEGREE)
    limit = math.ceil(abs(per_rad))
    plate = Plate(per_rad, GEAR, 20.0, -limit, limit, math.ceil(3.3 * abs(per_rad) * 0.004))
    made = Settings(**{"baud": int(options.get("baud", 19200)), **(settings or {})})
    emulator = Emulator(
        [Axis(plate, cast(Any, IdealServo(START_RAD)), made.averaging_ticks) for _ in range(axes)],
        made,
        FaultPlan(Fault.parse(text) for text in faults),
    )
    return Bench(setup, emulator)


@dataclass
class Streamed:
    """What a short streamed motion recorded of joint 0: rows of run time, position, velocity, torque."""

    rows: list[tuple[int, float, float, float]] = field(default_factory=list)
    first_tick: int = 0

    def ticks(self) -> list[int]:
        """Tick of every row."""
        return [self.first_tick + row[0] // 4_000_000 for row in self.rows]


def stream_motion(
    driver: MotomanDriver, *, ticks: int = 50, travel_rad: float = 0.05, into: Streamed | None = None
) -> Streamed:
    """Streams one raised cosine on joint 0."""
    streamed = into if into is not None else Streamed()
    joints = list(driver.identify())
    set_points = [SetPoint() for _ in joints]
    driver.configure(250.0, joints[:1])
    driver.start_cycling()
    streamed.first_tick = -driver.clock.tick_ns(0) // 4_000_000
    deadline_ns = driver.clock.now_ns()
    reports: Sequence[Feedback] = ()

    def cycle() -> None:
        nonlocal deadline_ns, reports
        deadline_ns = max(deadline_ns + 4_000_000, driver.clock.now_ns())
        driver.clock.wait_until(deadline_ns)
        reports = driver.exchange(set_points)
        first = reports[0]
        if first.age_cycles == 0:
            streamed.rows.append((first.t_ns, first.position_rad, first.velocity_rad_s, first.torque_nm))

    cycle()
    for set_point, report in zip(set_points, reports, strict=True):
        set_point.position_rad = report.position_rad
    start_rad = set_points[0].position_rad
    for name in joints:
        driver.enable(name, Mode.POSITION)
    for _ in range(6):
        cycle()
    for k in range(1, ticks + 1):
        set_points[0].position_rad = start_rad + travel_rad / 2 * (1 - math.cos(2 * math.pi * k / ticks))
        cycle()
    for _ in range(10):
        cycle()
    for name in joints:
        driver.disable(name)
    cycle()
    driver.stop_cycling()
    return streamed
