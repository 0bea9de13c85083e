"""Every one of the 65536 statuswords says exactly one state, and every state leads where it should."""

from __future__ import annotations

import pytest

from frictid_drivers.cia402.state import JOINT_STATES, DriveState, Target, drive_state, next_controlword
from frictid_hil.protocol.driver import JointState

TABLE = {
    DriveState.NOT_READY: (0x4F, 0x00),
    DriveState.SWITCH_ON_DISABLED: (0x4F, 0x40),
    DriveState.READY: (0x6F, 0x21),
    DriveState.SWITCHED_ON: (0x6F, 0x23),
    DriveState.ENABLED: (0x6F, 0x27),
    DriveState.QUICK_STOP_ACTIVE: (0x6F, 0x07),
    DriveState.FAULT_REACTION: (0x4F, 0x0F),
    DriveState.FAULT: (0x4F, 0x08),
}


def test_all_statuswords():
    seen = dict.fromkeys(DriveState, 0)
    for word in range(1 << 16):
        matching = [state for state, (mask, value) in TABLE.items() if word & mask == value]
        assert len(matching) <= 1
        expected = matching[0] if matching else DriveState.UNKNOWN
        assert drive_state(word) is expected
        assert isinstance(JOINT_STATES[word & 0x6F], JointState)
        seen[expected] += 1
    assert all(seen.values()) and sum(seen.values()) == 1 << 16


def test_only_enabled_counts_as_enabled():
    for word in range(1 << 7):
        assert (JOINT_STATES[word & 0x6F] is JointState.ENABLED) == (drive_state(word) is DriveState.ENABLED)
        assert (JOINT_STATES[word & 0x6F] is JointState.FAULT) == (
            drive_state(word) in (DriveState.FAULT, DriveState.FAULT_REACTION)
        )


# What a drive does with a controlword, from CiA 402's figure; written down here a second time on purpose.
DRIVE = {
    (DriveState.SWITCH_ON_DISABLED, 0x06): DriveState.READY,
    (DriveState.READY, 0x07): DriveState.SWITCHED_ON,
    (DriveState.SWITCHED_ON, 0x0F): DriveState.ENABLED,
    (DriveState.ENABLED, 0x07): DriveState.SWITCHED_ON,
    (DriveState.SWITCHED_ON, 0x06): DriveState.READY,
    (DriveState.READY, 0x00): DriveState.SWITCH_ON_DISABLED,
    (DriveState.READY, 0x02): DriveState.SWITCH_ON_DISABLED,
    (DriveState.SWITCHED_ON, 0x00): DriveState.SWITCH_ON_DISABLED,
    (DriveState.SWITCHED_ON, 0x02): DriveState.SWITCH_ON_DISABLED,
    (DriveState.ENABLED, 0x02): DriveState.QUICK_STOP_ACTIVE,
    (DriveState.ENABLED, 0x00): DriveState.SWITCH_ON_DISABLED,
    (DriveState.QUICK_STOP_ACTIVE, 0x00): DriveState.SWITCH_ON_DISABLED,
}


def walk(state, target, *, standing=True, may_enable=True, steps=8):
    path = [state]
    for _ in range(steps):
        word = next_controlword(state, target, standing=standing, may_enable=may_enable)
        state = DRIVE.get((state, word), state)
        path.append(state)
    return path


@pytest.mark.parametrize(
    "start", [DriveState.SWITCH_ON_DISABLED, DriveState.READY, DriveState.SWITCHED_ON, DriveState.QUICK_STOP_ACTIVE]
)
def test_walks_to_enabled(start):
    assert walk(start, Target.ENABLED)[-1] is DriveState.ENABLED


@pytest.mark.parametrize("start", [state for state in TABLE if state not in (DriveState.NOT_READY,)])
def test_walks_to_disabled_when_standing(start):
    end = walk(start, Target.DISABLED)[-1]
    assert end in (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT, DriveState.FAULT_REACTION)


def test_moving_joint_is_stopped_before_power_is_taken():
    path = walk(DriveState.ENABLED, Target.DISABLED, standing=False)
    assert path[-1] is DriveState.QUICK_STOP_ACTIVE and DriveState.SWITCH_ON_DISABLED not in path


def test_power_waits_for_permission():
    assert walk(DriveState.SWITCH_ON_DISABLED, Target.ENABLED, may_enable=False)[-1] is DriveState.SWITCHED_ON


def test_stopped_stays_stopped():
    assert walk(DriveState.ENABLED, Target.STOPPED)[-1] is DriveState.QUICK_STOP_ACTIVE
    assert DriveState.ENABLED not in walk(DriveState.SWITCHED_ON, Target.STOPPED)[1:]


@pytest.mark.parametrize("target", list(Target))
@pytest.mark.parametrize("standing", [True, False])
def test_no_fault_is_ever_reset_here(target, standing):
    for state in DriveState:
        word = next_controlword(state, target, standing=standing, may_enable=True)
        assert not word & 0x80
        if state in (DriveState.FAULT, DriveState.FAULT_REACTION):
            assert word == 0
