"""The way back after a fault, or after a run that was cut off: what stands in the way, and taking it away.

A drive whose watchdog stopped it (8130) often takes no reset of the fault before its communication was reset: NMT
"reset communication" comes first, then the rising edge of controlword bit 7. Nothing gets power here.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from frictid_drivers.cia402 import configure
from frictid_drivers.cia402 import objects as od
from frictid_drivers.cia402.access import Drive
from frictid_drivers.cia402.state import DISABLE_VOLTAGE, FAULT_RESET, DriveState, drive_state
from frictid_hil.errors import HardwareError
from frictid_hil.protocol.driver import Finding, Severity
from frictid_hil.protocol.error_words import told_error

NMT_RESET_COMMUNICATION = 0x82
_BOOT_S = 10.0
_LEAVE_S = 2.0
_FAULTS = (DriveState.FAULT, DriveState.FAULT_REACTION)


def standing_fault(drive: Drive) -> Finding | None:
    """What keeps a drive from running again; None where nothing does. Reads only."""
    status = drive.read(od.STATUSWORD)
    state = drive_state(status)
    if state not in (*_FAULTS, DriveState.QUICK_STOP_ACTIVE):
        return None
    error = drive.find(od.ERROR_CODE) or (drive.find(od.ERROR_HISTORY) or 0) & 0xFFFF
    what = "stands in quick stop" if state is DriveState.QUICK_STOP_ACTIVE else "is in fault"
    return Finding(
        Severity.ERROR,
        f"joint {drive.joint}",
        f"{what}: {told_error(error) if error else 'no error code'} (statusword {status:#06x})",
        "find and clear its cause before it is reset",
    )


def bring_back(drive: Drive, nmt: Callable[[int], None]) -> None:
    """Out of fault or quick stop, without power; ``HardwareError`` where it has power, does not come back, or stays."""
    configure.refuse_if_powered(drive)
    configure.end_quick_stop(drive)
    nmt(NMT_RESET_COMMUNICATION)
    drive.forget()
    _await_boot(drive)
    if drive_state(drive.read(od.STATUSWORD)) not in _FAULTS:
        return
    for controlword in (DISABLE_VOLTAGE, FAULT_RESET, DISABLE_VOLTAGE):
        drive.write_blind(od.CONTROLWORD, controlword)
    deadline = time.monotonic() + _LEAVE_S
    while drive_state(drive.read(od.STATUSWORD)) in _FAULTS:
        if time.monotonic() > deadline:
            error = drive.find(od.ERROR_CODE) or 0
            raise HardwareError(
                f"still in fault {told_error(error)} after a reset of communication and of the fault",
                where=drive.where(od.STATUSWORD.address),
                cause="the cause of the fault is still there",
                next_step="clear the cause, or switch the drive off and on",
            )
        time.sleep(0.02)


def _await_boot(drive: Drive) -> None:
    deadline = time.monotonic() + _BOOT_S
    while True:
        try:
            drive.read(od.STATUSWORD)
            return
        except HardwareError:
            if time.monotonic() > deadline:
                raise
