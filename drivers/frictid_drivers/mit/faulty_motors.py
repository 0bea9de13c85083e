"""Simulated motors whose wire, reports and power fail by a schedule; to the bus they look like any rack.

``options.faults`` of the robot file and ``FRICTID_VIRTUAL_FAULTS`` list what goes wrong, as for simulated CiA-402
drives (``frictid_drivers.virtual.faults`` has the table); ``frames`` is ``command`` or ``report``, ``level`` is in
radians, rad/s or N m, and ``at_s`` counts from the first cycle.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING

from frictid_drivers.virtual.devices import DEVICE_KINDS, DeviceFaults
from frictid_drivers.virtual.faults import HOST_KINDS, Fault
from frictid_hil.testing.wire import Frame

if TYPE_CHECKING:
    from frictid_drivers.mit.simulated import Rack

FRAMES = ("command", "report")
KINDS = (*DEVICE_KINDS, *HOST_KINDS)
_FAULT = 0xA


class FaultyMotors(DeviceFaults):
    """As ``frictid_hil.testing.wire.Devices``."""

    def __init__(self, rack: Rack, faults: Sequence[Fault]) -> None:
        super().__init__(faults, rack.actuators, rack.advance)
        self._rack, self._answers = rack, list[Frame]()
        self._muted: set[str] = set()

    def receive(self, can_id: int, data: bytes) -> Iterable[Frame]:
        """A frame of the host; what comes back now, and what was late and has come meanwhile."""
        joint = self._rack.meant(can_id, data)
        if joint is not None and joint not in self._muted:
            for due_ns, out_id, out in self._spoilt("command", joint, can_id, data):
                self._at(due_ns, partial(self._to_motor, joint, out_id, out))
        answers = list(self._answers)
        self._answers.clear()
        return answers

    def _to_motor(self, joint: str, can_id: int, data: bytes) -> None:
        for answer in self._rack.receive(can_id, data):
            for due_ns, out_id, out in self._spoilt("report", joint, *answer) if joint not in self._muted else ():
                self._at(due_ns, partial(self._answers.append, (out_id, out)))

    def _switch(self, fault: Fault, joint: str, on: bool) -> None:
        motor = self._rack.actuators[joint]
        match fault.kind:
            case "mute":
                (self._muted.add if on else self._muted.discard)(joint)
            case "blocked":
                motor.plant.brake(on)
            case "reset" if on:
                motor.fault, motor.timeout_ns = 0, 0
                motor.switch(False)
            case "fault" if on:
                motor.fault = _FAULT
                motor.switch(False)
