"""A rack whose wire and drives fail by a schedule; to the bus it looks like any rack."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

from frictid_drivers.virtual.devices import FaultSchedule
from frictid_drivers.virtual.faults import Fault
from frictid_drivers.virtual.rack import Rack, Transmit
from frictid_drivers.virtual.wire_faults import SYNC_ID, WireFaults


class FaultyRack(FaultSchedule):
    """See ``Rack`` for what its members mean."""

    SWITCHED = (*FaultSchedule.SWITCHED, "emcy", "stuck_encoder", "interlock_open")

    def __init__(self, rack: Rack, faults: Sequence[Fault]) -> None:
        super().__init__(faults)
        self.transmit: Transmit = lambda can_id, data: None  # no bus yet
        self._rack = rack
        self._frames = WireFaults(faults)
        self._muted: set[int] = set()
        self._pace = math.prod(fault.factor for fault in faults if fault.kind == "drift")
        self._host_ns, self._drives_ns = 0, 0
        rack.transmit = self._from_drives

    @property
    def now_ns(self) -> int:
        """Run time of the host."""
        return self._host_ns + round((self._rack.now_ns - self._drives_ns) / self._pace)

    @property
    def next_event_ns(self) -> int:
        """When something falls due by itself."""
        drives_ns = self._host_ns + (self._rack.next_event_ns - self._drives_ns) / self._pace
        return round(min(drives_ns, self._late.next_ns))

    def power_on(self) -> None:
        """All drives boot."""
        self._rack.power_on()

    def process(self, can_id: int, data: bytes, *, remote: bool = False) -> None:
        """A frame of the host."""
        if can_id == SYNC_ID and self._start_ns is None:
            self.begin()
        if can_id not in self._frames.cob_ids:
            self._to_drives(can_id, data, remote)
            return
        passed = self._frames.through(self.now_ns, self._elapsed_ns(), can_id, data)
        for number, (due_ns, out_id, out) in enumerate(passed):
            self._at(due_ns, partial(self._to_drives, out_id, out, remote))
            if number and out_id in self._frames.foreign:
                # Whoever sent it, the host hears it as well as the drives.
                self._at(due_ns, partial(self._to_host, out_id, out))

    def _advance_devices(self, to_ns: int) -> None:
        drives_ns = self._drives_ns + round((to_ns - self._host_ns) * self._pace)
        self._rack.advance(drives_ns)
        if self._pace != 1.0 and to_ns > self._host_ns:
            self._host_ns, self._drives_ns = to_ns, drives_ns

    def _to_drives(self, can_id: int, data: bytes, remote: bool) -> None:
        if not self._muted:
            self._rack.process(can_id, data, remote=remote)
            return
        for servo in self._rack.servos.values():
            if servo.node_id not in self._muted:
                if can_id == 0x000:
                    servo.receive_nmt(data, self.now_ns)
                elif remote:
                    servo.receive_remote(can_id, self.now_ns)
                elif (handler := servo.routes().get(can_id)) is not None:
                    handler(data, self.now_ns)

    def _from_drives(self, can_id: int, data: bytes) -> None:
        if can_id & 0x7F in self._muted:
            return
        if can_id not in self._frames.cob_ids:
            self._to_host(can_id, data)
            return
        for due_ns, out_id, out in self._frames.through(self.now_ns, self._elapsed_ns(), can_id, data):
            self._at(due_ns, partial(self._to_host, out_id, out))

    def _to_host(self, can_id: int, data: bytes) -> None:
        self.transmit(can_id, data)

    def _switch(self, fault: Fault, joint: str, on: bool) -> None:
        servo = self._rack.servos[joint]
        match fault.kind:
            case "mute":
                (self._muted.add if on else self._muted.discard)(servo.node_id)
            case "stuck_encoder":
                servo.axis.encoder_stuck = on
            case "blocked":
                servo.block_brake(on, self.now_ns)
            case "interlock_open":
                servo.power.interlock_closed = not on
            case "reset" if on:
                servo.boot(self.now_ns)
            case "fault" if on:
                servo.fail(fault.code, self.now_ns)
            case "emcy" if on:
                for _ in range(fault.times):
                    servo.warn(fault.code, self.now_ns)


def leave_in_fault(rack: Rack, faults: Sequence[Fault]) -> None:
    """Drives as an earlier run left them, right after power-on."""
    for fault in faults:
        if fault.kind == "left_in_fault":
            for joint in fault.joints:
                rack.servos[joint].fail(fault.code, rack.now_ns)
