"""What simulated devices share, whatever wire they are on: a plant with a loop of its own, and faults by schedule."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import ClassVar

from frictid_drivers.virtual.faults import FOREVER_S, FRAME_KINDS, QUANTITIES, REPORT_KINDS, Fault
from frictid_drivers.virtual.wire_faults import FaultAtWork, Late, Passed, WrongFigure, spoil
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.servo_loop import ServoLoop

CONTROL_PERIOD_S = 0.001  # of the inner loops that a simulated drive closes
_LOOP_NS = 500_000
LOOP_S = _LOOP_NS * 1e-9
_TORQUE_MODE = 10


def plant_for(robot: RobotSetup, joint: JointSetup, period_s: float = CONTROL_PERIOD_S) -> ServoLoop:
    """The simulated joint under inner loops, where the robot file locks it, its noise by the robot's seed.

    ``InvalidFields`` where the joint's ``simulated`` mapping is wrong.
    """
    return ServoLoop(
        JointModel.of(joint, joint.name),
        period_s=period_s,
        seed=zlib.crc32(f"{robot.seed}/{robot.name}/{joint.name}".encode()),
        position_rad=joint.locked_position_rad,
    )


def without_faults(setup: RobotSetup) -> RobotSetup:
    """The robot as its driver is told of it."""
    return replace(setup, options={name: value for name, value in setup.options.items() if name != "faults"})


class Device:
    """A joint that answers commands and closes its own loop."""

    def __init__(self, joint: JointSetup, setup: RobotSetup) -> None:
        self.id = joint.address  # on the wire
        self.plant = plant_for(setup, joint, LOOP_S)
        self.plant.set_mode(_TORQUE_MODE)
        self.plant.brake(False)
        self.on = False  # under power
        self._now_ns = self._heard_ns = 0

    def heard(self) -> None:
        """Somebody talks to it."""
        self._heard_ns = self._now_ns

    def told(self, quantity: str) -> float:
        """``position``, ``velocity`` or ``torque`` as its reports say."""
        raise NotImplementedError

    def advance(self, to_ns: int) -> None:
        """Its own loop, period by period."""
        while self._now_ns + _LOOP_NS <= to_ns:
            self._watch_host()
            self.plant.advance(LOOP_S, torque_nm=self._asked_nm() if self.on else 0.0)
            self._now_ns += _LOOP_NS

    def _watch_host(self) -> None:
        """Let go where nobody was heard for too long."""
        raise NotImplementedError

    def _asked_nm(self) -> float:
        raise NotImplementedError


class FaultSchedule:
    """Faults in run time; their times count from ``begin``."""

    SWITCHED: ClassVar[tuple[str, ...]] = ("mute", "reset", "fault", "blocked")
    """Kinds that come and go in the devices themselves."""

    def __init__(self, faults: Sequence[Fault]) -> None:
        self._faults, self._late = tuple(faults), Late()
        self._now_ns = 0
        self._start_ns: int | None = None

    @property
    def now_ns(self) -> int:
        """Run time."""
        return self._now_ns

    def begin(self) -> None:
        """The first cycle."""
        self._start_ns = self.now_ns
        for fault in self._faults:
            for joint in fault.joints if fault.kind in self.SWITCHED else ():
                begin_ns = self._start_ns + round(fault.begin_s * 1e9)
                self._late.put(begin_ns, partial(self._switch, fault, joint, True))
                if fault.for_s < FOREVER_S:
                    end_ns = self._start_ns + round((fault.begin_s + fault.for_s) * 1e9)
                    self._late.put(end_ns, partial(self._switch, fault, joint, False))
        self._late.run(self.now_ns)

    def advance(self, to_ns: int) -> None:
        """Let run time go on."""
        while self._late.next_ns <= to_ns:
            self._advance_devices(round(self._late.next_ns))
            self._late.run(self.now_ns)
        self._advance_devices(to_ns)

    def _switch(self, fault: Fault, joint: str, on: bool) -> None:
        """Turn a fault of a device on and off."""
        raise NotImplementedError

    def _advance_devices(self, to_ns: int) -> None:
        raise NotImplementedError

    def _at(self, due_ns: int, action: Callable[[], None]) -> None:
        """Now where it is due, else later."""
        if due_ns <= self.now_ns:
            action()
        else:
            self._late.put(due_ns, action)

    def _elapsed_ns(self) -> int:
        return -1 if self._start_ns is None else self.now_ns - self._start_ns


DEVICE_KINDS = (*FRAME_KINDS, *(kind for kind in REPORT_KINDS if kind != "flap"), *FaultSchedule.SWITCHED)
"""Faults of devices without a statusword."""


class DeviceFaults(FaultSchedule):
    """Faults of devices, which are given by joint and go on by ``advance``."""

    def __init__(self, faults: Sequence[Fault], devices: Mapping[str, Device], advance: Callable[[int], None]) -> None:
        super().__init__(faults)
        self._devices, self._advance = devices, advance
        self._frame_faults = [FaultAtWork(fault) for fault in faults if fault.kind in FRAME_KINDS]
        for fault in faults:
            for joint in fault.joints if fault.kind in REPORT_KINDS else ():
                self._spoil_reports(devices[joint], fault)

    def _advance_devices(self, to_ns: int) -> None:
        self._now_ns = to_ns
        self._advance(to_ns)

    def _spoilt(self, frames: str, joint: str, number: int, data: bytes) -> list[Passed]:
        """What becomes of a frame to or from the device of a joint; joint "": to all of them."""
        passed = [(self._now_ns, number, data)]
        for state in self._frame_faults:
            if state.fault.frames == frames and (not joint or joint in state.fault.joints):
                passed = [out for one in passed for out in spoil(state, self._elapsed_ns(), one)]
        return passed

    def _spoil_reports(self, device: Device, fault: Fault) -> None:
        wrong, before = WrongFigure(fault), device.told

        def told(quantity: str) -> float:
            value = before(quantity)
            if QUANTITIES[quantity] != fault.quantity:
                return value
            return wrong.applied(device.id, self._now_ns, self._elapsed_ns(), value)

        device.told = told  # type: ignore[method-assign]  # what it says from now on
