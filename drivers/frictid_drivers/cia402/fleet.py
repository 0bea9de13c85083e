"""All drives of one robot on one open bus: what they say, which layouts suit them, and writing one of these to all."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Mapping, Sequence

import can
import canopen

from frictid_drivers.cia402 import communication, configure
from frictid_drivers.cia402 import objects as od
from frictid_drivers.cia402.access import Drive, RefusedByDrive, Write
from frictid_drivers.cia402.codec import HEARTBEAT_BASE
from frictid_drivers.cia402.facts import Facts, read_facts
from frictid_drivers.cia402.frame_map import FrameMap, JointFrames, joint_frames
from frictid_drivers.cia402.layout import BusLoad, Layout, NodeWish, highest_rate_hz, plan_layout
from frictid_drivers.cia402.network import Node, SdoDrive, Wire
from frictid_drivers.cia402.quirks import Catalogue, merged, quirks_of_eds
from frictid_drivers.cia402.scale import Scale, raise_on_error, scale_of
from frictid_drivers.cia402.settings import BusSettings, JointSettings
from frictid_hil.errors import HardwareError, PlanRefused
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.driver import Finding, FrameSink

NMT_START, NMT_PRE_OPERATIONAL = 0x01, 0x80
PRE_OPERATIONAL_STATE = b"\x7f"
SYNC_COB_ID = 0x80
_HIGHEST_RATE_HZ = 4000.0


class Fleet:
    """The drives of one robot, reached; reads only until ``configure``. ``HardwareError`` where one does not answer."""

    def __init__(
        self,
        setup: RobotSetup,
        settings: BusSettings,
        joint_settings: Mapping[str, JointSettings],
        bus: can.BusABC,  # open
        sink: FrameSink | None,  # told of every frame, at a run time that stands still while nobody cycles
    ) -> None:
        self._setup = setup
        self._settings = settings
        self._joint_settings = joint_settings
        self.stamp_ns = 0  # run time that frames outside the cycle are stamped with
        self.wire = Wire(bus, sink, lambda: self.stamp_ns)
        self.drives: dict[str, Drive] = {}
        self._scales: dict[str, Scale] = {}
        # Objects are addressed by index; no EDS is needed.
        empty = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]  # canopen is only partly typed
        for joint in setup.joints:
            node = Node(joint.address, empty)
            self.wire.add_node(node)
            self.drives[joint.name] = SdoDrive(node, joint.name, settings.sdo_timeout_s)
            self.wire.subscribe(HEARTBEAT_BASE + joint.address, self._on_heartbeat)
        catalogue = Catalogue(setup.folder)
        self.facts: dict[str, Facts] = {}  # what each drive said of itself
        # What drives did not take and the run goes on without, by joint name, once configured.
        self.notes: dict[str, list[str]] = {}
        for name, drive in self.drives.items():
            facts = self.facts[name] = read_facts(drive, catalogue.of)
            eds = joint_settings[name].eds
            drive.learn(merged(facts.quirks, quirks_of_eds(eds, drive.node_id)) if eds else facts.quirks)

    @property
    def watchdog(self) -> bool:
        """Every drive notices when the host dies."""
        return all(self.watches(joint) for joint in self.facts)

    def watches(self, joint: str) -> bool:
        """This drive stops by itself when the host dies, and was seen to take our watch where it is configured."""
        lost = ("watch over the host", "when the host is lost")
        return self.facts[joint].watchdog and not any(one in note for note in self.notes.get(joint, ()) for one in lost)

    def nmt(self, command: int) -> None:
        """An NMT command to each of our drives; other devices on the bus are none of our business."""
        for drive in self.drives.values():
            self.nmt_to(drive.node_id, command)

    def nmt_to(self, node: int, command: int) -> None:
        """An NMT command to one node."""
        self.wire.send_message(0, bytes([command, node]))

    def send_heartbeat(self) -> None:
        """The host's own heartbeat while nobody cycles."""
        self.wire.send_message(HEARTBEAT_BASE + self._settings.host_node, PRE_OPERATIONAL_STATE)

    def layout(self, active: Sequence[str], cycle_hz: float) -> Layout:
        """The frames for a rate and a set of joints that report on every SYNC."""
        return plan_layout(
            [self._wish(joint) for joint in self._setup.joints],
            active,
            cycle_hz,
            sync_counter=all(facts.sync_counter for facts in self.facts.values()),
            host_heartbeat_s=self._settings.host_heartbeat_s,
            drive_heartbeat_s=self._settings.drive_heartbeat_ms * 1e-3,
            rates=self._settings.rates,
            pdo_bytes=self._settings.pdo_bytes,
        )

    def load(self, active: Sequence[str], cycle_hz: float) -> BusLoad:
        """Its load on this bus."""
        return self.layout(active, cycle_hz).load()

    def highest_rate_hz(self, active: Sequence[str]) -> float:
        """The highest rate that fits."""
        return highest_rate_hz(lambda hz: self.load(active, hz), _HIGHEST_RATE_HZ)

    def _wish(self, joint: JointSetup) -> NodeWish:
        facts, settings = self.facts[joint.name], self._joint_settings[joint.name]
        drive, quirks = self.drives[joint.name], self.drives[joint.name].quirks
        offset = quirks.typed(od.TORQUE_OFFSET)
        timers = (drive.known(od.pdo(False, number, od.RPDO_TIMEOUT)) for number in (1, 2))
        return NodeWish(
            joint=joint.name,
            node=joint.address,
            torque_offset=facts.torque_offset and quirks.maps(offset),
            torque_target=facts.target_torque and quirks.maps(od.TARGET_TORQUE),
            velocity_target=facts.supports(Mode.VELOCITY)
            and drive.has(od.TARGET_VELOCITY)
            and quirks.maps(od.TARGET_VELOCITY),
            error_code=facts.error_code and quirks.maps(od.ERROR_CODE),
            interpolated=facts.position_mode == od.INTERPOLATED,
            offset=offset,
            decimates=quirks.sends_on(10),
            supervised_s=min((ms for ms in timers if ms), default=0) * 1e-3,
            external_torque=settings.external_torque_object,
            temperature=settings.temperature_object,
            digital_inputs=settings.digital_inputs,
        )

    def configure(self, active: Sequence[str], cycle_hz: float) -> tuple[Layout, FrameMap]:
        """Write a layout and all that makes it safe to every drive; returns it, and its frames as read back.

        A drive that does not take what is nice to have is asked again without it. ``PlanRefused`` where the layout
        does not fit the bus; ``HardwareError`` where a power stage is on, a setting is refused or not confirmed, or a
        drive is not what the robot file says.
        """
        self._refuse_overload(self.load(active, cycle_hz), active)
        for drive in self.drives.values():
            configure.refuse_if_lacking(drive)
            configure.refuse_if_powered(drive)
        for drive in self.drives.values():
            configure.end_quick_stop(drive)
        self.nmt(NMT_PRE_OPERATIONAL)
        while True:
            layout = self.layout(active, cycle_hz)
            self._refuse_overload(layout.load(), active)
            try:
                frames = tuple(self._configure_joint(joint, layout) for joint in self._setup.joints)
            except RefusedByDrive as refused:
                if not any(communication.lesson(drive, refused) for drive in self.drives.values()):
                    raise
                continue
            window_ns = round(self._settings.reply_window * 1e9 / cycle_hz)
            return layout, FrameMap(frames, SYNC_COB_ID, window_ns, self._settings.host_node)

    def foreseen(self, joint: JointSetup, layout: Layout) -> tuple[list[Finding], list[str], list[str]]:
        """What configuring will meet, by reading alone: findings of the scale, what ends the run, what is lost."""
        drive, facts, settings = self.drives[joint.name], self.facts[joint.name], self._joint_settings[joint.name]
        units = configure.velocity_unit_writes(drive)
        unit = facts.velocity_unit
        if units and not drive.quirks.refusal(od.VELOCITY_UNIT, od.MILLI_RPM):
            unit = od.MILLI_RPM
        scale, findings = scale_of(facts, joint, unit)
        limits = (joint.max_torque_nm, joint.position_min_rad, joint.position_max_rad)
        try:
            writes, tighter = configure.limit_writes(drive, settings, scale, *limits)
            writes += self._writes(joint, scale, layout)
            fatal, lost = drive.foresee([*units, *writes])
            configure.refuse_other_period(drive, layout.cycle_hz, lost)
        except HardwareError as error:
            return findings, [error.what], []
        return findings, fatal, [*tighter, *lost]

    def _writes(self, joint: JointSetup, scale: Scale, layout: Layout) -> list[Write]:
        """Everything but the limits and the velocity unit, in order; `check` and ``configure`` use the same."""
        drive, settings = self.drives[joint.name], self._joint_settings[joint.name]
        return [
            *communication.sync_writes(drive, layout.cycle_hz, layout.sync_overflow),
            *configure.interpolation_writes(drive, layout.cycle_hz),
            *configure.reaction_writes(drive, self._settings),
            *communication.heartbeat_writes(drive, self._settings),
            *communication.frame_format_writes(drive, settings.fd_object, fd=layout.fd),
            *configure.window_writes(drive, settings, scale.position_rad, active=joint.name in layout.active),
            *configure.set_point_writes(drive, self.facts[joint.name].position_mode),
            *communication.pdo_writes(drive, layout, joint.name),
        ]

    def travel_rad(self, joint: JointSetup) -> tuple[float, float] | None:
        """Between which positions the drive lets this joint move once configured; None where it sets no limits."""
        drive, settings = self.drives[joint.name], self._joint_settings[joint.name]
        low, high = drive.known(od.POSITION_LIMIT_MIN), drive.known(od.POSITION_LIMIT_MAX)
        if low is None or high is None or low >= high or settings.widen_position_limits:
            return None
        scale, _ = scale_of(self.facts[joint.name], joint, None)
        first, last = sorted((low * scale.position_rad, high * scale.position_rad))
        return first, last

    def restore(self, but_not: Collection[str]) -> None:
        """Put back what this run changed where a drive answers; where power may be on (``but_not``) drives watch on."""
        for name, drive in self.drives.items():
            if name not in but_not:
                with contextlib.suppress(HardwareError):
                    drive.restore()

    def scale_of(self, joint: str) -> Scale:
        """Joint-side factors; ``HardwareError`` where not configured yet."""
        if joint not in self._scales:
            raise HardwareError("not configured yet", where=f"joint {joint}")
        return self._scales[joint]

    def forget_set_points(self) -> None:
        """The cycle has changed these past the SDO."""
        for drive in self.drives.values():
            drive.forget(od.MODE, od.TARGET_TORQUE, od.TORQUE_OFFSET, od.TARGET_VELOCITY)

    def _configure_joint(self, joint: JointSetup, layout: Layout) -> JointFrames:
        drive, facts = self.drives[joint.name], self.facts[joint.name]
        settings = self._joint_settings[joint.name]
        notes = []
        scale = self._scales.get(joint.name)
        if scale is None:
            dependent = configure.velocity_dependent(drive)
            notes += drive.apply(configure.velocity_unit_writes(drive))
            notes += drive.apply(configure.dependent_writes(drive, facts.velocity_unit, dependent))
            scale, findings = scale_of(facts, joint, drive.known(od.VELOCITY_UNIT))
            raise_on_error(findings)
            self._scales[joint.name] = scale
        notes += drive.apply(self._writes(joint, scale, layout))
        configure.refuse_other_period(drive, layout.cycle_hz, notes)
        target = od.INTERPOLATED_TARGET if facts.position_mode == od.INTERPOLATED else od.TARGET_POSITION
        drive.write_blind(target, drive.read(od.POSITION_ACTUAL))
        self.notes[joint.name] = notes
        reports, commands = (
            [communication.frame_of(drive, pdo) for pdo in layout.pdos[joint.name] if pdo.transmit is transmit]
            for transmit in (True, False)
        )
        return joint_frames(joint, scale, settings, reports, commands)

    def _on_heartbeat(self, can_id: int, data: bytearray, _timestamp: float) -> None:
        """A boot-up frame says that nothing we wrote is there any more."""
        for drive in self.drives.values():
            if data and data[0] == 0 and HEARTBEAT_BASE + drive.node_id == can_id:
                drive.forget()

    def _refuse_overload(self, load: BusLoad, active: Sequence[str]) -> None:
        if not load.fits:
            raise PlanRefused(
                f"{len(active)} of {len(self.drives)} joints reporting on every cycle load the bus with {load}",
                where="bus load",
                cause="more than 80 % on average or 100 % in one cycle; frames would come late or not at all",
                next_step=f"use a rate of at most {self.highest_rate_hz(active):g} Hz (`calibrate --rate`, or "
                "`cycle_hz` in the robot file), or fewer joints at once",
            )
