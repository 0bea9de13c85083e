"""Settings of the CiA-402 profile, as lists of writes: ``configure`` applies them, and `check` foresees what they meet.

The lists are formed by reading alone, so that what `check` says of them is what ``configure`` does. A setting that is
already as it shall be is not written; what was changed is put back when the bus is left. Everything is written in NMT
pre-operational with the power stage off, read back and compared.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from frictid_drivers.cia402 import objects as od
from frictid_drivers.cia402.access import Drive, Write
from frictid_drivers.cia402.scale import Scale, velocity_unit_rad_s
from frictid_drivers.cia402.settings import BusSettings, JointSettings
from frictid_drivers.cia402.state import DISABLE_VOLTAGE, DriveState, drive_state
from frictid_hil.errors import HardwareError
from frictid_hil.units import format_angle, format_torque

_VELOCITIES = (od.MAX_PROFILE_VELOCITY, od.PROFILE_VELOCITY)
_ACCELERATIONS = (
    od.PROFILE_ACCELERATION,
    od.PROFILE_DECELERATION,
    od.QUICK_STOP_DECELERATION,
    od.MAX_ACCELERATION,
    od.MAX_DECELERATION,
)
_PERIOD_TOLERANCE, _MOST_PERIOD_OFF = 0.01, 0.02
"""An interpolation time this close to the cycle is looked for, and one that is further off is refused."""

NEEDED = {
    od.CONTROLWORD: "it cannot be switched on",
    od.STATUSWORD: "its state cannot be seen",
    od.POSITION_ACTUAL: "its position cannot be seen",
    od.VELOCITY_ACTUAL: "its speed cannot be watched",
    od.TORQUE_ACTUAL: "there is no torque to identify friction from",
    od.HEARTBEAT_PRODUCER_MS: "nobody would notice when it is gone",
}
"""Objects without which no run begins, and why."""


def refuse_if_powered(drive: Drive) -> None:
    """``HardwareError`` where somebody else has enabled the drive: it is not touched."""
    if drive_state(drive.read(od.STATUSWORD)) is DriveState.ENABLED:
        raise HardwareError(
            "the power stage is already on",
            where=drive.where(od.STATUSWORD.address),
            cause="another controller drives this robot",
            next_step="switch the drive off, or let the other controller do it, then start again",
        )


def refuse_if_lacking(drive: Drive) -> None:
    """``HardwareError`` naming the first object that is missing, without which a drive cannot be used."""
    for item, why in NEEDED.items():
        if not drive.has(item):
            raise HardwareError(
                f"the drive has no {item}: {why}",
                where=drive.where(item.address),
                next_step="use another firmware or drive",
            )


def end_quick_stop(drive: Drive) -> None:
    """Switch off a drive that its watchdog stopped when a run was cut off; ``HardwareError`` where it holds on."""
    if drive_state(drive.read(od.STATUSWORD)) is not DriveState.QUICK_STOP_ACTIVE:
        return
    drive.write_blind(od.CONTROLWORD, DISABLE_VOLTAGE)
    if drive_state(drive.read(od.STATUSWORD)) is DriveState.QUICK_STOP_ACTIVE:
        raise HardwareError(
            "does not leave quick stop",
            where=drive.where(od.STATUSWORD.address),
            cause="an earlier run was cut off, and the drive is not in remote control",
            next_step="`frictid-hil reset`, or switch the drive off and on, then start again",
        )


def velocity_unit_writes(drive: Drive) -> list[Write]:
    """The finest unit that friction work needs, 0.001 rpm (60A9), where the drive lets us.

    Speeds and accelerations (607F, 6081, 6083 to 6085, 60C5, 60C6) are in these units, and in these units per second
    wherever a drive has no unit of its own for them (60AA); they keep their physical value, or a quick stop would take
    a thousand times as long (``dependent_writes``).
    """
    told = drive.known(od.VELOCITY_UNIT)
    if told is None or told == od.MILLI_RPM or velocity_unit_rad_s(told) is None:
        return []
    return [Write(od.VELOCITY_UNIT, od.MILLI_RPM, "velocity stays in the drive's own, coarser unit")]


def dependent_writes(drive: Drive, told: int | None, found: dict[od.Object, int]) -> list[Write]:
    """What keeps its physical value after 60A9 was changed from ``told``; ``found`` are the values from before."""
    before = None if told is None else velocity_unit_rad_s(told)
    after = velocity_unit_rad_s(drive.known(od.VELOCITY_UNIT) or 0)
    if before is None or after is None or before == after:
        return []
    return [
        Write(item, min(item.type.high, round(value * before / after)), f"{item.name} has lost its value")
        for item, value in found.items()
        if drive.read(item) == value
    ]


def velocity_dependent(drive: Drive) -> dict[od.Object, int]:
    """Objects in units of 60A9, with their values."""
    items = [*_VELOCITIES, *([] if drive.has(od.ACCELERATION_UNIT) else _ACCELERATIONS)]
    return {item: value for item in items if (value := drive.known(item))}


def interpolation_writes(drive: Drive, cycle_hz: float) -> list[Write]:
    """60C2 for a rate, only where it differs: in the drive's own power of ten, else in ms, else as exact as can be."""
    if not drive.has(od.INTERPOLATION_VALUE):
        return []
    if abs(_present_period_s(drive) * cycle_hz - 1.0) < 1e-9:
        return []
    value, index = interpolation_period(drive, cycle_hz)
    said = "the interpolation time stays as it is"
    power = [Write(od.INTERPOLATION_INDEX, index, said)] if drive.has(od.INTERPOLATION_INDEX) else []
    return [*power, Write(od.INTERPOLATION_VALUE, value, said)]


def interpolation_period(drive: Drive, cycle_hz: float) -> tuple[int, int]:
    """60C2 for a rate, value (1..255) and power of ten: milliseconds first, because some drives take no other power."""
    own = drive.known(od.INTERPOLATION_INDEX)
    closest = (math.inf, 1, -3)
    for index in (-3,) if own is None else (-3, own, -4, -5, -6, -2, -1):
        if index != own and drive.quirks.refusal(od.INTERPOLATION_INDEX, index):
            continue
        value = min(255, max(1, round(10.0**-index / cycle_hz)))
        off = abs(_period_s(value, index) * cycle_hz - 1.0)
        if off < _PERIOD_TOLERANCE:
            return value, index
        closest = min(closest, (off, value, index))
    return closest[1:]


def refuse_other_period(drive: Drive, cycle_hz: float, lost: Iterable[str]) -> None:
    """``HardwareError`` where the drive's interpolation time, after all but what is ``lost``, is not our period."""
    if not drive.has(od.INTERPOLATION_VALUE):
        return
    as_it_is = any("interpolation time" in one for one in lost)
    found = _present_period_s(drive) if as_it_is else _period_s(*interpolation_period(drive, cycle_hz))
    if abs(found * cycle_hz - 1.0) > _MOST_PERIOD_OFF:
        raise HardwareError(
            f"the drive interpolates over {found * 1e3:g} ms (60C2), the cycle is {1e3 / cycle_hz:g} ms",
            where=drive.where(od.INTERPOLATION_VALUE.address),
            cause="the drive's interpolation time is fixed, or takes other values",
            next_step=f"use {1.0 / found:g} Hz (`calibrate --rate`, or `cycle_hz` in the robot file)"
            if found > 0.0
            else "set 60C2 with the vendor's tool",
        )


def _present_period_s(drive: Drive) -> float:
    return _period_s(drive.known(od.INTERPOLATION_VALUE), drive.known(od.INTERPOLATION_INDEX))


def _period_s(value: int | None, index: int | None) -> float:
    return 0.0 if value is None else value * 10.0 ** (-3 if index is None else index)


def reaction_writes(drive: Drive, settings: BusSettings) -> list[Write]:
    """What the drive does when the host is lost, and how it stops quickly: 6007, 605A."""
    abort, stop = settings.abort_option, settings.quick_stop_option
    others = tuple(option for option in (6, 5, 7, 2, 1) if option != stop)
    writes = [
        Write(od.ABORT_CONNECTION, abort, "the drive does not stop when the host is lost", (5 - abort, 1)),
        Write(od.QUICK_STOP_OPTION, stop, "how it stops quickly cannot be set", others),
    ]
    return [write for write in writes if drive.has(write.item)]


def window_writes(drive: Drive, settings: JointSettings, position_rad_per_unit: float, *, active: bool) -> list[Write]:
    """Following-error window, tight where the joint stands locked: 6065, 6066."""
    window_rad = settings.following_window_rad if active else settings.locked_window_rad
    units = max(1, round(window_rad / abs(position_rad_per_unit)))
    said = "the drive's own time for a following error stays"
    writes = [
        Write(od.FOLLOWING_WINDOW, units, "only the host watches the following error"),
        Write(od.FOLLOWING_TIMEOUT_MS, settings.following_timeout_ms, said, (0,)),
    ]
    return [write for write in writes if drive.has(write.item)]


def limit_writes(
    drive: Drive,
    settings: JointSettings,
    scale: Scale,
    torque_nm: float,
    position_min_rad: float,
    position_max_rad: float,
) -> tuple[list[Write], list[str]]:
    """The drive's own limits: 6072 in per mille, 607D in position units (which of them is lower depends on direction).

    A limit that is tighter in the drive stays, unless the robot file says that it may be loosened; what stays so is
    returned in words beside the writes. ``HardwareError`` where the limits are no span of whole units.
    """
    writes, tighter = [], []
    torque = drive.known(od.MAX_TORQUE)
    wanted = min(drive.quirks.typed(od.MAX_TORQUE).type.high, math.floor(torque_nm / abs(scale.torque_nm)))
    if torque is not None and (settings.raise_torque_limit or torque >= wanted):
        writes.append(Write(od.MAX_TORQUE, wanted))
    elif torque is not None:
        tighter.append(
            f"the drive's torque limit is {format_torque(torque * abs(scale.torque_nm))} (6072), "
            f"the robot file's {format_torque(torque_nm)}; the drive's stays "
            "(`raise_torque_limit: true` in the joint's options raises it)"
        )
    if not drive.has(od.POSITION_LIMIT_MIN) or not drive.has(od.POSITION_LIMIT_MAX):
        return writes, tighter
    low, high = sorted(round(limit_rad / scale.position_rad) for limit_rad in (position_min_rad, position_max_rad))
    kind = drive.quirks.typed(od.POSITION_LIMIT_MIN).type
    if not kind.low <= low < high <= kind.high:
        raise HardwareError(
            f"the limits {format_angle(position_min_rad)}..{format_angle(position_max_rad)} are {low}..{high} in the "
            "drive's units (607D)",
            where=drive.where(od.POSITION_LIMIT_MIN.address),
            cause="the position unit is not what the drive's objects say",
            next_step="give `position_units_per_revolution` (of the joint) in the joint's options",
        )
    found_low, found_high = drive.known(od.POSITION_LIMIT_MIN) or 0, drive.known(od.POSITION_LIMIT_MAX) or 0
    if found_low < found_high and not settings.widen_position_limits:
        if found_low > low or found_high < high:
            ends = sorted((found_low * scale.position_rad, found_high * scale.position_rad))
            tighter.append(
                f"the drive's position limits are {format_angle(ends[0])}..{format_angle(ends[1])} (607D), narrower "
                f"than the robot file's {format_angle(position_min_rad)}..{format_angle(position_max_rad)}; the "
                "drive's stay (`widen_position_limits: true` in the joint's options widens them)"
            )
        low, high = max(low, found_low), min(high, found_high)
    # At no moment may the lower limit be above the upper one.
    order = [Write(od.POSITION_LIMIT_MIN, low), Write(od.POSITION_LIMIT_MAX, high)]
    return writes + (order[::-1] if low > found_high else order), tighter


def set_point_writes(drive: Drive, mode: int) -> list[Write]:
    """A start from which nothing can jump: mode, and all targets but the position zero."""
    targets = (od.TARGET_TORQUE, drive.quirks.typed(od.TORQUE_OFFSET), od.TARGET_VELOCITY)
    return [Write(od.MODE, mode), *(Write(target, 0) for target in targets if drive.has(target))]
