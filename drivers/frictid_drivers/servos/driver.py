"""The driver for servos on a serial line. They close their own position loop; we give goals and read what they report.

Torque is current (or duty) times a constant of the model, so it bears a scale error that ``check`` states. Goals go out
at the beginning of a cycle and are followed by the reading half a cycle later (``logs`` says why).

Servos that take currents have torque mode. Where a servo takes positions only, a torque that is to be added is given
as a distance: its loop is a spring, whose stiffness must be known, and the goal moves by torque / stiffness.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from typing import Any

from frictid_drivers.servos.inspection import Told, joint_findings, meet, torque_source
from frictid_drivers.servos.line import Line, PortFactory, SerialPort
from frictid_drivers.servos.logs import Reader, frame_map_values, speed_cycles
from frictid_drivers.servos.packets import WIRES
from frictid_drivers.servos.servo import Servo
from frictid_drivers.servos.settings import read_settings
from frictid_hil.errors import ConfigError, FrictidError, HardwareError, PlanRefused, SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import Plan
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.driver import (
    POSITION_GAIN,
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

LEAST_HZ = 200.0
"""Rate below which a healthy joint's curve was called ok and was 3 to 5 % outside its interval (100 Hz)."""
_SETTLE_S = 1.5
_BUSIEST = 0.45  # share of a cycle that the line may take: the reading begins in its middle
_WATCHDOG_STEP_S = 0.02
_OBEYS_S = 0.1
"""A servo that a stop takes out of current mode says so in this time; else we are silent until its watchdog struck."""
_INSIST_S, _AGAIN_S = 0.5, 0.01
"""A servo that is not seen to be off is told so for this long, at such intervals, silent or not."""


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
        self._told: dict[str, Told] = {}
        self._servos: list[Servo] = []
        self._unwatched: list[str] = []
        self._rows: RowDecoder | None = None
        self.may_be_powered: tuple[str, ...] = ()
        self._cycle_hz = 0.0
        self._stopped_ns: int | None = None
        self._silent_until_ns = 0

    # -- reaching them ------------------------------------------------------------------------------------------

    def open(self, frame_sink: FrameSink | None = None) -> None:
        """Take the port and hear from every servo; reads only.

        Raises:
            HardwareBusy: another process holds the port.
            HardwareError: no such port, or a servo does not answer.
        """
        try:
            self._line = Line(self._port_factory(), self._wire, frame_sink, self.clock, self._line_settings.answer_s)
            for joint, mine in zip(self.setup.joints, self._joints, strict=True):
                self._told[joint.name] = meet(self._line, mine)
        except BaseException:
            self.close()
            raise

    def identify(self) -> dict[str, JointIdentity]:
        """What every servo told when it was reached, and what its numbers are worth."""
        self._open_line()
        period_s = 1.0 / (self._cycle_hz or self.setup.cycle_hz)
        delay_s = speed_cycles(period_s) * period_s / 2.0
        timing = Timing(uncertainty_s=0.002, velocity_delay_s=delay_s, torque_beats=True)
        return {
            joint.name: JointIdentity(
                joint=joint.name,
                product=f"{mine.name} (model number {self._told[joint.name].model})",
                rated_torque_nm=joint.rated_torque_nm,
                gear_ratio=joint.gear_ratio,
                position_resolution_rad=mine.model.count_rad,
                torque_resolution_nm=mine.torque_nm_per_unit,
                torque_source=torque_source(mine),
                timing=timing,
                settings={
                    "torque_uncertainty_percent": mine.model.uncertainty_percent,
                    **({} if self._told[joint.name].i_gain else {POSITION_GAIN: self._told[joint.name].p_gain}),
                },
            )
            for joint, mine in zip(self.setup.joints, self._joints, strict=True)
        }

    def capabilities(self) -> Capabilities:
        """Torque mode where all servos take currents and have a bus watchdog, or a person allows it without."""
        self._open_line()
        torque = all(mine.model.registers.goal_current for mine in self._joints) and (
            not self._unwatched or self._line_settings.allow_torque_without_watchdog
        )
        return Capabilities(
            max_cycle_hz=self._highest_rate_hz(),
            modes=frozenset({Mode.POSITION} | ({Mode.TORQUE} if torque else set())),
            torque_offset=True,
            drive_watchdog=bool(self._registers.watchdog),
            lock_step=self.clock.lock_step,
            temperature=self._registers.temperature >= 0,
        )

    def check(self, plan: Plan | None) -> list[Finding]:
        """Everything that can be said without moving or writing."""
        self._open_line()
        cycle_hz, most_hz = (plan or self.setup).cycle_hz, self._highest_rate_hz()
        fits = cycle_hz <= most_hz
        load = (
            f"{len(self._joints)} servos at {self._line_settings.baud} bit/s: at most {most_hz:g} Hz, "
            f"{cycle_hz:g} Hz asked"
        )
        slower = "" if fits else f"use a rate of at most {most_hz:g} Hz (`--rate`, or `cycle_hz` in the robot file)"
        findings = [Finding(Severity.OK if fits else Severity.ERROR, "bus load", load, slower)]
        if cycle_hz < LEAST_HZ:
            rare = (
                f"{cycle_hz:g} Hz: so rarely read, the current of a servo that follows goal by goal is not its mean, "
                "and a healthy joint's curve may be 5 % outside its interval"
            )
            faster = f"use {LEAST_HZ:g} Hz or more (`--rate`, or `cycle_hz` in the robot file), and a baud for it"
            findings.append(Finding(Severity.ERROR, "rate", rare, faster))
        for joint, mine in zip(self.setup.joints, self._joints, strict=True):
            findings += joint_findings(joint, mine, self._told[joint.name], plan)
        if not self._registers.watchdog:
            alone = "no watchdog: if this program dies these servos go to their last goal and hold it under power"
            findings.append(Finding(Severity.WARNING, "bus", alone, "keep the switch of their supply at hand"))
        return findings

    # -- configuring --------------------------------------------------------------------------------------------

    def configure(self, cycle_hz: float, active: Sequence[str]) -> None:
        """Servos that take currents are in position mode after it, and have shown that they keep a bus watchdog.

        Raises:
            PlanRefused: the line does not carry the rate.
            HardwareError: a servo does not answer, or does not take position mode.
        """
        line = self._open_line()
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
        reader = Reader(self._joints, 1.0 / cycle_hz)
        self._rows = reader.rows()
        self._servos = [
            Servo(joint, figures, self._told[joint.name].current_limit)
            for joint, figures in zip(self.setup.joints, reader.joints, strict=True)
        ]
        self._unwatched.clear()
        for servo in self._servos:
            if not servo.mine.model.registers.goal_current:
                continue
            operating = servo.read_mode(line)
            if self._told[servo.joint.name].mode != self._registers.position_mode:
                operating.take_positions(None, powered=True)
            if not line.put(servo.mine.id, self._registers.watchdog, self._watchdog(self._line_settings.watchdog_s)):
                self._unwatched.append(servo.joint.name)

    def set_limits(self, joint: str, *, torque_nm: float, position_min_rad: float, position_max_rad: float) -> None:
        """Kept by the host; a servo's own torque limit stays as its owner set it."""
        servo = self._servo(joint)
        servo.wish.limit(torque_nm, position_min_rad, position_max_rad)
        servo.ends_rad = (position_min_rad, position_max_rad)

    def frame_map_values(self) -> Mapping[str, Any]:
        """As ``driver.FrameMapped``."""
        return frame_map_values(self.setup, self._joints, 1.0 / self._cycle_hz)

    # -- cycling ------------------------------------------------------------------------------------------------

    def start_cycling(self) -> None:
        """Run time zero; everybody without power."""
        line, rows = self._open_line(), self._rows
        if rows is None:
            raise HardwareError("start_cycling before configure")
        getattr(self.clock, "restart", lambda: None)()
        line.heard = rows.feed
        self._stopped_ns, self._silent_until_ns = None, 0
        self._arm_watchdog(self._line_settings.watchdog_s, self._servos)

    def enable(self, joint: str, mode: Mode) -> None:
        """Ask for power; progress is in the feedback. A change of mode under power begins with the torque of now.

        Raises:
            HardwareError: a mode that there is not, or the servo does not take it.
        """
        if mode not in self.capabilities().modes:
            raise HardwareError(
                f"mode {mode.name} refused",
                where=f"joint {joint}",
                cause=self._why_not(mode),
                next_step="identify it, and let it track: `compensate --task track --drive-mode position`",
            )
        servo = self._servo(joint)
        self._stopped_ns = None
        servo.wish.enable(mode)
        servo.take_mode(mode)

    def disable(self, joint: str) -> None:
        """Ask for power off, after standstill."""
        self._servo(joint).wish.disable()

    def lock(self, joint: str) -> None:
        """Hold the present goal."""
        servo = self._servo(joint)
        servo.wish.lock()
        servo.take_mode(Mode.POSITION)

    def unlock(self, joint: str) -> None:
        """Follow the set-point again."""
        self._servo(joint).wish.unlock()

    def exchange(self, set_points: Sequence[SetPoint]) -> Sequence[Feedback]:
        """One cycle: goals, half a cycle, then the reading.

        Raises:
            SafetyAbort: a set-point is not a number; every joint was told to hold.
            HardwareError: the port is gone, or a stop is not followed.
        """
        line, rows = self._open_line(), self._rows
        if rows is None:
            raise HardwareError("exchange before configure")
        begun_ns, period_ns = self.clock.now_ns(), 1e9 / self._cycle_hz
        if begun_ns < self._silent_until_ns:
            raise _not_followed(self._servos)
        for _ in line.received(begun_ns):  # late answers
            pass
        registers = self._registers
        # A goal always comes before power, so that power does not pull.
        told: dict[int, dict[int, bytes]] = {registers.goal: {}, registers.goal_current: {}, registers.torque: {}}
        noted = [servo.note(set_point, told) for servo, set_point in zip(self._servos, set_points, strict=True)]
        refused = [abort for abort in noted if abort is not None]
        for address, each in told.items():
            if each:
                line.tell(address, each)
        if self._stopped_ns is not None:
            self._see_stopped(begun_ns + round(period_ns / 2))
        self.clock.wait_until(begun_ns + round(period_ns / 2))
        line.send(self._wire.sync_read([mine.id for mine in self._joints], registers.block, registers.block_bytes))
        for _ in line.received(begun_ns + round(0.95 * period_ns)):
            if not rows.waiting():
                break
        for servo in self._servos:
            servo.see()
        if refused:
            raise refused[-1]
        return rows.feedback

    def quick_stop(self) -> None:
        """Every joint holds the goal that it has, or where it was last seen; never raises."""
        if self._line is None or self.clock.now_ns() < self._silent_until_ns:
            return
        if self._stopped_ns is None:
            self._stopped_ns = self.clock.now_ns()
        goals = {servo.mine.id: goal for servo in self._servos if (goal := servo.stop()) is not None}
        with contextlib.suppress(Exception):
            if goals:
                self._line.tell(self._registers.goal, goals)

    def stop_cycling(self) -> None:
        """Bring every joint to rest and off.

        Raises:
            SafetyAbort: a joint was not seen to be off; it was told to let go all the same.
        """
        if not self._servos:
            return
        self.clock.wait_until(self._silent_until_ns)
        try:
            self._settle()
        finally:
            self._let_go()
            self._servos, self._rows = [], None
        if self.may_be_powered:
            raise SafetyAbort(
                "did not say that it has no power any more",
                where=", ".join(f"joint {name}" for name in self.may_be_powered),
                next_step="switch its supply off, then look at the servo",
            )

    def close(self) -> None:
        """Everything to rest, the port released; safe to call twice and after errors."""
        if self._line is None:
            return
        if self._servos:
            self.quick_stop()
            with contextlib.suppress(FrictidError):
                self.stop_cycling()
        self._line.close()
        self._line = None

    # -- parts --------------------------------------------------------------------------------------------------

    def _why_not(self, mode: Mode) -> str:
        if mode is not Mode.TORQUE or not self._registers.goal_current:
            return "these servos follow positions, and no others than Dynamixel with a goal current take torque"
        return (
            f"the bus watchdog of joint {', '.join(self._unwatched)} does not keep what is written (XM430: firmware "
            "38 has it); without it the servo would keep the last current if this program died"
            if self._unwatched
            else "not every servo of this line takes a current"
        )

    def _open_line(self) -> Line:
        if self._line is None:
            raise HardwareError("the port is not open", where=self.setup.bus)
        return self._line

    def _servo(self, joint: str) -> Servo:
        name = self.setup.joint(joint).name
        for servo in self._servos:
            if servo.joint.name == name:
                return servo
        raise HardwareError("not configured yet", where=f"joint {name}")

    def _highest_rate_hz(self) -> float:
        count, registers, wire = len(self._joints), self._registers, self._wire
        ids = [mine.id for mine in self._joints]
        asked = len(wire.sync_read(ids, registers.block, registers.block_bytes))
        answered = count * (wire.answer_overhead + registers.block_bytes)
        delays_s = sum(told.delay_s for told in self._told.values())
        return float(int(_BUSIEST / ((asked + answered) * 10.0 / self._line_settings.baud + delays_s)))

    def _watchdog(self, seconds: float) -> bytes:
        return bytes([min(127, round(seconds / _WATCHDOG_STEP_S))])

    def _arm_watchdog(self, seconds: float, servos: Sequence[Servo]) -> None:
        """0 clears what tripped earlier, and ends it."""
        if self._registers.watchdog and servos:
            for value in dict.fromkeys((b"\0", self._watchdog(seconds))):
                self._open_line().tell(self._registers.watchdog, {servo.mine.id: value for servo in servos})

    def _see_stopped(self, until_ns: int) -> None:
        """Servos that followed currents must say that they hold a position now; who does not is told again.

        Every packet feeds their bus watchdogs, a question, too. So in the end nothing is sent until these have struck.
        """
        waiting = [servo for servo in self._servos if servo.may_follow_currents]
        if not waiting:
            return
        line, now_ns = self._open_line(), self.clock.now_ns()
        if not self._unwatched and now_ns > (self._stopped_ns or 0) + round(_OBEYS_S * 1e9):
            silence_s = self._line_settings.watchdog_s + 2 * _WATCHDOG_STEP_S
            self._stopped_ns, self._silent_until_ns = None, now_ns + round(silence_s * 1e9)
            raise _not_followed(waiting)
        line.send(self._wire.sync_read([servo.mine.id for servo in waiting], self._registers.mode, 1))
        for packet in line.received(until_ns):
            for servo in waiting:
                if servo.operating is not None:
                    servo.operating.answered(packet)
            if not any(servo.may_follow_currents for servo in waiting):
                return
        for servo in waiting:
            if servo.may_follow_currents:
                servo.leave_currents()

    def _settle(self) -> None:
        """Cycle until every joint stands and was told to let go."""
        for servo in self._servos:
            servo.wish.disable()
        set_points = [SetPoint() for _ in self._servos]
        period_ns = round(1e9 / self._cycle_hz)
        begun_ns = self.clock.now_ns()
        for k in range(max(2, math.ceil(_SETTLE_S * self._cycle_hz))):
            self.clock.wait_until(begun_ns + k * period_ns)
            reports = self.exchange(set_points)
            if not any(report.age_cycles or report.state is JointState.ENABLED for report in reports):
                break

    def _let_go(self) -> None:
        """Off, and read back: servos do not tell their power in the cycle. They are left in position mode.

        Who is not seen to be off keeps its bus watchdog.
        """
        line = self._open_line()
        waiting, until_ns = list(self._servos), self.clock.now_ns() + round(_INSIST_S * 1e9)
        while True:
            with contextlib.suppress(FrictidError):
                line.tell(self._registers.torque, {servo.mine.id: b"\0" for servo in waiting})
            waiting = [servo for servo in waiting if not self._seen_off(servo)]
            if not waiting or self.clock.now_ns() >= until_ns:
                break
            self.clock.wait_until(self.clock.now_ns() + round(_AGAIN_S * 1e9))
        off = [servo for servo in self._servos if servo not in waiting]
        self.may_be_powered = tuple(servo.joint.name for servo in waiting if servo.energised)
        with contextlib.suppress(FrictidError):
            self._arm_watchdog(0.0, off)
            for servo in off:
                if servo.operating is not None and servo.figures.takes_currents:
                    servo.operating.take_positions(None, powered=False)
                elif servo.operating is not None:
                    servo.operating.follow_goals()
        line.heard = None

    def _seen_off(self, servo: Servo) -> bool:
        """Told to let go, and read back."""
        with contextlib.suppress(FrictidError):
            return self._open_line().put(servo.mine.id, self._registers.torque, b"\0")
        return False


def _not_followed(servos: Sequence[Servo]) -> HardwareError:
    return HardwareError(
        "a stop is not followed; nothing is sent until the bus watchdog has taken the power",
        where=", ".join(f"servo {servo.mine.id}" for servo in servos if servo.may_follow_currents),
        cause="it does not hear what is written, or does not answer",
        next_step="keep away from the joint; switch its supply off",
    )
