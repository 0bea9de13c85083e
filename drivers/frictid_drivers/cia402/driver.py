"""The CiA-402 driver: one CAN bus, one drive per joint. This file is the life cycle; its neighbours do each step."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import can

from frictid_drivers.cia402 import configure, inspection, reentry
from frictid_drivers.cia402 import objects as od
from frictid_drivers.cia402.axis import Axis
from frictid_drivers.cia402.codec import Decoder
from frictid_drivers.cia402.cycle import Cycle
from frictid_drivers.cia402.fleet import NMT_PRE_OPERATIONAL, NMT_START, Fleet
from frictid_drivers.cia402.frame_map import FrameMap
from frictid_drivers.cia402.layout import Layout
from frictid_drivers.cia402.network import HeartbeatTimer
from frictid_drivers.cia402.settings import read_settings
from frictid_drivers.cia402.state import DriveState, drive_state
from frictid_hil.errors import FrictidError, HardwareError, SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import Plan
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.can_bus import BUS_ERRORS, BusFactory, BusLock, open_bus
from frictid_hil.protocol.driver import (
    Capabilities,
    Clock,
    DriverKind,
    Feedback,
    Finding,
    FrameSink,
    JointIdentity,
    SetPoint,
    Severity,
    WallClock,
)

_SETTLE_S = 2.0
_RESET_S = 0.5
_MODES = (Mode.POSITION, Mode.VELOCITY, Mode.TORQUE)
_WIRE_ERRORS = (FrictidError, *BUS_ERRORS)
_LAST_LOOK_S = 0.1  # an answer to the question whether a drive still has power may take this long

_OFF = (DriveState.SWITCH_ON_DISABLED, DriveState.NOT_READY, DriveState.FAULT, DriveState.UNKNOWN)
"""States without motor power from which nothing more can be asked; UNKNOWN: never reported, never enabled."""


class Cia402Driver:
    """A robot of CiA-402 drives on one CAN bus; ``InvalidFields`` for a wrong option or node id of the robot file.

    ``bus_factory`` opens the bus instead of python-can (a simulated one); it is then not locked. A lock-step clock
    promises that answers are there when ``send`` returns, and that time passes only in its ``wait_until``.
    """

    kind = DriverKind(addressed_by="node", addresses=(1, 127), elsewhere={"virtual": "virtual", "serial": "motoman"})

    def __init__(self, setup: RobotSetup, *, bus_factory: BusFactory | None = None, clock: Clock | None = None) -> None:
        self.setup = setup
        self.clock: Clock = clock if clock is not None else WallClock()
        self._settings, self._joint_settings = read_settings(setup)
        self._bus_factory = bus_factory
        self._torque_limits_nm = {joint.name: joint.max_torque_nm for joint in setup.joints}
        self._sink: FrameSink | None = None
        self._lock: BusLock | None = None
        self._bus: can.BusABC | None = None
        self._fleet: Fleet | None = None
        self._heartbeat: HeartbeatTimer | None = None
        self._layout: Layout | None = None
        self._frame_map: FrameMap | None = None
        self._decoder: Decoder | None = None
        self._axes: dict[str, Axis] = {}
        self._cycle: Cycle | None = None
        self.may_be_powered: tuple[str, ...] = ()

    def open(self, frame_sink: FrameSink | None = None) -> None:
        """Take the bus exclusively and hear from every drive; reads only."""
        self._sink = frame_sink
        try:
            if self._bus_factory is None:
                self._lock = BusLock(self.setup.bus)
                self._lock.acquire()
                self._bus = open_bus(self.setup.bus, self.setup.options)
            else:
                self._bus = self._bus_factory()
            self._fleet = Fleet(self.setup, self._settings, self._joint_settings, self._bus, frame_sink)
        except BaseException:
            self.close()
            raise

    def identify(self) -> dict[str, JointIdentity]:
        """What every drive says of itself, with known manufacturer settings; reads only."""
        fleet = self._reached()
        cycle_hz = self._layout.cycle_hz if self._layout else self.setup.cycle_hz
        return {
            joint.name: inspection.identity(
                joint, fleet.drives[joint.name], fleet.facts[joint.name], self._joint_settings[joint.name], cycle_hz
            )
            for joint in self.setup.joints
        }

    def capabilities(self) -> Capabilities:
        """What drives and bus can do: with the configured joints active; before, with any one of them."""
        fleet = self._reached()
        facts = fleet.facts.values()
        stretches = [self._layout.active] if self._layout else self._alone()
        may_torque = fleet.watchdog or self._settings.allow_torque_without_watchdog
        possible = _MODES if may_torque else _MODES[:2]
        return Capabilities(
            max_cycle_hz=min(map(fleet.highest_rate_hz, stretches)),
            modes=frozenset(mode for mode in possible if all(fact.supports(mode) for fact in facts)),
            torque_offset=all(fact.torque_offset for fact in facts),
            drive_watchdog=fleet.watchdog,
            lock_step=self.clock.lock_step,
            external_torque=any(joint.external_torque_object for joint in self._joint_settings.values()),
            temperature=any(joint.temperature_object for joint in self._joint_settings.values()),
            digital_inputs=True,
        )

    def _alone(self) -> list[list[str]]:
        return [[joint.name] for joint in self.setup.joints]

    def check(self, plan: Plan | None) -> list[Finding]:
        """Everything that can be said without moving or writing."""
        fleet = self._reached()
        cycle_hz = plan.cycle_hz if plan is not None else self.setup.cycle_hz
        moving = plan.stretches if plan is not None else ()
        stretches = [[entry.joint for entry in stretch] for stretch in moving] or self._alone()
        # The fullest of all stretches: joints differ in what they report.
        active = max(stretches, key=lambda names: fleet.load(names, cycle_hz).average_percent)
        layout = fleet.layout(active, cycle_hz)
        findings = inspection.bus_findings(layout.load(), fleet.highest_rate_hz(active), fleet.facts)
        for joint in self.setup.joints:
            entry = next((one for one in plan.joints if one.joint == joint.name), None) if plan else None
            findings += inspection.joint_findings(joint, fleet, layout, self._settings, entry)
        return findings

    def faults(self) -> list[Finding]:
        """What keeps drives from running again (``driver.Resettable``)."""
        return [fault for drive in self._reached().drives.values() if (fault := reentry.standing_fault(drive))]

    def reset_faults(self) -> None:
        """Reset of communication, then of the fault, without power; ``HardwareError`` where one does not come back."""
        fleet = self._reached()
        for drive in fleet.drives.values():
            if reentry.standing_fault(drive) is not None:
                reentry.bring_back(drive, partial(fleet.nmt_to, drive.node_id))

    def configure(self, cycle_hz: float, active: Sequence[str]) -> None:
        """Write and read back everything for this rate; ``active`` joints report on every SYNC.

        ``PlanRefused``, with the numbers and the highest rate that fits, where the layout does not fit the bus.
        """
        fleet = self._reached()
        if self._cycle is not None:
            raise HardwareError("configure while cycling", next_step="call stop_cycling first")
        for name in active:
            self.setup.joint(name)
        layout, self._frame_map = fleet.configure(active, cycle_hz)
        self._layout = layout
        self._decoder = Decoder(self._frame_map, layout.active)
        self._axes = {
            frames.name: Axis(
                frames,
                fleet.scale_of(frames.name),
                feedback,
                max_torque_nm=self._torque_limits_nm[frames.name],
                standstill_rad_s=self._joint_settings[frames.name].standstill_rad_s,
                reset_cycles=max(3, math.ceil(_RESET_S * cycle_hz)),
                position_mode=fleet.facts[frames.name].position_mode,
                mode_when_enabled=fleet.drives[frames.name].quirks.mode_when_enabled,
            )
            for frames, feedback in zip(self._frame_map.joints, self._decoder.feedback, strict=True)
        }
        # The drives watch over us from now on: be heard, also while nobody cycles.
        self._heartbeat = self._heartbeat or HeartbeatTimer(fleet.send_heartbeat, self._settings.host_heartbeat_s)
        self._resume_heartbeat()

    def remarks(self) -> list[Finding]:
        """What drives did not take while being configured, and the run goes on without (``driver.Remarking``)."""
        notes = self._reached().notes
        return [Finding(Severity.WARNING, f"joint {joint}", said) for joint, all_ in notes.items() for said in all_]

    def set_limits(self, joint: str, *, torque_nm: float, position_min_rad: float, position_max_rad: float) -> None:
        """Limits in the drive, read back (6072, 607D), and of torque in the host; tighter ones stay unless allowed."""
        fleet, name = self._reached(), self.setup.joint(joint).name
        drive, settings = fleet.drives[name], self._joint_settings[name]
        limits = (torque_nm, position_min_rad, position_max_rad)
        writes, _ = configure.limit_writes(drive, settings, fleet.scale_of(name), *limits)
        drive.apply(writes)
        self._torque_limits_nm[name] = torque_nm
        self._axis_of(name).limit_torque(torque_nm)

    def frame_map(self) -> FrameMap:
        """Which frame carries what, as read back; for manifest and replay. ``HardwareError`` before ``configure``."""
        if self._frame_map is None:
            raise HardwareError("frame_map before configure")
        return self._frame_map

    def frame_map_values(self) -> Mapping[str, Any]:
        """The same as plain values (``driver.FrameMapped``)."""
        return self.frame_map().to_mapping()

    def start_cycling(self) -> None:
        """All drives operational, run time zero. No SDO from here on, and no thread but the caller's."""
        fleet = self._reached()
        if self._layout is None or self._frame_map is None or self._decoder is None or self._bus is None:
            raise HardwareError("start_cycling before configure")
        fleet.wire.drain()
        if self._heartbeat is not None:
            self._heartbeat.stop()
        self._decoder.restart()
        fleet.nmt(NMT_START)
        self.may_be_powered = tuple(self._axes)
        getattr(self.clock, "restart", lambda: None)()
        self._cycle = Cycle(
            self._bus,
            self.clock,
            self._sink,
            self._frame_map,
            self._layout,
            list(self._axes.values()),
            self._decoder,
            self._settings,
            other=fleet.wire.dispatch,
        )

    def enable(self, joint: str, mode: Mode) -> None:
        """Ask for power; a fault that stands now is reset once. Progress is in the feedback.

        ``HardwareError`` where the drive lacks this mode, or has no watchdog for torque mode.
        """
        axis, facts = self._axis_of(joint), self._reached().facts[joint]
        where = f"joint {joint} (node {self.setup.joint(joint).address})"
        if mode not in _MODES or not facts.supports(mode):
            raise HardwareError(f"the drive does not support mode {mode.name} (6502)", where=where)
        watched = self._reached().watches(joint) or self._settings.allow_torque_without_watchdog
        if mode is Mode.TORQUE and not watched:
            raise HardwareError(
                "torque mode refused: the drive cannot watch over the host "
                + ("(no 1016)" if not facts.heartbeat_consumers else "and stop by itself (no 6007)"),
                where=where,
                cause="if this program died, the drive would keep the last torque",
                next_step="use position mode; or set `allow_torque_without_watchdog: true` in options and keep the "
                "emergency stop in your hand",
            )
        axis.enable(mode)

    def disable(self, joint: str) -> None:
        """Ask for power off: at once when the joint stands, after a quick stop when it moves."""
        self._axis_of(joint).disable()

    def lock(self, joint: str) -> None:
        """Hold the joint at its present target in position mode, whatever its set-point says."""
        self._axis_of(joint).lock()

    def unlock(self, joint: str) -> None:
        """Follow the set-point again, from the moment it is moved."""
        self._axis_of(joint).unlock()

    def exchange(self, set_points: Sequence[SetPoint]) -> Sequence[Feedback]:
        """One cycle; see ``Cycle.exchange``."""
        if self._cycle is None:
            raise HardwareError("exchange before start_cycling")
        return self._cycle.exchange(set_points)

    def quick_stop(self) -> None:
        """Torque to zero and controlword 02 to every drive, past the cyclic loop, from any thread; never raises."""
        if (cycle := self._cycle) is not None:
            cycle.quick_stop()

    def stop_cycling(self) -> None:
        """Bring every joint to standstill and power off, then end cyclic traffic: pre-operational, whatever happens.

        ``SafetyAbort`` where a joint did not come to rest; its voltage was disabled. ``may_be_powered`` names those
        that were not seen to obey.
        """
        cycle = self._cycle
        if cycle is None:
            return
        powered = [joint.name for joint in self.setup.joints]
        try:
            powered = self._settle(cycle)
        finally:
            if powered:
                cycle.cut_power()
            self._cycle = None
            self._end_operation()
            self.may_be_powered = self._seen_powered(powered)
        cut = [name for name, axis in self._axes.items() if axis.power_was_cut or name in powered]
        if cut:
            raise SafetyAbort(
                f"did not come to rest within {_SETTLE_S:g} s; its voltage was disabled",
                where=", ".join(f"joint {name}" for name in cut),
                cause="the drive does not follow a quick stop: another master, a lost connection, or a joint that runs "
                "away",
                next_step="look at the drive before anything gets power again",
            )

    def close(self) -> None:
        """Bring everything to rest and release the bus; safe to call twice and after errors.

        A drive that was not seen without power keeps its watch over us, so that it stops by itself once we are silent;
        ``may_be_powered`` names it.
        """
        if self._cycle is not None:
            self.quick_stop()
            with contextlib.suppress(*_WIRE_ERRORS):
                self.stop_cycling()
        if self._heartbeat is not None and self._fleet is not None:
            with contextlib.suppress(*_WIRE_ERRORS):
                # The drives' watch over us too: they do not miss us when we leave.
                self._fleet.restore(self.may_be_powered)
            self._heartbeat.stop()
        if self._bus is not None:
            with contextlib.suppress(*_WIRE_ERRORS):
                self._bus.shutdown()
        if self._lock is not None:
            self._lock.release()
        self._lock = self._bus = self._fleet = self._heartbeat = None
        self._layout = self._frame_map = self._decoder = None
        self._axes = {}

    def _seen_powered(self, doubtful: Sequence[str]) -> tuple[str, ...]:
        """Those of the joints whose drives do not say by SDO that they are without power."""
        powered = []
        for name in doubtful:
            status = None
            with contextlib.suppress(*_WIRE_ERRORS):
                drive = self._reached().drives[name]
                with drive.answering_within(_LAST_LOOK_S):
                    status = drive.find(od.STATUSWORD)
            if status is None or drive_state(status) not in _OFF:
                powered.append(name)
        return tuple(powered)

    def _reached(self) -> Fleet:
        if self._fleet is None:
            raise HardwareError("the bus is not open", where=self.setup.bus)
        return self._fleet

    def _axis_of(self, joint: str) -> Axis:
        name = self.setup.joint(joint).name
        if name not in self._axes:
            raise HardwareError("not configured yet", where=f"joint {name}")
        return self._axes[name]

    def _resume_heartbeat(self) -> None:
        """In lock-step time stands still outside the cycle, and nobody misses us."""
        if self._heartbeat is not None and not self.clock.lock_step:
            self._heartbeat.start()

    def _settle(self, cycle: Cycle) -> list[str]:
        """Cycle until every joint is off; names of those that are not in time."""
        cycle_hz = self._layout.cycle_hz if self._layout else self.setup.cycle_hz
        for axis in self._axes.values():
            axis.disable()
        set_points = [SetPoint() for _ in self._axes]
        period_ns = round(1e9 / cycle_hz)
        deadline_ns = self.clock.now_ns()
        powered: list[str] = []
        for _ in range(max(4, math.ceil(_SETTLE_S * cycle_hz))):
            deadline_ns = max(deadline_ns + period_ns, self.clock.now_ns())
            self.clock.wait_until(deadline_ns)
            with contextlib.suppress(SafetyAbort):
                # A lost drive does not keep the others from coming to rest.
                cycle.exchange(set_points)
            powered = [name for name, axis in self._axes.items() if axis.state not in _OFF]
            if not powered:
                break
        return powered

    def _end_operation(self) -> None:
        """NMT pre-operational, whatever came before; what the cycle changed is no longer known."""
        fleet, decoder = self._fleet, self._decoder
        if fleet is None or decoder is None:
            return
        fleet.stamp_ns = self.clock.now_ns()
        with contextlib.suppress(*_WIRE_ERRORS):
            fleet.nmt(NMT_PRE_OPERATIONAL)
            fleet.wire.drain()
        fleet.stamp_ns = 0
        fleet.forget_set_points()
        for at, drive in enumerate(fleet.drives.values()):
            if decoder.restarted(at):
                drive.forget()
        self._resume_heartbeat()
