"""Simulated motors whose wire, reports and power fail by a schedule; to the bus they look like any rack.

``options.faults`` of the robot file and ``FRICTID_VIRTUAL_FAULTS`` list what goes wrong, as for simulated CiA-402
drives (``frictid_drivers.virtual.faults`` has the table); ``frames`` is ``command`` or ``report``, ``level`` is in
radians, rad/s or N m, and ``at_s`` counts from the first cycle.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from frictid_drivers.mit.simulated import Actuator, Rack
from frictid_drivers.virtual.faults import (
    FOREVER_S,
    FRAME_KINDS,
    HOST_KINDS,
    QUANTITIES,
    REPORT_KINDS,
    Fault,
    faults_of,
)
from frictid_drivers.virtual.wire_faults import FaultAtWork, Late, WrongFigure, spoil
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.testing.wire import Frame

FRAMES = ("command", "report")
SWITCHED = ("mute", "reset", "fault", "blocked")
KINDS = (*FRAME_KINDS, *(kind for kind in REPORT_KINDS if kind != "flap"), *HOST_KINDS, *SWITCHED)
_FAULT = 0xA


def motor_faults(setup: RobotSetup) -> tuple[Fault, ...]:
    """The faults of a robot of simulated motors.

    Raises:
        InvalidFields: what is wrong with the robot file's.
        UsageError: the environment's are not JSON.
    """
    return faults_of(setup, kinds=KINDS, frames=FRAMES)


class FaultyMotors:
    """As ``frictid_hil.testing.wire.Devices``.

    Args:
        rack: the motors.
        faults: what goes wrong.
    """

    def __init__(self, rack: Rack, faults: Sequence[Fault]) -> None:
        self._rack = rack
        self._faults = tuple(faults)
        self._at_work = {
            name: [FaultAtWork(fault) for fault in faults if fault.kind in FRAME_KINDS and fault.frames == name]
            for name in FRAMES
        }
        self._late, self._answers = Late(), list[Frame]()
        self._now_ns, self._start_ns = 0, -1
        self._muted: set[str] = set()
        for fault in faults:
            if fault.kind in REPORT_KINDS:
                for name in fault.joints:
                    self._spoil_reports(rack.actuators[name], fault)

    def begin(self) -> None:
        """The first cycle: times of faults count from here."""
        self._start_ns = self._now_ns
        for fault in self._faults:
            for name in fault.joints if fault.kind in SWITCHED else ():
                switch = self._switch(fault, name)
                self._late.put(self._start_ns + round(fault.begin_s * 1e9), _call(switch, True))
                if fault.for_s < FOREVER_S:
                    self._late.put(self._start_ns + round((fault.begin_s + fault.for_s) * 1e9), _call(switch, False))
        self._late.run(self._now_ns)

    def receive(self, can_id: int, data: bytes) -> Iterable[Frame]:
        """A frame of the host; what comes back now, and what was late and has come meanwhile."""
        joint = self._rack.meant(can_id, data)
        if joint is not None and joint not in self._muted:
            self._pass("command", joint, (can_id, data), lambda frame: self._to_motor(joint, frame))
        answers, self._answers = self._answers, []
        return answers

    def advance(self, to_ns: int) -> None:
        """Run time goes on."""
        while self._late.next_ns <= to_ns:
            self._now_ns = round(max(self._now_ns, self._late.next_ns))
            self._rack.advance(self._now_ns)
            self._late.run(self._now_ns)
        self._now_ns = to_ns
        self._rack.advance(to_ns)

    # -- frames --------------------------------------------------------------------------------------------------------

    def _to_motor(self, joint: str, frame: Frame) -> None:
        for answer in self._rack.receive(*frame):
            if joint not in self._muted:
                self._pass("report", joint, answer, self._answers_append)

    def _answers_append(self, frame: Frame) -> None:
        self._answers.append(frame)

    def _pass(self, service: str, joint: str, frame: Frame, deliver: Callable[[Frame], None]) -> None:
        frames = [(self._now_ns, *frame)]
        for state in self._at_work[service]:
            if joint in state.fault.joints:
                frames = [out for one in frames for out in spoil(state, self._elapsed_ns(), one)]
        for due_ns, can_id, data in frames:
            if due_ns <= self._now_ns:
                deliver((can_id, data))
            else:
                self._late.put(due_ns, _delivery(deliver, (can_id, data)))

    def _elapsed_ns(self) -> int:
        return -1 if self._start_ns < 0 else self._now_ns - self._start_ns

    # -- motors --------------------------------------------------------------------------------------------------------

    def _spoil_reports(self, motor: Actuator, fault: Fault) -> None:
        wrong, before = WrongFigure(fault), motor.told

        def told(quantity: str) -> float:
            value = before(quantity)
            if QUANTITIES[quantity] != fault.quantity:
                return value
            return wrong.applied(motor.id, self._now_ns, self._elapsed_ns(), value)

        motor.told = told  # type: ignore[method-assign]  # what it says from now on

    def _switch(self, fault: Fault, joint: str) -> Callable[[bool], None]:
        motor = self._rack.actuators[joint]

        def mute(on: bool) -> None:
            (self._muted.add if on else self._muted.discard)(joint)

        def reset(on: bool) -> None:
            if on:
                motor.fault, motor.timeout_ns = 0, 0
                motor.switch(False)

        def fail(on: bool) -> None:
            if on:
                motor.fault = _FAULT
                motor.switch(False)

        def block(on: bool) -> None:
            motor.plant.brake(on)

        return {"mute": mute, "reset": reset, "fault": fail, "blocked": block}[fault.kind]


def _call(switch: Callable[[bool], None], on: bool) -> Callable[[], None]:
    return lambda: switch(on)


def _delivery(deliver: Callable[[Frame], None], frame: Frame) -> Callable[[], None]:
    return lambda: deliver(frame)
