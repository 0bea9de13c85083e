"""The power stage of a drive: CiA 402's state machine at work on one axis - ramps, halt, faults, brake, statusword."""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum
from typing import cast

from frictid_drivers.virtual import emergency
from frictid_drivers.virtual.axis import CSP, IP, MODES, Axis
from frictid_drivers.virtual.emergency import Emergency
from frictid_drivers.virtual.object_dictionary import ObjectDictionary
from frictid_drivers.virtual.objects import Key, key
from frictid_hil.simulation.servo_loop import ServoLoop

_K6040, _K6041, _K6060, _K6061 = key(0x6040), key(0x6041), key(0x6060), key(0x6061)
_K6072, _K60FD, _K60FE, _K60FE_MASK = key(0x6072), key(0x60FD), key(0x60FE, 1), key(0x60FE, 2)
_K6064, _K607A, _K60C1 = key(0x6064), key(0x607A), key(0x60C1, 1)
_INTERLOCK_CLOSED = 1 << 3
_INTERPOLATE = 1 << 4
_BRAKE_ENGAGED = 1 << 16
_OUTPUT_BRAKE = 1 << 0

_DECELERATIONS = {1: key(0x6084), 2: key(0x6085)}


class PowerState(Enum):
    """States; the value is the statusword's state bits (0-3, 5, 6)."""

    NOT_READY = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY = 0x21
    SWITCHED_ON = 0x23
    ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION = 0x0F
    FAULT = 0x08


class Command(Enum):
    """What a controlword asks for."""

    SHUTDOWN = "shutdown"
    SWITCH_ON = "switch on"
    ENABLE = "enable operation"
    DISABLE_VOLTAGE = "disable voltage"
    QUICK_STOP = "quick stop"


FAULT_RESET = 1 << 7
HALT = 1 << 8


def command_of(controlword: int) -> Command:
    """The command in bits 0-3; bit 7 is looked at by its edge, elsewhere."""
    if not controlword & 0x02:
        return Command.DISABLE_VOLTAGE
    if not controlword & 0x04:
        return Command.QUICK_STOP
    if not controlword & 0x01:
        return Command.SHUTDOWN
    return Command.ENABLE if controlword & 0x08 else Command.SWITCH_ON


_S, _C = PowerState, Command
TRANSITIONS: dict[tuple[PowerState, Command], tuple[int, PowerState]] = {
    (_S.SWITCH_ON_DISABLED, _C.SHUTDOWN): (2, _S.READY),
    (_S.READY, _C.SWITCH_ON): (3, _S.SWITCHED_ON),
    # "Enable operation" in READY passes through SWITCHED ON by itself: 3, and then 4 by the same controlword.
    (_S.READY, _C.ENABLE): (3, _S.SWITCHED_ON),
    (_S.SWITCHED_ON, _C.ENABLE): (4, _S.ENABLED),
    (_S.ENABLED, _C.SWITCH_ON): (5, _S.SWITCHED_ON),
    (_S.SWITCHED_ON, _C.SHUTDOWN): (6, _S.READY),
    (_S.READY, _C.DISABLE_VOLTAGE): (7, _S.SWITCH_ON_DISABLED),
    (_S.READY, _C.QUICK_STOP): (7, _S.SWITCH_ON_DISABLED),
    (_S.ENABLED, _C.SHUTDOWN): (8, _S.READY),
    (_S.ENABLED, _C.DISABLE_VOLTAGE): (9, _S.SWITCH_ON_DISABLED),
    (_S.SWITCHED_ON, _C.DISABLE_VOLTAGE): (10, _S.SWITCH_ON_DISABLED),
    (_S.SWITCHED_ON, _C.QUICK_STOP): (10, _S.SWITCH_ON_DISABLED),
    (_S.ENABLED, _C.QUICK_STOP): (11, _S.QUICK_STOP_ACTIVE),
    (_S.QUICK_STOP_ACTIVE, _C.DISABLE_VOLTAGE): (12, _S.SWITCH_ON_DISABLED),
    (_S.QUICK_STOP_ACTIVE, _C.ENABLE): (16, _S.ENABLED),
}
"""Transitions that a controlword can ask for. 0 and 1 happen at power-on, 13 and 14 by a fault, 15 by bit 7's edge."""


def next_state(state: PowerState, controlword: int) -> tuple[int, PowerState] | None:
    """The transition a controlword asks for in a state: (number, target), or None to stay."""
    return TRANSITIONS.get((state, command_of(controlword)))


class PowerStage:
    """One power stage."""

    def __init__(
        self,
        dictionary: ObjectDictionary,
        axis: Axis,
        plant: ServoLoop,
        errors: Emergency,
        host_missing: Callable[[], bool],  # asked before power is given: a watched heartbeat is missing
    ) -> None:
        self._manner = dictionary.manner
        self._due_ns: dict[str, int] = {}  # when the mode shows, and power comes on, in families that take their time
        self._values = cast("dict[Key, int]", dictionary.values)
        self._axis = axis
        self._plant = plant
        self._errors = errors
        self._host_missing = host_missing
        self.state = PowerState.NOT_READY
        self.interlock_closed = True  # bit 3 of the digital inputs
        self.changed = False  # something that event-driven PDOs may carry changed; the node clears it
        self._after_ramp: PowerState | None = None
        self._halted = False
        self._controlword = 0
        self._outputs = 0
        self._brake_blocked = False
        plant.power(False)
        plant.brake(True)

    def boot(self) -> None:
        """Transitions 0 and 1: power-on, without motor power; the objects have their defaults again."""
        self._power(False)
        self._due_ns.clear()
        self._controlword = 0
        self._outputs = 0
        self._axis.encoder_stuck = False
        self._axis.mode = 0
        self._axis.units_changed()
        self.state = PowerState.SWITCH_ON_DISABLED

    def run_to(self, now_ns: int) -> None:
        """Let the motor run to now; faults and ends of ramps act."""
        axis = self._axis
        axis.catch_up(now_ns)
        if axis.alarm:
            code, axis.alarm = axis.alarm, 0
            self.fault(code)
        if axis.ramping and axis.ramp_done:
            self._ramp_ended()
        if axis.now_ns >= self._due_ns.get("mode", math.inf):
            self.follow_commands()
        if axis.now_ns >= self._due_ns.get("power", math.inf):
            self._follow_controlword(self._values[_K6040])

    def fault(self, code: int) -> None:
        """Transition 13: something is wrong; the fault reaction (605Eh) runs where the motor has power."""
        self.changed = True
        self._errors.report(code)
        if self.state in (PowerState.FAULT, PowerState.FAULT_REACTION):
            return
        option = self._values[key(0x605E)]
        if option and self._axis.powered:
            self.state = PowerState.FAULT_REACTION
            self._after_ramp = PowerState.FAULT
            self._ramp(option)
        else:
            self._power(False)
            self.state = PowerState.FAULT

    def follow_commands(self) -> None:
        """Controlword, mode, outputs or set-points may have been written; physics has caught up."""
        values = self._values
        controlword = values[_K6040]
        if controlword != self._controlword:
            self._follow_controlword(controlword)
        mode = values[_K6060]
        if mode != values[_K6061] and (mode in MODES or mode == 0) and self._is_due("mode"):
            values[_K6061] = mode
            self.changed = True
            self._axis.set_mode(CSP if mode == IP else mode)
        if mode == IP:
            # Interpolated position is cyclic position by another object, followed while bit 4 says so.
            follow = controlword & _INTERPOLATE and self.state is PowerState.ENABLED
            values[_K607A] = values[_K60C1] if follow else values[_K6064]
        if values[_K60FE] != self._outputs:
            self._outputs = values[_K60FE]
            self.apply_brake()
        if values[_K6072] != self._axis.max_torque_per_mille:
            self._axis.units_changed()
        self._axis.take_set_points()

    def _follow_controlword(self, controlword: int) -> None:
        rising = controlword & ~self._controlword
        self._controlword = controlword
        self.changed = True
        if rising & FAULT_RESET:
            self._reset_fault()
        before = None
        while self.state is not before and (step := next_state(self.state, controlword)) is not None:
            before = self.state
            if self._may(step[0]):
                self._take(*step)
        if self.state is PowerState.ENABLED and self._after_ramp is None:
            self._follow_halt(bool(controlword & HALT))

    def _is_due(self, what: str) -> bool:
        """As long after it was first asked for as this family takes; asked again, it begins anew."""
        takes_s = self._manner.mode_change_s if what == "mode" else self._manner.power_on_s
        due_ns = self._due_ns.setdefault(what, self._axis.now_ns + round(takes_s * 1e9))
        if self._axis.now_ns >= due_ns:
            del self._due_ns[what]
        return what not in self._due_ns

    def _may(self, transition: int) -> bool:
        if transition == 4 and self._manner.power_on_s and not self._is_due("power"):
            return False
        if transition in (4, 16) and self._host_missing():
            return False  # no power while the host's heartbeat is missing
        return transition != 16 or self._values[key(0x605A)] in (5, 6, 7)

    def _take(self, transition: int, target: PowerState) -> None:
        if transition in (5, 8):
            # Leaving "enabled" in good order; the option says whether a ramp comes first.
            option = self._values[key(0x605C if transition == 5 else 0x605B)]
            if option and not self._axis.at_rest:
                self._after_ramp = target
                self._ramp(1)
                return
            self._go(target)
        elif transition == 11:
            self.quick_stop()
        elif transition == 4:
            self.state = target
            self._power(True)
        elif transition == 16:
            self.state = target
            self._after_ramp = None
            self._axis.resume()
        else:
            self._go(target)

    def _go(self, target: PowerState) -> None:
        """Enter a state without motor power."""
        self.changed = True
        if self._axis.powered:
            self._power(False)
        self.state = target

    def disable_voltage(self) -> None:
        """Take the power away, from whatever state has it."""
        if self._axis.powered:
            self._go(PowerState.SWITCH_ON_DISABLED)

    def quick_stop(self) -> None:
        """605Ah: decelerate, then hold or switch off."""
        self.changed = True
        option = self._values[key(0x605A)]
        if option == 0:
            self._go(PowerState.SWITCH_ON_DISABLED)
            return
        self.state = PowerState.QUICK_STOP_ACTIVE
        self._after_ramp = PowerState.SWITCH_ON_DISABLED if option < 5 else PowerState.QUICK_STOP_ACTIVE
        self._ramp(option if option < 5 else option - 4)

    def _ramp(self, option: int) -> None:
        """1: profile deceleration, 2: quick-stop deceleration, 3 and 4: as fast as the torque limit lets."""
        self._halted = False
        deceleration = _DECELERATIONS.get(option)
        self._axis.start_ramp(None if deceleration is None else self._values[deceleration])

    def _ramp_ended(self) -> None:
        self._axis.end_ramp()
        self.changed = True
        target, self._after_ramp = self._after_ramp, None
        if target in (None, PowerState.QUICK_STOP_ACTIVE):
            return  # halted, or held in quick-stop-active
        self._go(target)
        if target is PowerState.SWITCHED_ON or target is PowerState.READY:
            # What the controlword asked for meanwhile.
            self._controlword = ~self._values[_K6040] & FAULT_RESET
            self._follow_controlword(self._values[_K6040])

    def _follow_halt(self, halt: bool) -> None:
        if halt and not self._halted:
            self._ramp(self._values[key(0x605D)])
            self._halted = True
        elif not halt and self._halted:
            self._halted = False
            self._axis.resume()

    def _reset_fault(self) -> None:
        """Transition 15; in other states warnings are forgotten."""
        if self.state is PowerState.FAULT_REACTION:
            return
        if self.state is PowerState.FAULT:
            if emergency.HEARTBEAT_LOST in self._errors.present:
                return  # as with many makers: the connection comes first (NMT reset communication), then the fault
            self.state = PowerState.SWITCH_ON_DISABLED
        missing = self._host_missing()
        for code in self._errors.present:
            if not (missing and code == emergency.HEARTBEAT_LOST):
                self._errors.clear(code)

    def _power(self, on: bool) -> None:
        self._halted = False
        self._after_ramp = None
        self._axis.switch(on)
        self.apply_brake()

    def _brake_wanted(self, powered: bool) -> bool:
        """The drive works the brake with its power, unless the host masked the output to work it itself."""
        if self._values[_K60FE_MASK] & _OUTPUT_BRAKE:
            return bool(self._values[_K60FE] & _OUTPUT_BRAKE)
        return not powered

    def apply_brake(self) -> None:
        """Work the brake as the power state and the outputs say."""
        self._plant.brake(self._brake_blocked or self._brake_wanted(self._axis.powered))

    def block_brake(self, blocked: bool) -> None:
        """The brake's coil breaks: it stays closed, whatever the drive says; or it is mended."""
        self._brake_blocked = blocked
        self.apply_brake()

    def latch(self, *, remote: bool) -> None:
        """Actual values, statusword and inputs of this moment into their objects; ``remote``: NMT lets us be driven."""
        values = self._values
        self._axis.latch()
        inputs = _INTERLOCK_CLOSED if self.interlock_closed else 0
        if self._brake_wanted(self._axis.powered):
            inputs |= _BRAKE_ENGAGED
        status = self.statusword(remote=remote)
        if status != values[_K6041] or inputs != values[_K60FD]:
            values[_K6041], values[_K60FD] = status, inputs
            self.changed = True

    def statusword(self, *, remote: bool) -> int:
        """6041h."""
        axis = self._axis
        word = self.state.value | 0x0010  # voltage enabled
        if self._errors.present and self.state is not PowerState.FAULT:
            word |= 0x0080
        if remote:
            word |= 0x0200
        if self.state is PowerState.ENABLED:
            if not axis.ramping and (self._halted or axis.mode):
                word |= 0x0400 if self._halted else 0x1000
            if axis.internal_limit or self._plant.saturated:
                word |= 0x0800
            if axis.mode == CSP and axis.following_error:
                word |= 0x2000
        return word
