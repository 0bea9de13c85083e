"""The CiA-402 power state machine as two pure functions: which state a statusword says, which controlword comes next.

::

    fault --80--> switch-on disabled --06--> ready --07--> switched on --0F--> enabled
                         ^                                                      |  02
                         +----------------- 00 --------------------- quick-stop active
"""

from __future__ import annotations

from enum import Enum

from frictid_hil.protocol.driver import JointState


class DriveState(Enum):
    """States of the power stage with the (mask, value) by which a statusword says them."""

    NOT_READY = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    ENABLED = (0x6F, 0x27)
    QUICK_STOP_ACTIVE = (0x6F, 0x07)
    FAULT_REACTION = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)
    UNKNOWN = (0x00, 0x01)  # no statusword says this: its bits fit none of the above


SHUTDOWN = 0x06
SWITCH_ON = 0x07
ENABLE = 0x0F
QUICK_STOP = 0x02
DISABLE_VOLTAGE = 0x00
FAULT_RESET = 0x80

_RELEVANT = 0x6F
_STATES = tuple(
    next((state for state in DriveState if bits & state.value[0] == state.value[1]), DriveState.UNKNOWN)
    for bits in range(_RELEVANT + 1)
)

_JOINT_STATES = {
    DriveState.NOT_READY: JointState.DISABLED,
    DriveState.SWITCH_ON_DISABLED: JointState.DISABLED,
    DriveState.READY: JointState.DISABLED,
    DriveState.SWITCHED_ON: JointState.DISABLED,
    DriveState.ENABLED: JointState.ENABLED,
    DriveState.QUICK_STOP_ACTIVE: JointState.STOPPING,
    DriveState.FAULT_REACTION: JointState.FAULT,
    DriveState.FAULT: JointState.FAULT,
    DriveState.UNKNOWN: JointState.UNKNOWN,
}
JOINT_STATES = tuple(_JOINT_STATES[state] for state in _STATES)
"""What the runner calls the state, by ``statusword & 0x6F``."""


def drive_state(statusword: int) -> DriveState:
    """The state a statusword says."""
    return _STATES[statusword & _RELEVANT]


class Target(Enum):
    """What a joint's power stage shall become."""

    DISABLED = "disabled"
    ENABLED = "enabled"
    STOPPED = "stopped"


_ROAD = {
    DriveState.SWITCH_ON_DISABLED: SHUTDOWN,
    DriveState.READY: SWITCH_ON,
    DriveState.SWITCHED_ON: ENABLE,
    DriveState.ENABLED: ENABLE,
}
"""To power, and there."""


def next_controlword(state: DriveState, target: Target, *, standing: bool, may_enable: bool) -> int:
    """The controlword for the coming cycle; asked every cycle, waits for nothing.

    A fault is never reset here: that takes a rising edge of bit 7 which only an explicit request sends. Power is taken
    away only from a joint that is ``standing``; without ``may_enable`` (drive, mode and watchdogs are as they should
    be) the walk stops before power reaches the motor.
    """
    if state in (DriveState.FAULT, DriveState.FAULT_REACTION, DriveState.NOT_READY, DriveState.UNKNOWN):
        return DISABLE_VOLTAGE
    if target is Target.ENABLED:
        if state is DriveState.QUICK_STOP_ACTIVE:
            return DISABLE_VOLTAGE if standing else QUICK_STOP
        return SWITCH_ON if state is DriveState.SWITCHED_ON and not may_enable else _ROAD[state]
    if state in (DriveState.ENABLED, DriveState.QUICK_STOP_ACTIVE):
        if target is Target.STOPPED or not standing:
            return QUICK_STOP
        return SWITCH_ON if state is DriveState.ENABLED else DISABLE_VOLTAGE
    return SHUTDOWN if state is DriveState.SWITCHED_ON else DISABLE_VOLTAGE
