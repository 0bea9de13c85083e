"""The CiA-402 driver: one CAN bus, one drive per joint, the driver protocol on top.

This file is the life cycle; what it does at each step lives next door: ``settings`` (the robot file's options),
``network`` and ``sdo`` (the wire and its objects), ``facts`` (what drives say of themselves), ``layout`` and
``bus_load`` (which frames, and whether they fit), ``configure`` (writing and reading back), ``cycle`` and ``axis`` (the
exchange), ``codec`` (bytes to figures), ``inspection`` (``identify`` and ``check``).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from typing import Any

import can
import canopen

from frictid_drivers.cia402 import configure, inspection
from frictid_drivers.cia402 import objects as od
from frictid_drivers.cia402.axis import Axis
from frictid_drivers.cia402.bus_load import BusLoad, highest_rate_hz
from frictid_drivers.cia402.codec import HEARTBEAT_BASE, Decoder
from frictid_drivers.cia402.cycle import Cycle
from frictid_drivers.cia402.facts import Facts, Scale, raise_on_error, read_facts, scale_of
from frictid_drivers.cia402.frame_map import FrameMap, JointFrames
from frictid_drivers.cia402.layout import Layout, NodeWish, plan_layout
from frictid_drivers.cia402.network import BusFactory, BusLock, HeartbeatTimer, Node, Wire, open_bus
from frictid_drivers.cia402.sdo import Drive
from frictid_drivers.cia402.settings import read_settings
from frictid_drivers.cia402.state import DriveState
from frictid_hil.driver import (
    Capabilities,
    Clock,
    Feedback,
    Finding,
    FrameSink,
    JointIdentity,
    JointSetup,
    Mode,
    RobotSetup,
    SetPoint,
    WallClock,
)
from frictid_hil.errors import FrictidError, HardwareError, PlanRefused, SafetyAbort
from frictid_hil.plan import JointPlan, Plan

_NMT_START, _NMT_PRE_OPERATIONAL = 0x01, 0x80
_PRE_OPERATIONAL_STATE = b"\x7f"
_HIGHEST_RATE_HZ = 4000.0
_SETTLE_S = 2.0
_MODES = {Mode.POSITION: 8, Mode.VELOCITY: 9, Mode.TORQUE: 10}


class Cia402Driver:
    """A robot of CiA-402 drives on one CAN bus.

    Args:
        setup: the robot; ``settings`` lists the options it may carry.
        bus_factory: opens the bus instead of python-can (a simulated one); it is then not locked.
        clock: run time; a clock that is no ``WallClock`` makes this lock-step: answers are there when ``send`` returns,
            and time passes only in ``clock.wait_until``.

    Raises:
        InvalidFields: an option or node id of the robot file is wrong.
    """

    def __init__(self, setup: RobotSetup, *, bus_factory: BusFactory | None = None, clock: Clock | None = None) -> None:
        self.setup = setup
        self.clock: Clock = clock if clock is not None else WallClock()
        self._lock_step = not isinstance(self.clock, WallClock)
        self._settings, self._joint_settings = read_settings(setup)
        self._bus_factory = bus_factory
        self._sink: FrameSink | None = None
        self._bus: can.BusABC | None = None
        self._lock: BusLock | None = None
        self._wire: Wire | None = None
        self._heartbeat: HeartbeatTimer | None = None
        self._drives: dict[str, Drive] = {}
        self._facts: dict[str, Facts] = {}
        self._scales: dict[str, Scale] = {}
        self._torque_limits_nm = {joint.name: joint.max_torque_nm for joint in setup.joints}
        self._layout: Layout | None = None
        self._frame_map: FrameMap | None = None
        self._axes: dict[str, Axis] = {}
        self._decoder: Decoder | None = None
        self._cycle: Cycle | None = None
        self._frozen_ns = 0

    # -- reaching the drives ------------------------------------------------------------------------------------

    def open(self, frame_sink: FrameSink | None = None) -> None:
        """Take the bus exclusively and hear from every drive; reads only.

        Raises:
            HardwareBusy: another process holds the bus.
            HardwareError: no such bus, or a drive does not answer.
        """
        self._sink = frame_sink
        try:
            if self._bus_factory is None:
                self._lock = BusLock(self.setup.bus)
                self._lock.acquire()
                self._bus = open_bus(self.setup.bus, self.setup.options)
            else:
                self._bus = self._bus_factory()
            self._wire = Wire(self._bus, frame_sink, lambda: self._frozen_ns)
            # Objects are addressed by index; no EDS is needed.
            empty = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]  # canopen is only partly typed
            for joint in self.setup.joints:
                node = Node(joint.address, empty)
                self._wire.add_node(node)
                drive = self._drives[joint.name] = Drive(node, joint.name, self._settings.sdo_timeout_s)
                self._wire.subscribe(HEARTBEAT_BASE + joint.address, _forget_after_boot(drive))
            for name, drive in self._drives.items():
                self._facts[name] = read_facts(drive)
        except BaseException:
            self.close()
            raise

    def identify(self) -> dict[str, JointIdentity]:
        """What every drive says of itself, with known manufacturer settings; reads only."""
        return {
            joint.name: inspection.identity(
                joint,
                self._drive(joint.name),
                self._facts[joint.name],
                self._scale(joint, self._told_velocity_unit(joint)),
                self._joint_settings[joint.name],
                self._layout.cycle_hz if self._layout else self.setup.cycle_hz,
            )
            for joint in self.setup.joints
        }

    def capabilities(self) -> Capabilities:
        """What drives and bus can do: with the configured joints active, or with one active before ``configure``."""
        facts = self._facts.values()
        active = self._layout.active if self._layout else self._names[:1]
        watchdog = all(fact.heartbeat_consumers for fact in facts)
        may_torque = watchdog or self._settings.allow_torque_without_watchdog
        return Capabilities(
            max_cycle_hz=self._highest_rate_hz(active),
            modes=frozenset(
                mode
                for mode, number in _MODES.items()
                if all(fact.supports(number) for fact in facts) and (mode is not Mode.TORQUE or may_torque)
            ),
            torque_offset=all(fact.torque_offset for fact in facts),
            drive_watchdog=watchdog,
            lock_step=self._lock_step,
            external_torque=any(joint.external_torque for joint in self._joint_settings.values()),
            temperature=any(joint.temperature for joint in self._joint_settings.values()),
        )

    def check(self, plan: Plan | None) -> list[Finding]:
        """Everything that can be said without moving or writing."""
        cycle_hz = plan.cycle_hz if plan is not None else self.setup.cycle_hz
        active = [plan.joints[0].joint] if plan is not None and plan.joints else self._names[:1]
        findings = [inspection.bus_finding(self._load(active, cycle_hz), self._highest_rate_hz(active))]
        if not self._sync_counter:
            findings.append(inspection.no_sync_counter(self._facts))
        for joint in self.setup.joints:
            facts = self._facts[joint.name]
            scale, doubts = scale_of(facts, joint, self._finest_velocity_unit(facts))
            findings += doubts
            findings += inspection.joint_findings(joint, self._drive(joint.name), facts, scale, self._settings)
        return findings

    # -- configuring --------------------------------------------------------------------------------------------

    def configure(self, cycle_hz: float, active: Sequence[str]) -> None:
        """Write and read back everything for this rate; ``active`` joints report on every SYNC.

        Raises:
            PlanRefused: the layout does not fit the bus; the message has the numbers and the highest rate that does.
            HardwareError: a drive refuses or does not confirm a setting, or is not what the robot file says.
        """
        wire = self._open_wire()
        if self._cycle is not None:
            raise HardwareError("configure while cycling", next_step="call stop_cycling first")
        for name in active:
            self.setup.joint(name)
        load = self._load(active, cycle_hz)
        if not load.fits:
            raise PlanRefused(
                f"{len(active)} of {len(self._names)} joints reporting on every cycle load the bus with {load}",
                where="bus load",
                cause="more than 80 % on average or 100 % in one cycle; frames would come late or not at all",
                next_step=f"use a rate of at most {self._highest_rate_hz(active):g} Hz, or fewer joints at once",
            )
        layout = self._layout_at(active, cycle_hz)
        wire.send_message(0, bytes([_NMT_PRE_OPERATIONAL, 0]))
        frames = []
        for joint in self.setup.joints:
            frames.append(self._configure_joint(joint, layout))
        self._layout = layout
        self._frame_map = FrameMap(tuple(frames), 0x80, round(self._settings.reply_window * 1e9 / cycle_hz))
        self._decoder = Decoder(self._frame_map, layout.active)
        self._axes = {
            joint.name: self._axis(joint, frame, feedback)
            for joint, frame, feedback in zip(self.setup.joints, frames, self._decoder.feedback, strict=True)
        }
        self._keep_alive()

    def set_limits(self, joint: str, *, torque_nm: float, position_min_rad: float, position_max_rad: float) -> None:
        """Torque and position limits in the drive, read back (6072, 607D), and the torque limit in the host.

        Raises:
            HardwareError: refused or not confirmed.
        """
        drive, scale = self._drive(joint), self._scales.get(joint)
        if scale is None:
            raise HardwareError("set_limits before configure")
        configure.configure_limits(drive, scale, torque_nm, position_min_rad, position_max_rad)
        self._torque_limits_nm[joint] = torque_nm
        if joint in self._axes:
            self._axes[joint].limit_torque(torque_nm)

    def frame_map(self) -> FrameMap:
        """Which frame carries what, as read back; for the run's manifest and for replay.

        Raises:
            HardwareError: not configured yet.
        """
        if self._frame_map is None:
            raise HardwareError("frame_map before configure")
        return self._frame_map

    def report_interval_cycles(self, joint: str) -> int:
        """Cycles between two reports of this joint as configured: 1 where active."""
        if self._layout is None or joint in self._layout.active:
            return 1
        return self._layout.interval_cycles

    # -- cycling ------------------------------------------------------------------------------------------------

    def start_cycling(self) -> None:
        """All drives operational, run time zero. No SDO from here on, and no thread but the caller's.

        Raises:
            HardwareError: not configured.
        """
        wire = self._open_wire()
        if self._layout is None or self._frame_map is None or self._decoder is None or self._bus is None:
            raise HardwareError("start_cycling before configure")
        wire.drain()
        if self._heartbeat is not None:
            self._heartbeat.stop()
        self._decoder.restart()
        wire.send_message(0, bytes([_NMT_START, 0]))
        restart = getattr(self.clock, "restart", None)
        if restart is not None:
            restart()
        self._cycle = Cycle(
            self._bus,
            self.clock,
            self._sink,
            self._frame_map,
            self._layout,
            list(self._axes.values()),
            self._decoder,
            self._settings,
            lock_step=self._lock_step,
            other=wire.dispatch,
        )

    def enable(self, joint: str, mode: Mode) -> None:
        """Ask for power; a fault that stands now is reset once. Progress is in the feedback.

        Raises:
            HardwareError: the drive lacks this mode, or has no watchdog for torque mode.
        """
        axis, facts = self._axis_of(joint), self._facts[joint]
        where = f"joint {joint} (node {self.setup.joint(joint).address})"
        if mode not in _MODES or not facts.supports(_MODES[mode]):
            raise HardwareError(f"the drive does not support mode {mode.name} (6502)", where=where)
        if mode is Mode.TORQUE and not facts.heartbeat_consumers and not self._settings.allow_torque_without_watchdog:
            raise HardwareError(
                "torque mode refused: the drive cannot watch over the host (no 1016)",
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
        """Follow the set-point again."""
        self._axis_of(joint).unlock()

    def exchange(self, set_points: Sequence[SetPoint]) -> Sequence[Feedback]:
        """One cycle; see ``Cycle.exchange``."""
        cycle = self._cycle
        if cycle is None:
            raise HardwareError("exchange before start_cycling")
        return cycle.exchange(set_points)

    def run_batch(self, plan: JointPlan) -> Mapping[str, Any]:
        """Not offered: this driver cycles."""
        raise HardwareError("CiA-402 drives are driven cycle by cycle; they run no batches", where=self.setup.bus)

    def quick_stop(self) -> None:
        """Torque to zero and controlword 02 to every drive, past the cyclic loop, from any thread; never raises."""
        cycle = self._cycle
        if cycle is not None:
            cycle.quick_stop()

    def stop_cycling(self) -> None:
        """Bring every joint to standstill and power off, then end cyclic traffic.

        Raises:
            SafetyAbort: a joint did not come to rest or keeps its power; its voltage was disabled and the drives are
                pre-operational all the same.
        """
        cycle = self._cycle
        if cycle is None:
            return
        powered = self._names
        try:
            powered = self._settle(cycle)
        finally:
            if powered:
                cycle.cut_power()
            self._cycle = None
            self._frozen_ns = self.clock.now_ns()
            self._end_operation()
            self._frozen_ns = 0
        if powered:
            raise SafetyAbort(
                f"did not come to rest and off within {_SETTLE_S:g} s",
                where=", ".join(f"joint {name}" for name in powered),
                next_step="press the emergency stop, then look at the drive",
            )

    def close(self) -> None:
        """Bring everything to rest and release the bus; safe to call twice and after errors."""
        if self._cycle is not None:
            self.quick_stop()
            with contextlib.suppress(FrictidError, can.CanError, OSError):
                self.stop_cycling()
        if self._heartbeat is not None:
            for drive in self._drives.values():
                with contextlib.suppress(FrictidError, can.CanError, OSError):
                    configure.release_watchdog(drive)
            self._heartbeat.stop()
            self._heartbeat = None
        if self._bus is not None:
            with contextlib.suppress(can.CanError, OSError):
                self._bus.shutdown()
        if self._lock is not None:
            self._lock.release()
        self._bus = self._wire = self._lock = None
        self._drives.clear()
        self._axes.clear()
        self._layout = self._frame_map = self._decoder = None

    # -- parts --------------------------------------------------------------------------------------------------

    @property
    def _names(self) -> list[str]:
        return [joint.name for joint in self.setup.joints]

    @property
    def _sync_counter(self) -> bool:
        return all(facts.sync_counter for facts in self._facts.values())

    def _open_wire(self) -> Wire:
        if self._wire is None:
            raise HardwareError("the bus is not open", where=self.setup.bus)
        return self._wire

    def _drive(self, joint: str) -> Drive:
        self._open_wire()
        return self._drives[self.setup.joint(joint).name]

    def _axis_of(self, joint: str) -> Axis:
        if joint not in self._axes:
            self.setup.joint(joint)
            raise HardwareError(f"joint {joint} is not configured")
        return self._axes[joint]

    def _told_velocity_unit(self, joint: JointSetup) -> int | None:
        return self._drive(joint.name).find(od.VELOCITY_UNIT)

    def _finest_velocity_unit(self, facts: Facts) -> int | None:
        """What ``configure`` will ask for."""
        return None if facts.velocity_unit is None else od.MILLI_RPM

    def _scale(self, joint: JointSetup, velocity_unit: int | None) -> Scale:
        return scale_of(self._facts[joint.name], joint, velocity_unit)[0]

    def _wishes(self) -> list[NodeWish]:
        return [
            NodeWish(
                joint=joint.name,
                node=joint.address,
                torque_offset=self._facts[joint.name].torque_offset,
                torque_target=self._facts[joint.name].target_torque,
                velocity_target=self._facts[joint.name].supports(_MODES[Mode.VELOCITY]),
                external_torque=self._joint_settings[joint.name].external_torque,
                temperature=self._joint_settings[joint.name].temperature,
            )
            for joint in self.setup.joints
        ]

    def _layout_at(self, active: Sequence[str], cycle_hz: float) -> Layout:
        return plan_layout(
            self._wishes(),
            active,
            cycle_hz,
            sync_counter=self._sync_counter,
            host_heartbeat_s=self._settings.host_heartbeat_s,
            drive_heartbeat_s=self._settings.drive_heartbeat_ms * 1e-3,
        )

    def _load(self, active: Sequence[str], cycle_hz: float) -> BusLoad:
        return self._layout_at(active, cycle_hz).load(self._settings.bitrate)

    def _highest_rate_hz(self, active: Sequence[str]) -> float:
        return highest_rate_hz(lambda hz: self._load(active, hz), _HIGHEST_RATE_HZ)

    def _configure_joint(self, joint: JointSetup, layout: Layout) -> JointFrames:
        drive, settings = self._drive(joint.name), self._joint_settings[joint.name]
        configure.refuse_if_powered(drive)
        if joint.name not in self._scales:
            unit = configure.configure_velocity_unit(drive, self._facts[joint.name].velocity_unit)
            scale, findings = scale_of(self._facts[joint.name], joint, unit)
            raise_on_error(findings)
            self._scales[joint.name] = scale
        scale = self._scales[joint.name]
        configure.configure_timing(drive, layout.cycle_hz, layout.sync_overflow)
        configure.configure_safety(drive, self._settings)
        configure.configure_windows(drive, settings, scale.position_rad, active=joint.name in layout.active)
        configure.configure_set_points(drive, _MODES[Mode.POSITION])
        frames = configure.configure_pdos(drive, layout, joint.name)
        return JointFrames(
            name=joint.name,
            node=joint.address,
            position_rad_per_unit=scale.position_rad,
            velocity_rad_s_per_unit=scale.velocity_rad_s,
            torque_nm_per_unit=scale.torque_nm,
            external_torque_nm_per_unit=settings.external_torque_nm_per_unit,
            temperature_c_per_unit=settings.temperature_c_per_unit,
            reports=tuple(frame for (transmit, _), frame in frames.items() if transmit),
            commands=tuple(frame for (transmit, _), frame in frames.items() if not transmit),
        )

    def _axis(self, joint: JointSetup, frames: JointFrames, feedback: Feedback) -> Axis:
        primary, secondary = frames.commands
        assert self._layout is not None
        return Axis(
            joint.name,
            self._scales[joint.name],
            primary,
            secondary,
            feedback,
            max_torque_nm=self._torque_limits_nm[joint.name],
            standstill_rad_s=self._joint_settings[joint.name].standstill_rad_s,
            reset_cycles=max(3, math.ceil(0.5 * self._layout.cycle_hz)),
        )

    def _keep_alive(self) -> None:
        """The drives watch over us from now on: be heard, also while nobody cycles."""
        if self._heartbeat is None:
            wire = self._open_wire()
            cob_id = HEARTBEAT_BASE + self._settings.host_node
            self._heartbeat = HeartbeatTimer(
                lambda: wire.send_message(cob_id, _PRE_OPERATIONAL_STATE), self._settings.host_heartbeat_s
            )
        if not self._lock_step:
            self._heartbeat.start()

    def _settle(self, cycle: Cycle) -> list[str]:
        """Cycle until every joint is off; names of those that are not in time."""
        assert self._layout is not None
        for axis in self._axes.values():
            axis.disable()
        set_points = [SetPoint() for _ in self._axes]
        period_ns = round(1e9 / self._layout.cycle_hz)
        deadline_ns = self.clock.now_ns()
        powered: list[str] = []
        for _ in range(max(4, math.ceil(_SETTLE_S * self._layout.cycle_hz))):
            deadline_ns = max(deadline_ns + period_ns, self.clock.now_ns())
            self.clock.wait_until(deadline_ns)
            with contextlib.suppress(SafetyAbort):
                # A lost drive does not keep the others from coming to rest.
                cycle.exchange(set_points)
            powered = [name for name, axis in self._axes.items() if axis.state not in _OFF]
            if not powered:
                return []
        return powered

    def _end_operation(self) -> None:
        """NMT pre-operational, whatever came before; what the cycle changed is no longer known."""
        wire, decoder = self._wire, self._decoder
        if wire is None or decoder is None:
            return
        with contextlib.suppress(can.CanError, OSError):
            wire.send_message(0, bytes([_NMT_PRE_OPERATIONAL, 0]))
            wire.drain()
        for at, drive in enumerate(self._drives.values()):
            drive.forget(od.MODE, od.TARGET_TORQUE, od.TORQUE_OFFSET, od.TARGET_VELOCITY)
            if decoder.restarted(at):
                drive.forget()
        if self._heartbeat is not None and not self._lock_step:
            self._heartbeat.start()


_OFF = (
    DriveState.SWITCH_ON_DISABLED,
    DriveState.NOT_READY,
    DriveState.FAULT,
    DriveState.UNKNOWN,
)
"""States without motor power from which nothing more can be asked; UNKNOWN: never reported, never enabled."""


def _forget_after_boot(drive: Drive) -> Any:
    """A boot-up frame says that nothing we wrote is there any more."""

    def heartbeat(_can_id: int, data: bytearray, _timestamp: float) -> None:
        if data and data[0] == 0:
            drive.forget()

    return heartbeat
