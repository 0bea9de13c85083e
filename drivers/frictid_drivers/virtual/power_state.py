"""The power drive system's state machine of CiA 402, as a pure function: state and controlword in, next state out.

Transition numbers are those of the standard's figure. What a transition *does* (ramps, brake, power) belongs to the
servo; here is only which one a controlword asks for, and what the statusword says of a state.
"""

from __future__ import annotations

from enum import Enum


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
