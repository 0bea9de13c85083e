"""The driver for MIT-mode actuators: one CAN bus, one frame out and one back per joint and cycle. Its life cycle."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from frictid_drivers.mit import adapters
from frictid_drivers.mit.actuator import Actuator, Reader
from frictid_drivers.mit.families import WATCHDOG_PER_S, Damiao, Frame, Parameter, RobStride
from frictid_drivers.mit.frames import FULL, TWELVE, Motion, step
from frictid_drivers.mit.logs import frame_map_values, row_decoder
from frictid_drivers.mit.models import MODELS
from frictid_drivers.mit.settings import JointSettings, read_settings
from frictid_hil.errors import FrictidError, HardwareError, PlanRefused
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import Plan
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.can_bus import BusFactory
from frictid_hil.protocol.can_cycle import CanCycle
from frictid_hil.protocol.can_line import CanLine
from frictid_hil.protocol.can_load import BUSIEST, highest_rate_hz
from frictid_hil.protocol.driver import (
    FD_FRAME,
    Capabilities,
    Clock,
    DriverKind,
    Feedback,
    Finding,
    FrameSink,
    JointIdentity,
    SetPoint,
    Severity,
    Timing,
    WallClock,
)
from frictid_hil.units import format_angle

_ANSWER_S = 0.05
_TRIES = 3
_USABLE = 0.9
"""Share of the position range that is used: beyond its end a motor's numbers start again from the other side."""


class MitDriver:
    """A robot of MIT-mode actuators on one CAN bus; ``InvalidFields`` where an option of the robot file is wrong.

    ``bus_factory`` opens the bus instead of python-can (a simulated one).
    """

    kind = DriverKind(
        line="can",
        addressed_by="id",
        addresses=(1, 0x7F),
        elsewhere={"virtual": "virtual-mit"},
        care={"still_rad_s": 0.05},  # a 12-bit velocity cannot say zero
    )

    def __init__(self, setup: RobotSetup, *, bus_factory: BusFactory | None = None, clock: Clock | None = None) -> None:
        self.setup = setup
        self.clock: Clock = WallClock() if clock is None else clock
        self._bus_settings, self._settings = read_settings(setup)
        self._bus_factory = bus_factory
        self._line: CanLine | None = None
        self._figures: dict[str, dict[str, float]] = {}
        self._restore: list[tuple[str, Parameter, float]] = []
        self._actuators: list[Actuator] = []
        self._cycle: CanCycle | None = None
        self.may_be_powered: tuple[str, ...] = ()

    def open(self, frame_sink: FrameSink | None = None) -> None:
        """Take the bus and hear from every motor. Families that answer nothing else are told `off`."""
        try:
            self._line = CanLine(self.setup.bus, self.setup.options, frame_sink, self.clock, self._bus_factory)
            for joint in self.setup.joints:
                self._meet(joint)
        except BaseException:
            self.close()
            raise

    def identify(self) -> dict[str, JointIdentity]:
        """What every motor told of itself when it was reached, and what its numbers are worth."""
        self._open_line()
        return {joint.name: self._identity(joint) for joint in self.setup.joints}

    def capabilities(self) -> Capabilities:
        """Torque mode needs the motors' own watchdog, confirmed by ``configure``, or an explicit permission."""
        self._open_line()
        watchdog = all(settings.family.watchdog is not None for settings in self._settings.values())
        torque = watchdog or self._bus_settings.allow_torque_without_watchdog
        return Capabilities(
            max_cycle_hz=self._highest_rate_hz(),
            modes=frozenset({Mode.POSITION, Mode.VELOCITY} | ({Mode.TORQUE} if torque else set())),
            torque_offset=True,
            drive_watchdog=watchdog,
            lock_step=self.clock.lock_step,
            temperature=True,
            droop_rad={joint.name: self._droop_rad(joint) for joint in self.setup.joints},
        )

    def check(self, plan: Plan | None) -> list[Finding]:
        """Everything that can be said without moving or writing."""
        self._open_line()
        cycle_hz, most_hz = (plan or self.setup).cycle_hz, self._highest_rate_hz()
        fits = cycle_hz <= most_hz
        load = (
            f"{len(self.setup.joints)} motors, one frame out and one back each: at most {most_hz:g} Hz within "
            f"{BUSIEST:.0%} of {self._bus_settings.rates}, {cycle_hz:g} Hz asked"
        )
        slower = "" if fits else f"use a rate of at most {most_hz:g} Hz (`--rate`, or `cycle_hz`)"
        findings = [Finding(Severity.OK if fits else Severity.ERROR, "bus load", load, slower)]
        for joint in self.setup.joints:
            subject = f"joint {joint.name}"
            findings += [Finding(severity, subject, *said) for severity, *said in self._joint_findings(joint)]
        return findings

    def configure(self, cycle_hz: float, active: Sequence[str]) -> None:
        """Mode and watchdog written and read back; every joint reports in every cycle, active or not.

        ``PlanRefused``, with the highest rate, where there are more frames than the bus carries.
        """
        line = self._open_line()
        for name in active:
            self.setup.joint(name)
        most_hz = self._highest_rate_hz()
        if cycle_hz > most_hz:
            raise PlanRefused(
                f"{len(self.setup.joints)} motors at {cycle_hz:g} Hz overload the bus: at most {most_hz:g} Hz",
                where="bus load",
                cause=f"one frame out and one back per motor and cycle, within {BUSIEST:.0%} of the bus",
                next_step=f"use a rate of at most {most_hz:g} Hz (`calibrate --rate`, or `cycle_hz` in the robot file)",
            )
        for joint in self.setup.joints:
            family = self._settings[joint.name].family
            for what, (parameter, value) in family.settings.items():
                self._set(joint, parameter, value, what)
            if family.watchdog is not None:
                value = round(max(self._bus_settings.watchdog_s, 3.0 / cycle_hz) * WATCHDOG_PER_S)
                self._set(joint, family.watchdog, value, "watchdog")
        joints = [(joint, self._settings[joint.name]) for joint in self.setup.joints]
        readers = [Reader(at, joint.direction, settings) for at, (joint, settings) in enumerate(joints)]
        self._actuators = [
            Actuator(*joint, reader, 1.0 / cycle_hz) for joint, reader in zip(joints, readers, strict=True)
        ]
        self._cycle = CanCycle(
            line,
            self.clock,
            row_decoder(readers),
            [actuator.wish for actuator in self._actuators],
            lambda at, order: self._actuators[at].frame(order),
            cycle_hz,
            self._bus_settings.reply_window,
        )

    def set_limits(self, joint: str, *, torque_nm: float, position_min_rad: float, position_max_rad: float) -> None:
        """Kept by the host in every frame; ``HardwareError`` where a limit is beyond what the motor's numbers say."""
        settings, end_rad = self._settings[joint], self._usable_rad(joint)
        if max(abs(position_min_rad), abs(position_max_rad)) > end_rad:
            raise HardwareError(
                f"limits {position_min_rad:g}..{position_max_rad:g} rad reach beyond {end_rad:.3g} rad, "
                f"{_USABLE:.0%} of the range that its frames can say",
                where=f"joint {joint}",
                next_step="narrow the limits in the robot file, or set the motor's zero nearer to the middle",
            )
        self._actuator(joint).limit(min(torque_nm, settings.motor.ranges.torque_nm), position_min_rad, position_max_rad)

    def frame_map_values(self) -> Mapping[str, Any]:
        """As ``driver.FrameMapped``: with the ranges that are in force."""
        return frame_map_values(self.setup, self._settings)

    def start_cycling(self) -> None:
        """Run time zero."""
        line = self._open_line()
        self._cycling()
        for _ in line.received():
            pass
        getattr(self.clock, "restart", lambda: None)()

    def enable(self, joint: str, mode: Mode) -> None:
        """Ask for power; ``HardwareError`` for torque mode without a watchdog, or a mode that there is not."""
        if mode not in self.capabilities().modes:
            raise HardwareError(
                f"mode {mode.name} refused",
                where=f"joint {joint}",
                cause="without a watchdog of its own the motor would keep the last torque if this program died"
                if mode is Mode.TORQUE
                else "these motors know position, velocity and torque",
                next_step="use position mode; or set `allow_torque_without_watchdog: true` in options and keep the "
                "emergency stop in your hand",
            )
        self._actuator(joint).enable(mode)

    def disable(self, joint: str) -> None:
        """Ask for power off; a joint that moves is braked first."""
        self._cycling().wish(joint).disable()

    def lock(self, joint: str) -> None:
        """Hold the present target."""
        self._cycling().wish(joint).lock()

    def unlock(self, joint: str) -> None:
        """Follow the set-point again."""
        self._cycling().wish(joint).unlock()

    def exchange(self, set_points: Sequence[SetPoint]) -> Sequence[Feedback]:
        """One cycle; see ``CanCycle.exchange``."""
        return self._cycling().exchange(set_points)

    def quick_stop(self) -> None:
        """Damping alone for every joint under power, off for the others; never raises."""
        if self._cycle is not None:
            self._cycle.quick_stop()

    def stop_cycling(self) -> None:
        """Bring every joint to rest and off; see ``CanCycle.stop``."""
        cycle, self._cycle = self._cycle, None
        if cycle is not None:
            try:
                cycle.stop()
            finally:
                self.may_be_powered = cycle.may_be_powered

    def close(self) -> None:
        """Everything to rest, settings as they were, the bus released; safe to call twice and after errors.

        A motor that was not seen to be off keeps its watchdog: somebody else may have switched it on again.
        """
        if self._line is None:
            return
        if self._cycle is not None:
            self.quick_stop()
            with contextlib.suppress(FrictidError):
                self.stop_cycling()
        for name, parameter, value in reversed(self._restore):
            settings = self._settings[name]
            if name in self.may_be_powered and parameter == settings.family.watchdog:
                continue
            with contextlib.suppress(FrictidError):
                self._line.send(*settings.family.parameter(settings.motor, parameter, value))
        self._restore.clear()
        self._line.close()
        self._line = None

    def _open_line(self) -> CanLine:
        if self._line is None:
            raise HardwareError("the bus is not open", where=self.setup.bus)
        return self._line

    def _cycling(self) -> CanCycle:
        if self._cycle is None:
            raise HardwareError("not configured yet", where=self.setup.bus)
        return self._cycle

    def _actuator(self, joint: str) -> Actuator:
        return self._actuators[self._cycling().wishes.index(self._cycling().wish(joint))]

    def _meet(self, joint: JointSetup) -> None:
        """Read what the motor can tell; where it tells its ranges, they are taken."""
        settings = self._settings[joint.name]
        figures = {name: self._ask(joint, parameter) for name, parameter in settings.family.figures.items()}
        told = [figures.get(f"{what} range", math.nan) for what in ("position", "velocity", "torque")]
        if all(math.isfinite(value) and value > 0 for value in told):
            ranges = replace(settings.motor.ranges, position_rad=told[0], velocity_rad_s=told[1], torque_nm=told[2])
            settings = replace(settings, motor=replace(settings.motor, ranges=ranges))
            self._settings[joint.name] = settings
        elif any("range" in name for name in figures):
            raise HardwareError(f"its ranges read {told}", where=_where(joint), cause="not a motor of this family")
        position_rad = self._answer(
            joint, settings.family.poll(settings.motor), partial(_position, settings), "a report"
        )
        self._figures[joint.name] = {**figures, "reported position": position_rad}

    def _ask(self, joint: JointSetup, parameter: Parameter) -> float:
        family, motor = self._settings[joint.name].family, self._settings[joint.name].motor
        asked, match = family.parameter(motor, parameter), partial(family.told, motor, parameter)
        return self._answer(joint, asked, match, f"parameter {parameter.index:#x}")

    def _set(self, joint: JointSetup, parameter: Parameter, value: float, what: str) -> None:
        """Write where it differs, read back, and remember what to restore."""
        settings = self._settings[joint.name]
        before = self._ask(joint, parameter)
        if before == value:
            return
        self._open_line().send(*settings.family.parameter(settings.motor, parameter, value))
        after = self._ask(joint, parameter)
        if after != value:
            raise HardwareError(
                f"{what} (parameter {parameter.index:#x}) reads {after:g} after {value:g} was written",
                where=_where(joint),
                cause="a firmware that does not have it, or a wrong `protocol`",
                next_step="set it with the maker's tool, or compare the firmware's manual",
            )
        self._restore.append((joint.name, parameter, before))

    def _answer(self, joint: JointSetup, frame: Frame, match: Callable[[int, bytes], float | None], what: str) -> float:
        line, other_kind = self._open_line(), False
        for _ in range(_TRIES):
            line.send(*frame)
            for _, can_id, data in line.received(self.clock.now_ns() + round(_ANSWER_S * 1e9)):
                value = match(can_id, data)
                if value is not None:
                    return value
                other_kind = other_kind or match(can_id ^ FD_FRAME, data) is not None
        if other_kind:
            kinds = ("CAN FD", "classical") if self._bus_settings.rates.data is None else ("classical", "CAN FD")
            raise HardwareError(
                f"answers in {kinds[0]} frames, the robot file has {kinds[1]} ones",
                where=_where(joint),
                cause="its register 35 says another bit rate",
                next_step="set `fd` and `data_bitrate` in options, or the motor's rate with the maker's tool",
            )
        raise HardwareError(
            f"does not answer: {what} not seen",
            where=_where(joint),
            cause="no supply, a wrong id or reply id, another bit rate, CAN FD on one side alone, or a motor that "
            "speaks another protocol",
            next_step="compare id and protocol with the maker's tool; check supply and termination",
        )

    def _identity(self, joint: JointSetup) -> JointIdentity:
        settings, figures = self._settings[joint.name], self._figures[joint.name]
        ranges, sixteen = settings.motor.ranges, isinstance(settings.family, RobStride)
        serial, firmware = (f"{int(figures[name])}" if name in figures else "" for name in ("serial", "firmware"))
        return JointIdentity(
            joint=joint.name,
            serial=serial,
            firmware=firmware,
            product=f"{settings.model} ({settings.family.name})",
            rated_torque_nm=joint.rated_torque_nm,
            gear_ratio=joint.gear_ratio,
            position_resolution_rad=step(ranges.position_rad, FULL),
            torque_resolution_nm=step(ranges.torque_nm, FULL if sixteen else TWELVE),
            torque_source="the motor's own estimate, current times its torque constant",
            timing=Timing(
                torque_delay_s=settings.torque_delay_s,
                uncertainty_s=0.0005,
                source="robot file" if "torque_delay_s" in joint.options else "assumed",
            ),
            settings={
                "kp": settings.kp,
                "kd": settings.kd,
                "velocity_range_rad_s": ranges.velocity_rad_s,
                "torque_range_nm": ranges.torque_nm,
            },
        )

    def _joint_findings(self, joint: JointSetup) -> Iterator[tuple[Severity, str] | tuple[Severity, str, str]]:
        """How bad, what, and what to do about it."""
        settings, figures = self._settings[joint.name], self._figures[joint.name]
        ranges, table = settings.motor.ranges, MODELS[settings.model].ranges
        yield Severity.OK, f"{settings.model} answers ({settings.family.name})"
        droop = format_angle(self._droop_rad(joint))
        yield (
            Severity.OK,
            f"its spring (kp {settings.kp:g}) leaves up to {droop} at rated torque; bounds of care count that",
        )
        end_rad = self._usable_rad(joint.name)
        if max(abs(joint.position_min_rad), abs(joint.position_max_rad)) > end_rad:
            yield Severity.ERROR, f"its limits reach beyond {end_rad:.3g} rad, {_USABLE:.0%} of what its frames can say"
        if joint.max_torque_nm > ranges.torque_nm:
            yield (
                Severity.ERROR,
                f"its frames end at {ranges.torque_nm:g} N m, max_torque_nm is {joint.max_torque_nm:g}",
            )
        exact = figures.get("position")
        if exact is not None and abs(exact - figures["reported position"]) > 0.002 + 0.004 * abs(exact):
            yield (
                Severity.ERROR,
                f"frames of a {settings.model} would say {figures['reported position']:.4f} rad, "
                f"its own parameter says {exact:.4f} rad",
                "correct `model`: ranges that do not fit make every torque wrong",
            )
        if (ranges.velocity_rad_s, ranges.torque_nm) != (table.velocity_rad_s, table.torque_nm):
            yield (
                Severity.WARNING,
                f"it says {ranges.velocity_rad_s:g} rad/s and {ranges.torque_nm:g} N m where a {settings.model} "
                f"usually has {table.velocity_rad_s:g} and {table.torque_nm:g}; its own figures are used",
            )
        code, wanted = figures.get("bit rate", math.nan), self._bus_settings.rates.data
        if code in range(len(Damiao.RATES)) and (rate := Damiao.RATES[int(code)]) != (wanted or 1_000_000):
            yield (
                Severity.ERROR if wanted or rate > 1_000_000 else Severity.WARNING,
                f"its register 35 says {rate / 1e6:g} Mbit/s, the robot file {(wanted or 1_000_000) / 1e6:g} Mbit/s",
                "set the motor's rate with the maker's tool, or `fd` and `data_bitrate` in options",
            )
        if settings.family.watchdog is None:
            yield (
                Severity.WARNING,
                "this family has no watchdog that is known: if this program or its computer dies, the motor keeps what "
                "it was told last",
                "keep the emergency stop in your hand",
            )

    def _droop_rad(self, joint: JointSetup) -> float:
        return joint.rated_torque_nm / self._settings[joint.name].kp

    def _usable_rad(self, joint: str) -> float:
        return _USABLE * self._settings[joint].motor.ranges.position_rad

    def _highest_rate_hz(self) -> float:
        cycle = []
        for settings in self._settings.values():
            can_id, data = settings.family.command(settings.motor, Motion())
            cycle += [(can_id, len(data)), (can_id, 8)]
        most_hz = highest_rate_hz(cycle, self._bus_settings.rates)
        interface, baud = self.setup.bus.partition(":")[0], self._bus_settings.tty_baudrate
        letters = 0.0
        if interface == "slcan" and baud:
            # A real UART: a letter, identifier, length and data in hex, carriage return; 10 bits each.
            letters = sum(27 if can_id >> 31 else 22 for can_id, _ in cycle) / 2
        elif interface in adapters.LINE_BYTES:
            letters, baud = adapters.LINE_BYTES[interface] * len(cycle) / 2, baud or adapters.BAUD
        if letters:
            most_hz = min(most_hz, float(int(baud / 10.0 / letters)))
        return most_hz


def _where(joint: JointSetup) -> str:
    return f"joint {joint.name} (id {joint.address})"


def _position(settings: JointSettings, can_id: int, data: bytes) -> float | None:
    answer = settings.family.answered(settings.motor, can_id, data)
    return None if answer is None else answer.position_rad
