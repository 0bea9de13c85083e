"""Simulated servos whose line, reports and power fail by a schedule; to the driver they are a port like any.

``options.faults`` of the robot file and ``FRICTID_VIRTUAL_FAULTS`` list what goes wrong, as for simulated CiA-402
drives (``frictid_drivers.virtual.faults`` has the table). ``frames`` is ``write`` (of the host, to all servos at once),
``request`` (to read, likewise) or ``report`` (what a servo answers). ``level`` is in radians or N m; speeds that servos
report are read by nobody. ``at_s`` counts from the first cycle.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import serial

from frictid_drivers.servos.simulated import Chain, Servo
from frictid_drivers.virtual.faults import FOREVER_S, FRAME_KINDS, QUANTITIES, REPORT_KINDS, Fault, faults_of
from frictid_drivers.virtual.wire_faults import FaultAtWork, Late, WrongFigure, spoil
from frictid_hil.plan.setup import RobotSetup

FRAMES = ("write", "request", "report")
SWITCHED = ("mute", "reset", "fault", "blocked")
HOST_KINDS = ("send_error", "receive_error", "stall")
KINDS = (*FRAME_KINDS, *(kind for kind in REPORT_KINDS if kind != "flap"), *HOST_KINDS, *SWITCHED)
_READS = (0x02, 0x82)
_ERRORS: Mapping[str, Callable[[], Exception]] = {
    "can": lambda: serial.SerialException("injected: the adapter refuses"),
    "os": lambda: OSError(5, "injected: input/output error"),
    "runtime": lambda: RuntimeError("injected: the adapter's library failed"),
    "value": lambda: ValueError("injected: the adapter's library saw a wrong value"),
}


def servo_faults(setup: RobotSetup) -> tuple[Fault, ...]:
    """The faults of a robot of simulated servos.

    Raises:
        InvalidFields: what is wrong with the robot file's.
        UsageError: the environment's are not JSON.
    """
    return faults_of(setup, kinds=KINDS, frames=FRAMES)


class FaultyChain:
    """As ``frictid_drivers.servos.line.BytePort``.

    Args:
        chain: the servos.
        faults: what goes wrong.
        stand_still: lets so many seconds pass.
    """

    def __init__(self, chain: Chain, faults: Sequence[Fault], stand_still: Callable[[float], None]) -> None:
        self._chain, self._faults, self._stand_still = chain, tuple(faults), stand_still
        self._at_work = {
            kind: [FaultAtWork(fault) for fault in faults if fault.kind == kind] for kind in (*FRAME_KINDS, *HOST_KINDS)
        }
        self._late, self._arrived = Late(), bytearray()
        self._now_ns, self._start_ns = 0, -1
        chain.fault = self._answered
        for fault in faults:
            if fault.kind in REPORT_KINDS:
                for name in fault.joints:
                    self._spoil_reports(chain.servos[name], fault)

    def begin(self) -> None:
        """The first cycle: times of faults count from here."""
        self._start_ns = self._now_ns
        for fault in self._faults:
            for name in fault.joints if fault.kind in SWITCHED else ():
                begin_ns = self._start_ns + round(fault.begin_s * 1e9)
                self._late.put(begin_ns, partial(self._switch, fault.kind, name, True))
                if fault.for_s < FOREVER_S:
                    end_ns = self._start_ns + round((fault.begin_s + fault.for_s) * 1e9)
                    self._late.put(end_ns, partial(self._switch, fault.kind, name, False))
        self._late.run(self._now_ns)

    def advance(self, to_ns: int) -> None:
        """Run time goes on."""
        while self._late.next_ns <= to_ns:
            self._now_ns = round(max(self._now_ns, self._late.next_ns))
            self._chain.advance(self._now_ns)
            self._late.run(self._now_ns)
        self._now_ns = to_ns
        self._chain.advance(to_ns)

    def write(self, data: bytes) -> None:
        """The host's packet."""
        self._fail("send_error")
        for stall in self._at_work["stall"]:
            if stall.strikes(self._elapsed_ns()):
                self._stand_still(stall.fault.delay_s)
        code = next((packet.instruction for packet in self._chain.wire.parse(bytearray(data), answers=False)), 0)
        service = "request" if code in _READS else "write"
        for due_ns, _, out in self._spoilt(service, "", 0, data):
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

    # -- packets -------------------------------------------------------------------------------------------------------

    def _answered(self, packet: bytes, to_host: bool) -> bytes:
        """What is on the line of an answer at once; what is late comes by itself."""
        if not to_host:
            return packet
        (answer,) = self._chain.wire.parse(bytearray(packet), answers=True)
        joint = next(name for name, servo in self._chain.servos.items() if servo.mine.id == answer.id)
        at_once = b""
        for due_ns, servo, out in self._spoilt("report", joint, answer.id, packet):
            out = out if servo == answer.id else self._chain.wire.answer(servo, answer.error, answer.data)
            if due_ns <= self._now_ns:
                at_once += out
            else:
                self._at(due_ns, partial(self._arrived.extend, out))
        return at_once

    def _spoilt(self, service: str, joint: str, servo: int, packet: bytes) -> list[tuple[int, int, bytes]]:
        packets = [(self._now_ns, servo, packet)]
        for kind in FRAME_KINDS:
            for state in self._at_work[kind]:
                if state.fault.frames == service and (not joint or joint in state.fault.joints):
                    packets = [out for one in packets for out in spoil(state, self._elapsed_ns(), one)]
        return packets

    def _at(self, due_ns: int, deliver: Callable[[], None]) -> None:
        if due_ns <= self._now_ns:
            deliver()
        else:
            self._late.put(due_ns, deliver)

    def _fail(self, kind: str) -> None:
        for work in self._at_work[kind]:
            if work.strikes(self._elapsed_ns()):
                raise _ERRORS[work.fault.error]()

    def _elapsed_ns(self) -> int:
        return -1 if self._start_ns < 0 else self._now_ns - self._start_ns

    # -- servos --------------------------------------------------------------------------------------------------------

    def _spoil_reports(self, servo: Servo, fault: Fault) -> None:
        wrong, before = WrongFigure(fault), servo.told

        def told(quantity: str) -> float:
            value = before(quantity)
            if QUANTITIES[quantity] != fault.quantity:
                return value
            return wrong.applied(servo.mine.id, self._now_ns, self._elapsed_ns(), value)

        servo.told = told  # type: ignore[method-assign]  # what it says from now on

    def _switch(self, kind: str, joint: str, on: bool) -> None:
        servo = self._chain.servos[joint]
        if kind == "mute":
            self._chain.connect(joint, not on)
        elif kind == "blocked":
            servo.plant.brake(on)
        elif on:
            (servo.fail if kind == "fault" else servo.reboot)()
