"""The driver for servos on a serial line. They close their own position loop; we give goals and read what they report.

Torque is current (or duty) times a constant of the model, so it bears a scale error that ``check`` states. Goals go out
at the beginning of a cycle and are followed by the reading half a cycle later (``logs`` says why).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from frictid_drivers.servos.line import Line, PortFactory, SerialPort
from frictid_drivers.servos.logs import SPEED_CYCLES, Reader, frame_map_values, to_bytes
from frictid_drivers.servos.packets import WIRES
from frictid_drivers.servos.settings import JointSettings, read_settings
from frictid_hil.errors import ConfigError, FrictidError, HardwareError, PlanRefused, SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import Plan
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.driver import (
    Capabilities,
    Clock,
    DriverKind,
    Feedback,
    Finding,
    FrameSink,
    JointIdentity,
    JointState,
    SetPoint,
    Severity,
    Timing,
    WallClock,
)
from frictid_hil.protocol.rows import RowDecoder
from frictid_hil.protocol.wishes import Do, Wish

_TRIES = 3
_SETTLE_S = 1.5
_BUSIEST = 0.45
"""Share of a cycle that the line may take: the reading begins in its middle."""
_WATCHDOG_STEP_S = 0.02


class ServoDriver:
    """Servos on one serial line.

    Args:
        setup: the robot; ``settings`` lists the options it may carry.
        port_factory: opens the port (a simulated one).
        clock: run time.

    Raises:
        InvalidFields: an option of the robot file is wrong.
        ConfigError: the bus is no serial port.
    """

    kind = DriverKind(
        line="serial",
        addressed_by="id",
        addresses=(0, 252),
        elsewhere={"virtual": "virtual-servos"},
        takes_torque=False,
        # A servo without integral part stands beside its goal; one step more or less in 40 ms is a speed.
        care={"still_rad": 0.03, "still_rad_s": 0.1},
    )

    def __init__(
        self, setup: RobotSetup, *, port_factory: PortFactory | None = None, clock: Clock | None = None
    ) -> None:
        interface, _, path = setup.bus.partition(":")
        if port_factory is None and interface != "serial":
            raise ConfigError(
                f"servos are on a serial port, found {setup.bus!r}", next_step="--bus serial:/dev/ttyACM0"
            )
        self.setup = setup
        self.clock: Clock = WallClock() if clock is None else clock
        self._line_settings, self._joints = read_settings(setup)
        self._wire = WIRES[self._joints[0].model.wire]
        self._registers = self._joints[0].model.registers
        self._port_factory = port_factory or (lambda: SerialPort(path, self._line_settings.baud))
        self._line: Line | None = None
        self._told: dict[str, tuple[int, int, float]] = {}
        self._reader: Reader | None = None
        self._rows: RowDecoder | None = None
        self._wishes: list[Wish] = []
        self._powered: list[bool] = []
        self._holding: list[int | None] = []
        self._cycle_hz = 0.0

    # -- reaching them ------------------------------------------------------------------------------------------

    def open(self, frame_sink: FrameSink | None = None) -> None:
        """Take the port and hear from every servo; reads only.

        Raises:
            HardwareBusy: another process holds the port.
            HardwareError: no such port, or a servo does not answer.
        """
        try:
            self._line = Line(self._port_factory(), self._wire, frame_sink, self.clock)
            registers = self._registers
            for joint, mine in zip(self.setup.joints, self._joints, strict=True):
                model = int.from_bytes(self._ask(mine, registers.model, 2), "little")
                mode = self._ask(mine, registers.mode, 1)[0]
                delay_s = self._ask(mine, registers.return_delay, 1)[0] * 2e-6
                self._told[joint.name] = (model, mode, delay_s)
        except BaseException:
            self.close()
            raise

    def identify(self) -> dict[str, JointIdentity]:
        """What every servo told when it was reached, and what its numbers are worth."""
        self._open_line()
        return {
            joint.name: JointIdentity(
                joint=joint.name,
                product=f"{mine.name} (model number {self._told[joint.name][0]})",
                rated_torque_nm=joint.rated_torque_nm,
                gear_ratio=joint.gear_ratio,
                position_resolution_rad=mine.model.count_rad,
                torque_resolution_nm=mine.torque_nm_per_unit,
                torque_source=_torque_source(mine),
                timing=Timing(uncertainty_s=0.002, velocity_delay_s=self._velocity_delay_s()),
                settings={"torque_uncertainty_percent": mine.model.uncertainty_percent},
            )
            for joint, mine in zip(self.setup.joints, self._joints, strict=True)
        }

    def capabilities(self) -> Capabilities:
        """Position only: there is no torque to command, and no offset."""
        self._open_line()
        return Capabilities(
            max_cycle_hz=self._highest_rate_hz(),
            modes=frozenset({Mode.POSITION}),
            drive_watchdog=bool(self._registers.watchdog),
            lock_step=self.clock.lock_step,
            temperature=self._registers.temperature >= 0,
        )

    def check(self, plan: Plan | None) -> list[Finding]:
        """Everything that can be said without moving or writing."""
        self._open_line()
        cycle_hz, most_hz = self.setup.cycle_hz if plan is None else plan.cycle_hz, self._highest_rate_hz()
        fits = cycle_hz <= most_hz
        findings = [
            Finding(
                Severity.OK if fits else Severity.ERROR,
                "bus load",
                f"{len(self._joints)} servos at {self._line_settings.baud} bit/s: at most {most_hz:g} Hz, "
                f"{cycle_hz:g} Hz asked",
                "" if fits else f"use a rate of at most {most_hz:g} Hz (`--rate`, or `cycle_hz` in the robot file)",
            )
        ]
        for joint, mine in zip(self.setup.joints, self._joints, strict=True):
            subject, mode = f"joint {joint.name}", self._told[joint.name][1]
            findings.append(Finding(Severity.OK, subject, f"{mine.name} answers"))
            findings.append(
                Finding(
                    Severity.WARNING,
                    subject,
                    f"torque is {_torque_source(mine)}: every torque of this joint shares a scale error of up to "
                    f"{mine.model.uncertainty_percent:g} %, which no interval contains",
                    "weigh it: hang a known mass on a lever and set `torque_constant_nm_per_a` or `stall_nm`",
                )
            )
            if mode != self._registers.position_mode:
                findings.append(
                    Finding(Severity.ERROR, subject, f"operating mode is {mode}", "set position mode with its tool")
                )
        if not self._registers.watchdog:
            findings.append(
                Finding(
                    Severity.WARNING,
                    "bus",
                    "these servos have no watchdog: if this program dies they hold their last goal under power",
                    "keep the switch of their supply at hand",
                )
            )
        return findings

    # -- configuring --------------------------------------------------------------------------------------------

    def configure(self, cycle_hz: float, active: Sequence[str]) -> None:
        """Nothing is written but, at the start of cycling, the bus watchdog where there is one.

        Raises:
            PlanRefused: the line does not carry the rate.
        """
        self._open_line()
        for name in active:
            self.setup.joint(name)
        most_hz = self._highest_rate_hz()
        if cycle_hz > most_hz:
            raise PlanRefused(
                f"{len(self._joints)} servos at {cycle_hz:g} Hz are more than the line carries: at most {most_hz:g} Hz",
                where="bus load",
                next_step=f"use a rate of at most {most_hz:g} Hz, fewer servos, or a higher baud",
            )
        self._cycle_hz = cycle_hz
        self._reader = Reader(self._joints, 1.0 / cycle_hz)
        self._rows = self._reader.rows()
        self._wishes = [
            Wish(joint, report) for joint, report in zip(self.setup.joints, self._rows.feedback, strict=True)
        ]
        self._powered, self._holding = [False] * len(self._joints), [None] * len(self._joints)

    def set_limits(self, joint: str, *, torque_nm: float, position_min_rad: float, position_max_rad: float) -> None:
        """Kept by the host; a servo's own torque limit stays as its owner set it."""
        self._wish(joint).limit(torque_nm, position_min_rad, position_max_rad)

    def frame_map_values(self) -> Mapping[str, Any]:
        """As ``driver.FrameMapped``."""
        return frame_map_values(self.setup, self._joints, 1.0 / self._cycle_hz)

    # -- cycling ------------------------------------------------------------------------------------------------

    def start_cycling(self) -> None:
        """Run time zero; everybody without power."""
        line, rows = self._open_line(), self._rows
        if rows is None:
            raise HardwareError("start_cycling before configure")
        restart: Callable[[], None] | None = getattr(self.clock, "restart", None)
        if restart is not None:
            restart()
        line.heard = rows.feed
        self._arm_watchdog(self._line_settings.watchdog_s)

    def enable(self, joint: str, mode: Mode) -> None:
        """Ask for power; progress is in the feedback.

        Raises:
            HardwareError: another mode than position.
        """
        if mode is not Mode.POSITION:
            raise HardwareError(
                f"mode {mode.name} refused: a servo follows positions only",
                where=f"joint {joint}",
                next_step="identify it; compensation needs a drive that takes torques",
            )
        self._wish(joint).enable(mode)

    def disable(self, joint: str) -> None:
        """Ask for power off, after standstill."""
        self._wish(joint).disable()

    def lock(self, joint: str) -> None:
        """Hold the present goal."""
        self._wish(joint).lock()

    def unlock(self, joint: str) -> None:
        """Follow the set-point again."""
        self._wish(joint).unlock()

    def exchange(self, set_points: Sequence[SetPoint]) -> Sequence[Feedback]:
        """One cycle: goals, half a cycle, then the reading.

        Raises:
            SafetyAbort: a set-point is not a number; every joint was told to hold.
            HardwareError: the port is gone.
        """
        line, rows = self._open_line(), self._rows
        if rows is None:
            raise HardwareError("exchange before configure")
        begun_ns, period_ns = self.clock.now_ns(), 1e9 / self._cycle_hz
        for _ in line.received(begun_ns):  # late answers
            pass
        refused: SafetyAbort | None = None
        goals: dict[int, bytes] = {}
        power: dict[int, bytes] = {}
        for at, (wish, set_point) in enumerate(zip(self._wishes, set_points, strict=True)):
            try:
                order = wish.order(set_point)
            except SafetyAbort as abort:
                refused, order = abort, wish.order(set_point)
            on = order.do is not Do.REST
            counts = self._counts(at, order.position_rad if order.do is Do.FOLLOW else math.nan)
            mine = self._joints[at]
            if on and counts is not None:
                goals[mine.id] = to_bytes(counts, self._registers.goal_bytes, mine.model)
            if on is not self._powered[at] and (counts is not None or not on):
                power[mine.id], self._powered[at] = bytes([on]), on
        # A goal always comes before power, so that power does not pull.
        for address, told in ((self._registers.goal, goals), (self._registers.torque, power)):
            if told:
                line.send(self._wire.sync_write(address, told))
        self.clock.wait_until(begun_ns + round(period_ns / 2))
        registers = self._registers
        line.send(self._wire.sync_read([mine.id for mine in self._joints], registers.block, registers.block_bytes))
        for _ in line.received(begun_ns + round(0.95 * period_ns)):
            if not rows.waiting():
                break
        if refused is not None:
            raise refused
        return rows.feedback

    def quick_stop(self) -> None:
        """Every joint holds where it was last seen; never raises."""
        line, reader = self._line, self._reader
        if line is None or reader is None:
            return
        goals = {}
        for at, wish in enumerate(self._wishes):
            wish.stop()
            counts = reader.counts[at]
            if self._powered[at] and counts is not None:
                self._holding[at] = counts
                goals[self._joints[at].id] = to_bytes(counts, self._registers.goal_bytes, self._joints[at].model)
        with contextlib.suppress(Exception):
            if goals:
                line.send(self._wire.sync_write(self._registers.goal, goals))

    def stop_cycling(self) -> None:
        """Bring every joint to rest and off.

        Raises:
            SafetyAbort: a joint does not answer any more; it was told to let go all the same.
        """
        if not self._wishes:
            return
        try:
            powered = self._settle()
        finally:
            self._let_go()
            self._wishes, self._rows, self._reader = [], None, None
        if powered:
            raise SafetyAbort(
                f"did not come to rest and off within {_SETTLE_S:g} s",
                where=", ".join(f"joint {name}" for name in powered),
                next_step="switch its supply off, then look at the servo",
            )

    def close(self) -> None:
        """Everything to rest, the port released; safe to call twice and after errors."""
        if self._line is None:
            return
        if self._wishes:
            self.quick_stop()
            with contextlib.suppress(FrictidError):
                self.stop_cycling()
        self._line.close()
        self._line = None

    # -- parts --------------------------------------------------------------------------------------------------

    def _open_line(self) -> Line:
        if self._line is None:
            raise HardwareError("the port is not open", where=self.setup.bus)
        return self._line

    def _wish(self, joint: str) -> Wish:
        name = self.setup.joint(joint).name
        for wish in self._wishes:
            if wish.joint.name == name:
                return wish
        raise HardwareError("not configured yet", where=f"joint {name}")

    def _counts(self, at: int, position_rad: float) -> int | None:
        """The goal; where none is asked for (switching on, braking), where the joint was seen when that began."""
        if math.isfinite(position_rad):
            self._holding[at] = None
            mine = self._joints[at]
            return min(max(mine.counts(position_rad), 0), mine.model.counts_per_turn - 1)
        if self._holding[at] is None and self._reader is not None:
            self._holding[at] = self._reader.counts[at]
        return self._holding[at]

    def _ask(self, mine: JointSettings, address: int, count: int) -> bytes:
        line = self._open_line()
        for _ in range(_TRIES):
            line.send(self._wire.read(mine.id, address, count))
            for packet in line.received(self.clock.now_ns() + round(self._line_settings.answer_s * 1e9)):
                if packet.id == mine.id and len(packet.data) == count:
                    return packet.data
        raise HardwareError(
            f"no answer to reading register {address}",
            where=f"servo {mine.id}",
            cause="no supply, another id or baud, or a cable that is not in",
            next_step="scan the line with the maker's tool",
        )

    def _highest_rate_hz(self) -> float:
        count, registers, wire = len(self._joints), self._registers, self._wire
        ids = [mine.id for mine in self._joints]
        asked = len(wire.sync_read(ids, registers.block, registers.block_bytes))
        answered = count * (wire.answer_overhead + registers.block_bytes)
        delays_s = sum(delay_s for _, _, delay_s in self._told.values())
        return float(int(_BUSIEST / ((asked + answered) * 10.0 / self._line_settings.baud + delays_s)))

    def _velocity_delay_s(self) -> float:
        return SPEED_CYCLES / 2.0 / (self._cycle_hz or self.setup.cycle_hz)

    def _arm_watchdog(self, seconds: float) -> None:
        """0 clears what tripped earlier, and ends it."""
        if not self._registers.watchdog:
            return
        line, ids = self._open_line(), [mine.id for mine in self._joints]
        steps = min(127, round(seconds / _WATCHDOG_STEP_S))
        for value in dict.fromkeys((0, steps)):
            line.send(self._wire.sync_write(self._registers.watchdog, dict.fromkeys(ids, bytes([value]))))

    def _settle(self) -> list[str]:
        for wish in self._wishes:
            wish.disable()
        set_points = [SetPoint() for _ in self._wishes]
        period_ns = round(1e9 / self._cycle_hz)
        powered: list[str] = []
        begun_ns = self.clock.now_ns()
        for k in range(max(2, math.ceil(_SETTLE_S * self._cycle_hz))):
            self.clock.wait_until(begun_ns + k * period_ns)
            reports = self.exchange(set_points)
            powered = [
                joint.name
                for joint, report in zip(self.setup.joints, reports, strict=True)
                if report.age_cycles or report.state is JointState.ENABLED
            ]
            if not powered:
                break
        return powered

    def _let_go(self) -> None:
        """Off, twice: a lost packet must not keep a joint under power."""
        off = self._wire.sync_write(self._registers.torque, {mine.id: b"\0" for mine in self._joints})
        with contextlib.suppress(FrictidError):
            self._open_line().send(off)
            self._open_line().send(off)
            self._arm_watchdog(0.0)
        if self._line is not None:
            self._line.heard = None


def _torque_source(mine: JointSettings) -> str:
    model = mine.model
    if model.current_a:
        return f"present current x {model.torque_constant_nm_per_a:g} N m/A"
    return f"PWM duty x {model.stall_nm:g} N m at stall (holds back-EMF and supply voltage)"
