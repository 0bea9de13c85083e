"""The ``virtual`` driver: simulated drives behind a bus, spoken to by the very driver that real drives get.

In lock-step the drives live in this process and run time is theirs; with ``setup.realtime`` they live in a process of
their own and the wall clock rules. Everything a run asks for is the ``Cia402Driver``'s own doing, which cannot tell the
difference; this class only builds the bus, takes it exclusively and tears it down.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import can

from frictid_drivers.virtual import channel
from frictid_drivers.virtual.faults import HOST_KINDS, faults_of, missing_objects
from frictid_drivers.virtual.faulty_bus import FaultyBus
from frictid_drivers.virtual.faulty_rack import FaultyRack, leave_in_fault
from frictid_drivers.virtual.lock_step import LockStepBus, LockStepClock
from frictid_drivers.virtual.objects import OBJECTS, SIZE_BYTES, key, key_text
from frictid_drivers.virtual.rack import Rack, arm_of
from frictid_drivers.virtual.rack_launcher import RunningRack, start_rack
from frictid_drivers.virtual.socket_bus import SocketBus
from frictid_hil.errors import HardwareError, InvalidFields, UsageError
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.driver import DriverKind, FrameSink, WallClock, unknown_options
from frictid_hil.simulation.joint import JointModel

if TYPE_CHECKING:
    import filelock


_WRITE_S = 2.0


class VirtualDriver:
    """See the module's first page and ``frictid_hil.protocol.driver.Driver``."""

    kind = DriverKind(
        simulated=True,
        line="virtual",
        addressed_by="node",
        addresses=(1, 127),
        elsewhere={"can": "cia402", "serial": "motoman"},
    )

    def __init__(self, setup: RobotSetup) -> None:
        # Late, because the drives' own process imports this package and has no use for the host.
        from frictid_drivers.cia402 import Cia402Driver

        self._setup = setup
        self._faults = faults_of(setup)
        self._channel = channel.channel_name(setup.bus)
        self._lock: filelock.BaseFileLock | None = None
        self._rack = Rack()
        self._drives = FaultyRack(self._rack, self._faults) if self._faults else self._rack
        self._process: RunningRack | None = None
        self.clock: LockStepClock | WallClock = WallClock() if setup.realtime else LockStepClock(self._drives)
        self._host = host = Cia402Driver(_told_to_host(setup), bus_factory=self._open_bus, clock=self.clock)
        self.identify, self.capabilities, self.check = host.identify, host.capabilities, host.check
        self.faults, self.reset_faults = host.faults, host.reset_faults
        self.configure, self.set_limits, self.remarks = host.configure, host.set_limits, host.remarks
        self.frame_map_values = host.frame_map_values
        self.start_cycling, self.exchange, self.stop_cycling = host.start_cycling, host.exchange, host.stop_cycling
        self.enable, self.disable, self.lock, self.unlock = host.enable, host.disable, host.lock, host.unlock
        self.quick_stop = host.quick_stop

    def open(self, frame_sink: FrameSink | None = None) -> None:
        """Power the drives and reach them; on the wall clock, where others could reach them too, take the channel."""
        try:
            if self._setup.realtime:
                self._lock = channel.take(self._channel)
                for joint in self._setup.joints:
                    JointModel.of(joint, joint.name)  # a mistake is better told here than by another process
                arm_of(self._setup)
                self._process = start_rack(self._setup)
            else:
                self._rack.install(self._setup, missing=missing_objects(self._faults))
            self._host.open(frame_sink)
        except BaseException:
            self.close()
            raise

    def _open_bus(self) -> can.BusABC:
        bus: can.BusABC
        if self._setup.realtime:
            bus = SocketBus(self._channel)
        else:
            # A channel of its own: this bus lives in one process, and may do so more than once.
            bus = LockStepBus(self._drives, f"{self._channel}-{id(self)}")
            self._rack.power_on()
            leave_in_fault(self._rack, self._faults)
        ours = [fault for fault in self._faults if fault.kind in HOST_KINDS]
        if not ours or self._setup.realtime:
            return FaultyBus(bus, ours) if ours else bus
        drives = self._drives
        return FaultyBus(
            bus, ours, lambda: drives.now_ns, lambda lasts_s: drives.advance(drives.now_ns + round(lasts_s * 1e9))
        )

    def close(self) -> None:
        """Bring everything to rest and let go of the channel."""
        try:
            self._host.close()
        finally:
            if self._process is not None:
                self._process.stop()
            if self._lock is not None:
                self._lock.release()
            self._process = self._lock = None

    @property
    def may_be_powered(self) -> tuple[str, ...]:
        """As ``driver.Driver``."""
        return self._host.may_be_powered

    def simulate_hand(
        self, joint: str, centre_rad: float = 0.0, amplitude_rad: float = 0.0, frequency_hz: float = 0.0
    ) -> None:
        """Let a person guide a joint along centre + amplitude sin(2 pi f t), t from now; frequency 0 lets go.

        ``UsageError`` where the robot file gives this joint no ``hand``.
        """
        grip = frequency_hz > 0.0
        if grip and "hand" not in self._setup.joint(joint).simulated:
            raise UsageError(
                "this joint has no simulated hand",
                where=f"joint {joint}",
                next_step="give it stiffness and damping under `simulated: hand:` in the robot file",
            )
        self._write(joint, 0x2040, 1, 0)
        if grip:
            self._write(joint, 0x2040, 2, round(centre_rad * 1e6))
            self._write(joint, 0x2040, 3, round(amplitude_rad * 1e6))
            self._write(joint, 0x2040, 4, round(frequency_hz * 1e3))
            self._write(joint, 0x2040, 1, 1)

    def mount_payload(self, joint: str, mounted: bool) -> None:
        """Put the payload of the robot file on a joint, or take it off."""
        self._write(joint, 0x2041, 0, int(mounted))

    def _write(self, joint: str, index: int, subindex: int, value: int) -> None:
        if self._setup.realtime:
            with SocketBus(self._channel) as bus:
                write_object(bus, self._setup.joint(joint).address, index, subindex, value)
        else:
            self._rack.servos[joint].write(index, subindex, value, self._rack.now_ns)


def _told_to_host(setup: RobotSetup) -> RobotSetup:
    """The robot as the host driver shall see it: no faults, and where our drives keep what other drives have not."""
    from frictid_drivers.cia402.settings import BUS_OPTIONS  # late, as above

    if problems := unknown_options(setup.options, BUS_OPTIONS, ("options",), "virtual"):
        raise InvalidFields(problems)
    options = {name: value for name, value in setup.options.items() if name != "faults"}
    fd = bool(options.get("fd"))
    joints = tuple(
        replace(joint, options=_objects(joint, fd=fd) | {k: v for k, v in joint.options.items() if k != "personality"})
        for joint in setup.joints
    )
    return replace(setup, options=options, joints=joints)


def _objects(joint: JointSetup, *, fd: bool) -> dict[str, Any]:
    known: dict[str, Any] = {"temperature_object": "2031:00 i16", "temperature_c_per_unit": 0.1}
    if fd:
        known["fd_object"] = "2023:00 u8"
    if "hand" in joint.simulated:
        known |= {"external_torque_object": "2030:00 i32", "external_torque_nm_per_unit": 0.001}
    return known


def write_object(bus: can.BusABC, node: int, index: int, subindex: int, value: int) -> None:
    """One expedited SDO download by a second member of the bus; ``HardwareError`` where refused, or without an answer.

    What a person's hand does to a joint, or a payload on it, is no part of a robot's control; it must not take the
    host's SDO client, nor wait for its cycle.
    """
    address = key(index, subindex)
    size = next(
        SIZE_BYTES[entry.kind] for record in OBJECTS if record.index == index for entry in record.entries
        if entry.key == address
    )  # fmt: skip
    header = bytes([0x23 | (4 - size) << 2, index & 0xFF, index >> 8, subindex])
    data = header + (value & 0xFFFFFFFF).to_bytes(4, "little")
    bus.send(can.Message(arbitration_id=0x600 + node, data=data, is_extended_id=False))
    deadline_s = time.monotonic() + _WRITE_S
    while (left_s := deadline_s - time.monotonic()) > 0:
        reply = bus.recv(left_s)
        if reply is not None and reply.arbitration_id == 0x580 + node and bytes(reply.data[1:4]) == header[1:]:
            if reply.data[0] == 0x60:
                return
            code = int.from_bytes(reply.data[4:8], "little")
            raise HardwareError(f"refused with {code:08X}h", where=f"node {node}, object {key_text(address)}")
    raise HardwareError("no answer", where=f"node {node}, object {key_text(address)}")
