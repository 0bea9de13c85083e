"""Simulated servos whose line, reports and power fail by a schedule; to the driver they are a port like any.

``options.faults`` of the robot file and ``FRICTID_VIRTUAL_FAULTS`` list what goes wrong, as for simulated CiA-402
drives (``frictid_drivers.virtual.faults`` has the table). ``frames`` is ``write`` (of the host, to all servos at once),
``request`` (to read, likewise) or ``report`` (what a servo answers). ``level`` is in radians or N m; speeds that servos
report are read by nobody. ``at_s`` counts from the first cycle.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import serial

from frictid_drivers.servos.packets import READ, SYNC_READ
from frictid_drivers.virtual.devices import DEVICE_KINDS, DeviceFaults
from frictid_drivers.virtual.faults import FRAME_KINDS, Fault
from frictid_drivers.virtual.wire_faults import FaultAtWork

if TYPE_CHECKING:
    from frictid_drivers.servos.simulated import Chain

FRAMES = ("write", "request", "report")
HOST_KINDS = ("send_error", "receive_error", "stall")
KINDS = (*DEVICE_KINDS, *HOST_KINDS)
_ERRORS: Mapping[str, Callable[[], Exception]] = {
    "can": lambda: serial.SerialException("injected: the adapter refuses"),
    "os": lambda: OSError(5, "injected: input/output error"),
    "runtime": lambda: RuntimeError("injected: the adapter's library failed"),
    "value": lambda: ValueError("injected: the adapter's library saw a wrong value"),
}


class FaultyChain(DeviceFaults):
    """As ``frictid_drivers.servos.line.BytePort``."""

    def __init__(self, chain: Chain, faults: Sequence[Fault]) -> None:
        super().__init__(faults, chain.servos, chain.advance)
        self._frame_faults.sort(key=lambda state: FRAME_KINDS.index(state.fault.kind))
        self._host = {kind: [FaultAtWork(fault) for fault in faults if fault.kind == kind] for kind in HOST_KINDS}
        self._chain, self._arrived = chain, bytearray()
        chain.fault = self._answered

    def write(self, data: bytes) -> None:
        """The host's packet."""
        self._fail("send_error")
        for stall in self._host["stall"]:
            if stall.strikes(self._elapsed_ns()):
                clock = self._chain.clock
                clock.wait_until(clock.now_ns() + round(stall.fault.delay_s * 1e9))
        code = next((packet.instruction for packet in self._chain.wire.parse(bytearray(data), answers=False)), 0)
        for due_ns, _, out in self._spoilt("request" if code in (READ, SYNC_READ) else "write", "", 0, data):
            self._at(due_ns, partial(self._chain.write, out))

    def read(self, timeout_s: float) -> bytes:
        """Answers to the host."""
        self._fail("receive_error")
        if not self._chain.clock.lock_step:
            self.advance(self._chain.clock.now_ns())
        arrived, self._arrived = bytes(self._arrived), bytearray()
        return arrived + self._chain.read(0.0 if arrived else timeout_s)

    def close(self) -> None:
        """The host is gone."""
        self._chain.close()

    def _answered(self, packet: bytes, to_host: bool) -> bytes:
        """What is on the line of an answer at once; what is late comes by itself."""
        if not to_host:
            return packet
        (answer,) = self._chain.wire.parse(bytearray(packet), answers=True)
        joint = next(name for name, servo in self._chain.servos.items() if servo.id == answer.id)
        at_once = bytearray()
        for due_ns, servo, out in self._spoilt("report", joint, answer.id, packet):
            out = out if servo == answer.id else self._chain.wire.answer(servo, answer.error, answer.data)
            self._at(due_ns, partial((at_once if due_ns <= self._now_ns else self._arrived).extend, out))
        return bytes(at_once)

    def _fail(self, kind: str) -> None:
        for work in self._host[kind]:
            if work.strikes(self._elapsed_ns()):
                raise _ERRORS[work.fault.error]()

    def _switch(self, fault: Fault, joint: str, on: bool) -> None:
        servo = self._chain.servos[joint]
        match fault.kind:
            case "mute":
                self._chain.connect(joint, not on)
            case "blocked":
                servo.plant.brake(on)
            case "reset" if on:
                servo.reboot()
            case "fault" if on:
                servo.fail()
