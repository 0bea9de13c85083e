"""All drives of one robot on one open bus: what they say, which layouts suit them, and writing one of these to all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import can
import canopen

from frictid_drivers.cia402 import configure
from frictid_drivers.cia402 import objects as od
from frictid_drivers.cia402.bus_load import BusLoad, highest_rate_hz
from frictid_drivers.cia402.codec import HEARTBEAT_BASE
from frictid_drivers.cia402.facts import Facts, Scale, raise_on_error, read_facts, scale_of
from frictid_drivers.cia402.frame_map import FrameMap, JointFrames
from frictid_drivers.cia402.layout import Layout, NodeWish, plan_layout
from frictid_drivers.cia402.network import Node, Wire
from frictid_drivers.cia402.sdo import Drive
from frictid_drivers.cia402.settings import BusSettings, JointSettings
from frictid_hil.errors import HardwareError
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.driver import FrameSink

NMT_START, NMT_PRE_OPERATIONAL = 0x01, 0x80
PRE_OPERATIONAL_STATE = b"\x7f"
SYNC_COB_ID = 0x80
_HIGHEST_RATE_HZ = 4000.0


class Fleet:
    """The drives of one robot, reached; reads only until ``configure``.

    Args:
        setup: the robot.
        settings: of the bus.
        joint_settings: by joint name.
        bus: open.
        sink: told of every frame, at a run time that stands still while nobody cycles.

    Attributes:
        wire: canopen on that bus.
        stamp_ns: run time that frames outside the cycle are stamped with.
        drives: SDO access by joint name.
        facts: what each drive said of itself.
        scales: joint-side factors, by joint name, once configured.

    Raises:
        HardwareError: a drive does not answer, or is no CANopen device.
    """

    def __init__(
        self,
        setup: RobotSetup,
        settings: BusSettings,
        joint_settings: Mapping[str, JointSettings],
        bus: can.BusABC,
        sink: FrameSink | None,
    ) -> None:
        self._setup = setup
        self._settings = settings
        self._joint_settings = joint_settings
        self.stamp_ns = 0
        self.wire = Wire(bus, sink, lambda: self.stamp_ns)
        self.drives: dict[str, Drive] = {}
        self.scales: dict[str, Scale] = {}
        # Objects are addressed by index; no EDS is needed.
        empty = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]  # canopen is only partly typed
        for joint in setup.joints:
            node = Node(joint.address, empty)
            self.wire.add_node(node)
            self.drives[joint.name] = Drive(node, joint.name, settings.sdo_timeout_s)
            self.wire.subscribe(HEARTBEAT_BASE + joint.address, self._on_heartbeat)
        self.facts: dict[str, Facts] = {name: read_facts(drive) for name, drive in self.drives.items()}

    @property
    def sync_counter(self) -> bool:
        """Every drive can spread its reports by start values."""
        return all(facts.sync_counter for facts in self.facts.values())

    @property
    def watchdog(self) -> bool:
        """Every drive notices when the host dies."""
        return all(facts.heartbeat_consumers for facts in self.facts.values())

    def nmt(self, command: int) -> None:
        """An NMT command to each of our drives; other devices on the bus are none of our business."""
        for drive in self.drives.values():
            self.wire.send_message(0, bytes([command, drive.node_id]))

    def send_heartbeat(self) -> None:
        """The host's own heartbeat while nobody cycles."""
        self.wire.send_message(HEARTBEAT_BASE + self._settings.host_node, PRE_OPERATIONAL_STATE)

    # -- layouts ------------------------------------------------------------------------------------------------

    def layout(self, active: Sequence[str], cycle_hz: float) -> Layout:
        """The frames for a rate and a set of joints that report on every SYNC."""
        return plan_layout(
            [self._wish(joint) for joint in self._setup.joints],
            active,
            cycle_hz,
            sync_counter=self.sync_counter,
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
        return NodeWish(
            joint=joint.name,
            node=joint.address,
            torque_offset=facts.torque_offset,
            torque_target=facts.target_torque,
            velocity_target=facts.supports(Mode.VELOCITY),
            external_torque=settings.external_torque,
            temperature=settings.temperature,
            digital_inputs=settings.digital_inputs,
        )

    # -- writing ------------------------------------------------------------------------------------------------

    def configure(self, layout: Layout) -> FrameMap:
        """Write a layout and everything that makes it safe to all drives.

        Returns:
            The frames as read back.

        Raises:
            HardwareError: a power stage is on, a setting is refused or not confirmed, or a drive is not what the robot
                file says.
        """
        for drive in self.drives.values():
            configure.refuse_if_powered(drive)
        for drive in self.drives.values():
            configure.end_quick_stop(drive)
        self.nmt(NMT_PRE_OPERATIONAL)
        frames = tuple(self._configure_joint(joint, layout) for joint in self._setup.joints)
        window_ns = round(self._settings.reply_window * 1e9 / layout.cycle_hz)
        return FrameMap(frames, SYNC_COB_ID, window_ns, self._settings.host_node)

    def scale_of(self, joint: str) -> Scale:
        """Joint-side factors.

        Raises:
            HardwareError: not configured yet.
        """
        if joint not in self.scales:
            raise HardwareError("not configured yet", where=f"joint {joint}")
        return self.scales[joint]

    def forget_set_points(self) -> None:
        """The cycle has changed these past the SDO."""
        for drive in self.drives.values():
            drive.forget(od.MODE, od.TARGET_TORQUE, od.TORQUE_OFFSET, od.TARGET_VELOCITY)

    def _configure_joint(self, joint: JointSetup, layout: Layout) -> JointFrames:
        drive, facts = self.drives[joint.name], self.facts[joint.name]
        settings = self._joint_settings[joint.name]
        if joint.name not in self.scales:
            unit = configure.configure_velocity_unit(drive, facts.velocity_unit)
            scale, findings = scale_of(facts, joint, unit)
            raise_on_error(findings)
            self.scales[joint.name] = scale
        scale = self.scales[joint.name]
        configure.configure_timing(drive, layout.cycle_hz, layout.sync_overflow)
        configure.configure_safety(drive, self._settings)
        configure.configure_frame_format(drive, settings.fd_object, fd=layout.fd)
        configure.configure_windows(drive, settings, scale.position_rad, active=joint.name in layout.active)
        configure.configure_set_points(drive, Mode.POSITION)
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

    def _on_heartbeat(self, can_id: int, data: bytearray, _timestamp: float) -> None:
        """A boot-up frame says that nothing we wrote is there any more."""
        if data and data[0] == 0:
            for joint in self._setup.joints:
                if HEARTBEAT_BASE + joint.address == can_id:
                    self.drives[joint.name].forget()
