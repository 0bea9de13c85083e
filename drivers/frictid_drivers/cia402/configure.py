"""Writing a drive's settings, each read back and compared; what cannot be confirmed is not used.

Everything is written in NMT pre-operational with the power stage off. The second joint of a run costs only what
differs from the first: transmission types, start values and following-error windows.
"""

from __future__ import annotations

import math

from frictid_drivers.cia402 import objects as od
from frictid_drivers.cia402.facts import Scale, velocity_unit_rad_s
from frictid_drivers.cia402.frame_map import Frame
from frictid_drivers.cia402.layout import Layout, Pdo
from frictid_drivers.cia402.sdo import Drive
from frictid_drivers.cia402.settings import BusSettings, JointSettings
from frictid_drivers.cia402.state import DISABLE_VOLTAGE, DriveState, drive_state
from frictid_hil.errors import HardwareError

_NOT_VALID = 1 << 31
_NO_REMOTE = 1 << 30
_COB_ID_MASK = _NOT_VALID | 0x1FFFFFFF
"""Bit 30 (remote frames) is a drive's own business."""

_ALL = tuple((transmit, number) for transmit in (False, True) for number in (1, 2, 3, 4))


def refuse_if_powered(drive: Drive) -> None:
    """A drive that somebody else has enabled is not touched.

    Raises:
        HardwareError: its power stage is on.
    """
    if drive_state(drive.read(od.STATUSWORD)) is DriveState.ENABLED:
        raise HardwareError(
            "the power stage is already on",
            where=drive.where(od.STATUSWORD.address),
            cause="another controller drives this robot",
            next_step="switch the drive off, or let the other controller do it, then start again",
        )


def end_quick_stop(drive: Drive) -> None:
    """Switch off a drive that its watchdog stopped when an earlier run was cut off: it stands and holds until told.

    Raises:
        HardwareError: it stays in quick stop.
    """
    if drive_state(drive.read(od.STATUSWORD)) is not DriveState.QUICK_STOP_ACTIVE:
        return
    drive.write_blind(od.CONTROLWORD, DISABLE_VOLTAGE)
    if drive_state(drive.read(od.STATUSWORD)) is DriveState.QUICK_STOP_ACTIVE:
        raise HardwareError(
            "does not leave quick stop",
            where=drive.where(od.STATUSWORD.address),
            cause="an earlier run was cut off, and the drive is not in remote control",
            next_step="switch the drive off and on, then start again",
        )


def configure_velocity_unit(drive: Drive, told: int | None) -> int | None:
    """The finest unit that friction work needs, 0.001 rpm, where the drive lets us; 60A9.

    Decelerations (6084, 6085) are in these units per second wherever a drive has no unit of its own for them (60AA);
    they keep their physical value, or a quick stop would take a thousand times as long.

    Args:
        drive: power stage off.
        told: 60A9 as it was found, None where there is none.

    Returns:
        60A9 as it is now.
    """
    before = None if told is None else velocity_unit_rad_s(told)
    if told is None or told == od.MILLI_RPM or before is None:
        return told
    after = velocity_unit_rad_s(od.MILLI_RPM)
    assert after is not None  # it is an angle per time
    dependent = [] if drive.has(od.ACCELERATION_UNIT) else [od.PROFILE_DECELERATION, od.QUICK_STOP_DECELERATION]
    found = {item: drive.find(item) for item in dependent}
    try:
        drive.write(od.VELOCITY_UNIT, od.MILLI_RPM)
    except HardwareError:
        # Fixed by the vendor: the coarse unit stays, and ``check`` says so.
        return drive.read(od.VELOCITY_UNIT)
    for item, value in found.items():
        if value is not None and drive.read(item) == value:
            drive.write(item, min(item.type.high, round(value * before / after)))
    return od.MILLI_RPM


def configure_timing(drive: Drive, cycle_hz: float, sync_overflow: int) -> None:
    """SYNC and interpolation period: 1005, 1006, 1019, 60C2.

    Raises:
        HardwareError: refused or not confirmed.
    """
    if drive.has(od.SYNC_COB_ID) and drive.read(od.SYNC_COB_ID) != 0x80:
        drive.write(od.SYNC_COB_ID, 0x80)
    if drive.has(od.SYNC_OVERFLOW) and drive.confirmed(od.SYNC_OVERFLOW) != sync_overflow:
        # 1019 may only change while 1006 is zero.
        if drive.has(od.SYNC_PERIOD_US):
            drive.write(od.SYNC_PERIOD_US, 0)
        drive.write(od.SYNC_OVERFLOW, sync_overflow)
    if drive.has(od.SYNC_PERIOD_US):
        drive.write(od.SYNC_PERIOD_US, round(1e6 / cycle_hz))
    if drive.has(od.INTERPOLATION_VALUE):
        value, index = interpolation_period(cycle_hz)
        drive.write(od.INTERPOLATION_INDEX, index)
        drive.write(od.INTERPOLATION_VALUE, value)


def interpolation_period(cycle_hz: float) -> tuple[int, int]:
    """60C2 for a rate: value (1..255) and power of ten, as exact as eight bits allow."""
    period_s = 1.0 / cycle_hz
    for index in range(-6, 0):
        value = round(period_s * 10.0**-index)
        if 1 <= value <= 255:
            return value, index
    return 255, -1


def configure_safety(drive: Drive, settings: BusSettings) -> None:
    """Watchdogs both ways and what the drive does when ours expires: 1016, 1017, 6007, 605A.

    Raises:
        HardwareError: refused or not confirmed.
    """
    drive.write(od.HEARTBEAT_PRODUCER_MS, settings.drive_heartbeat_ms)
    if drive.has(od.ABORT_CONNECTION):
        drive.write(od.ABORT_CONNECTION, settings.abort_option)
    if drive.has(od.QUICK_STOP_OPTION):
        drive.write(od.QUICK_STOP_OPTION, settings.quick_stop_option)
    if drive.has(od.HEARTBEAT_CONSUMER):
        drive.write(od.HEARTBEAT_CONSUMER, settings.host_node << 16 | settings.watchdog_ms)


def configure_frame_format(drive: Drive, switch: od.Object | None, *, fd: bool) -> None:
    """Classical or CAN FD frames for the PDOs, where the robot file or a known drive has an object that decides it.

    Raises:
        HardwareError: refused or not confirmed, or CAN FD is wanted of a drive that lacks the object.
    """
    if switch is None:
        return  # the vendor's tool has set it; what comes in other frames is told while cycling
    if drive.has(switch):
        drive.write(switch, int(fd))
    elif fd:
        raise HardwareError(
            f"the drive has no {switch.address}: it cannot be told to send its PDOs as CAN FD frames",
            where=drive.where(switch.address),
            cause="the drive or its firmware speaks classical CAN only",
            next_step="leave `fd` out of the robot file's options, or correct this joint's `fd_object`",
        )


def release_watchdog(drive: Drive) -> None:
    """End the drive's watch over us (1016 = 0), so that it does not fault when we leave."""
    if drive.has(od.HEARTBEAT_CONSUMER):
        drive.write(od.HEARTBEAT_CONSUMER, 0)


def configure_windows(drive: Drive, settings: JointSettings, position_rad_per_unit: float, *, active: bool) -> None:
    """Following-error window, tight where the joint stands locked: 6065, 6066.

    Raises:
        HardwareError: refused or not confirmed.
    """
    window_rad = settings.following_window_rad if active else settings.locked_window_rad
    if drive.has(od.FOLLOWING_WINDOW):
        drive.write(od.FOLLOWING_WINDOW, max(1, round(window_rad / abs(position_rad_per_unit))))
    if drive.has(od.FOLLOWING_TIMEOUT_MS):
        drive.write(od.FOLLOWING_TIMEOUT_MS, settings.following_timeout_ms)


def configure_limits(
    drive: Drive, scale: Scale, torque_nm: float, position_min_rad: float, position_max_rad: float
) -> None:
    """The drive's own limits: 6072 in per mille, 607D in position units (which of them is lower depends on direction).

    Raises:
        HardwareError: refused or not confirmed.
    """
    if drive.has(od.MAX_TORQUE):
        drive.write(od.MAX_TORQUE, math.floor(torque_nm / abs(scale.torque_nm)))
    if not drive.has(od.POSITION_LIMIT_MIN):
        return
    low, high = sorted(round(limit_rad / scale.position_rad) for limit_rad in (position_min_rad, position_max_rad))
    found_high = drive.read(od.POSITION_LIMIT_MAX)
    # At no moment may the lower limit be above the upper one.
    order = [(od.POSITION_LIMIT_MIN, low), (od.POSITION_LIMIT_MAX, high)]
    for item, value in reversed(order) if low > found_high else order:
        drive.write(item, value)


def configure_set_points(drive: Drive, mode: int) -> None:
    """A start from which nothing can jump: mode, target position where the joint stands, all other targets zero.

    Raises:
        HardwareError: refused or not confirmed.
    """
    drive.write(od.MODE, mode)
    drive.write_blind(od.TARGET_POSITION, drive.read(od.POSITION_ACTUAL))
    for target in (od.TARGET_TORQUE, od.TORQUE_OFFSET, od.TARGET_VELOCITY):
        if drive.has(target):
            drive.write(target, 0)


def configure_pdos(drive: Drive, layout: Layout, joint: str) -> dict[tuple[bool, int], Frame]:
    """Mapping and transmission of every PDO.

    Returns:
        The frames as read back from the drive, by (transmit, number).

    Raises:
        HardwareError: refused or not confirmed.
    """
    used = {(pdo.transmit, pdo.number) for pdo in layout.pdos[joint]}
    for transmit, number in _ALL:
        if (transmit, number) not in used:
            _switch_off(drive, transmit, number)
    return {(pdo.transmit, pdo.number): _configure_pdo(drive, pdo) for pdo in layout.pdos[joint]}


def _switch_off(drive: Drive, transmit: bool, number: int) -> None:
    cob_id = od.pdo_cob_id(transmit, number)
    present = drive.confirmed(cob_id)
    if present is None:
        present = drive.find(cob_id)
    if present is not None and not present & _NOT_VALID:
        drive.write(cob_id, present | _NOT_VALID, _COB_ID_MASK)


def _configure_pdo(drive: Drive, pdo: Pdo) -> Frame:
    cob_id = od.pdo_cob_id(pdo.transmit, pdo.number)
    valid = pdo.cob_id | (_NO_REMOTE if pdo.transmit else 0)
    wanted = {od.pdo_type(pdo.transmit, pdo.number): pdo.every}
    if pdo.transmit and drive.has(od.pdo_sync_start(pdo.number)):
        wanted[od.pdo_sync_start(pdo.number)] = pdo.start
    entries = {entry.index << 16 | entry.sub << 8 | entry.type.bits: entry for entry in pdo.entries}
    mapped = _confirmed_mapping(drive, pdo) == list(entries)
    if not mapped or drive.confirmed(cob_id) != valid or any(drive.confirmed(o) != v for o, v in wanted.items()):
        drive.write(cob_id, valid | _NOT_VALID, _COB_ID_MASK)
        for item, value in wanted.items():
            drive.write(item, value)
        if not mapped:
            count = od.pdo_entry_count(pdo.transmit, pdo.number)
            drive.write(count, 0)
            for sub, word in enumerate(entries, start=1):
                drive.write(od.pdo_entry(pdo.transmit, pdo.number, sub), word)
            drive.write(count, len(entries))
        drive.write(cob_id, valid, _COB_ID_MASK)
    return Frame(pdo.cob_id, tuple(entries[word] for word in _confirmed_mapping(drive, pdo)))


def _confirmed_mapping(drive: Drive, pdo: Pdo) -> list[int]:
    """The mapping words that were read back from the drive, in order; empty before the first configuration."""
    count = drive.confirmed(od.pdo_entry_count(pdo.transmit, pdo.number)) or 0
    words = [drive.confirmed(od.pdo_entry(pdo.transmit, pdo.number, sub)) for sub in range(1, count + 1)]
    return [word for word in words if word is not None]
