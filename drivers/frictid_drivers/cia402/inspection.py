"""``identify`` and ``check``: what drives say of themselves, and whether it suits the job. Reads only."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from frictid_drivers.cia402 import objects as od
from frictid_drivers.cia402.access import Drive
from frictid_drivers.cia402.configure import NEEDED
from frictid_drivers.cia402.facts import Facts
from frictid_drivers.cia402.fleet import Fleet
from frictid_drivers.cia402.known_settings import Effect, read_settings, timing_of
from frictid_drivers.cia402.layout import BusLoad, Layout
from frictid_drivers.cia402.scale import Scale, scale_of, velocity_unit_rad_s
from frictid_drivers.cia402.settings import BusSettings, JointSettings
from frictid_drivers.cia402.state import DriveState, drive_state
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import JointPlan
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import OWN_FRICTION_COMPENSATION, Finding, JointIdentity, Severity, Timing
from frictid_hil.protocol.error_words import told_error
from frictid_hil.units import format_angle

Said = tuple[Severity, str] | tuple[Severity, str, str]  # a finding of the joint at hand: severity, message, next step
_ERROR, _WARNING = Severity.ERROR, Severity.WARNING

_SLACK_RAD = math.radians(0.1)
_HOST_LOST = 0x8130
_SLOW_STOP_S = 1.0
_CONSEQUENCES = {
    od.ABORT_CONNECTION: "what it does when the host is lost cannot be set",
    od.QUICK_STOP_OPTION: "how it stops quickly cannot be set",
    od.FOLLOWING_WINDOW: "it does not watch the following error",
    od.ERROR_CODE: "what a fault was is told by EMCY alone",
    od.MAX_TORQUE: "only the host limits the torque",
    od.POSITION_LIMIT_MIN: "only the host limits the position",
}
"""Objects without which something is not as safe as it could be."""


def identity(joint: JointSetup, drive: Drive, facts: Facts, settings: JointSettings, cycle_hz: float) -> JointIdentity:
    """One drive's page of the provenance; at a rate, because a cycle's torque is half a cycle older than its SYNC."""
    unit = drive.find(od.VELOCITY_UNIT)
    scale, _ = scale_of(facts, joint, unit)
    known = read_settings(drive, facts.vendor, facts.product)
    values: dict[str, str | float | int | bool] = {setting.object.name: value for setting, value in known.items()}
    values["motor rated torque (6076), mN m"] = facts.rated_torque_mnm or 0
    if drive.quirks.names:
        values["quirks"] = ", ".join(drive.quirks.names)
    for name, ratio in (("encoder (608F)", facts.encoder), ("gear (6091)", facts.gear), ("feed (6092)", facts.feed)):
        if ratio is not None:
            values[name] = f"{ratio[0]}:{ratio[1]}"
    if unit is not None:
        values["velocity unit (60A9)"] = f"{unit:#010x}"
    assumed = Timing(torque_delay_s=0.5 / cycle_hz, uncertainty_s=0.5 / cycle_hz, source="assumed")
    return JointIdentity(
        joint=joint.name,
        serial=str(facts.serial) if facts.serial else "",
        firmware=" ".join(part for part in (facts.software, f"revision {facts.revision:#x}") if part),
        product=f"{facts.name or 'unnamed'} {facts.hardware} (vendor {facts.vendor:#x}, product {facts.product:#x})",
        rated_torque_nm=scale.rated_torque_nm,
        gear_ratio=scale.gear_ratio,
        position_resolution_rad=abs(scale.position_rad),
        torque_resolution_nm=abs(scale.torque_nm),
        torque_source=settings.torque_source,
        timing=settings.timing or timing_of(known, 1.0 / cycle_hz) or assumed,
        settings=values,
    )


def bus_findings(load: BusLoad, highest_hz: float, facts: Mapping[str, Facts]) -> list[Finding]:
    """Does the layout fit the wire, and can the reports of locked joints be spread?"""
    subject, findings = "bus load", []
    if load.fits:
        findings.append(Finding(Severity.OK, subject, f"{load}; up to {highest_hz:g} Hz would fit"))
    else:
        said = f"{load}: more than 80 % on average or 100 % in one cycle"
        rate = f"use a rate of at most {highest_hz:g} Hz (`calibrate --rate`, or `cycle_hz` in the robot file)"
        findings.append(Finding(_ERROR, subject, said, rate))
    lacking = [joint for joint, fact in facts.items() if not fact.sync_counter]
    if lacking:
        said = f"no SYNC counter (1019, 18xx:06) on joint {', '.join(lacking)}: all locked joints answer the same SYNC"
        newer = "the rate that fits the bus is lower for it; newer firmware may have the SYNC counter"
        findings.append(Finding(_WARNING, subject, said, newer))
    return findings


def joint_findings(
    joint: JointSetup, fleet: Fleet, layout: Layout, settings: BusSettings, planned: JointPlan | None
) -> list[Finding]:
    """Everything worth saying of one drive: what it is, and what ``configure`` will meet."""
    drive, facts = fleet.drives[joint.name], fleet.facts[joint.name]
    doubts, fatal, lost = fleet.foreseen(joint, layout)
    scale, _ = scale_of(facts, joint, None if facts.velocity_unit is None else od.MILLI_RPM)
    subject = f"joint {joint.name}"
    said = (
        *_itself(joint, drive, facts, scale),
        *((_ERROR, message, "see the drive's manual on this object") for message in fatal),
        *((_WARNING, message) for message in lost),
        *(
            (_ERROR, f"the drive has no {item}: {why}", "use another firmware or drive")
            for item, why in NEEDED.items()
            if not drive.has(item)
        ),
        *_state(drive),
        *_modes(facts, settings),
        *(
            (_WARNING, f"the drive has no {item}: {consequence}")
            for item, consequence in _CONSEQUENCES.items()
            if not drive.has(item)
        ),
        *_limits(joint, drive, scale, fleet.travel_rad(joint), planned),
        *_quick_stop(joint, drive, facts, scale),
    )
    helped = [
        Finding(
            _ERROR,
            subject,
            f"the drive compensates friction by itself ({setting.object} = {value}): "
            "measured through it, friction is too small; compensated on top of it, it is given twice",
            "switch it off with the vendor's tool",
            OWN_FRICTION_COMPENSATION,
        )
        for setting, value in read_settings(drive, facts.vendor, facts.product).items()
        if setting.effect is Effect.FRICTION_COMPENSATION and value
    ]
    return [*doubts, *(Finding(severity, subject, *words) for severity, *words in said), *helped]


def _itself(joint: JointSetup, drive: Drive, facts: Facts, scale: Scale) -> Iterator[Said]:
    yield (
        Severity.OK,
        f"node {joint.address}: {facts.name or 'a drive'}, serial {facts.serial}, firmware {facts.software or '?'}, "
        f"{scale.rated_torque_nm:.4g} N m rated, {abs(scale.position_rad):.3g} rad per count",
    )
    if drive.quirks.names:
        yield Severity.OK, f"known of this drive: {', '.join(drive.quirks.names)}"
    if facts.device_type & 0xFFFF != 402 and not facts.quirks.any_device_type:
        yield _WARNING, f"device type {facts.device_type:#010x} (1000) does not say that it is a CiA-402 drive"


def _state(drive: Drive) -> list[Said]:
    said: list[Said] = []
    status = drive.read(od.STATUSWORD)
    state = drive_state(status)
    word = f"statusword {status:#06x}"
    error = drive.find(od.ERROR_CODE) or 0
    if state is DriveState.ENABLED:
        said.append((_ERROR, f"the power stage is already on ({word})", "switch the drive off"))
    if state is DriveState.QUICK_STOP_ACTIVE or (error == _HOST_LOST and state is DriveState.SWITCH_ON_DISABLED):
        what = f"an earlier run was cut off: the drive stopped by itself ({word}, error {error:#06x})"
        said.append(
            (_WARNING, what, "make sure that nothing holds the arm; the drive is switched off before anything else")
        )
    elif state in (DriveState.FAULT, DriveState.FAULT_REACTION):
        cure = "clear its cause (the code is in the drive's manual), then `frictid-hil reset`"
        said.append((_ERROR, f"error {told_error(error)} is pending ({word})", cure))
    elif error:
        said.append((_WARNING, f"the last error was {told_error(error)}; the drive is healthy ({word})"))
    register = drive.find(od.ERROR_REGISTER) or 0
    if register and not said:
        said.append((_WARNING, f"error register (1001) is {register:#04x}"))
    return said


def _modes(facts: Facts, settings: BusSettings) -> Iterator[Said]:
    if not facts.supports(Mode.POSITION):
        yield _ERROR, f"no cyclic synchronous position mode (6502 = {facts.modes or 0:#x})"
    if not facts.supports(Mode.TORQUE):
        yield _WARNING, "no cyclic synchronous torque mode; compensation only by torque offset"
    if not facts.torque_offset:
        yield _WARNING, "no torque offset (60B2); compensation only in torque mode"
    if not facts.watchdog:
        allowed = settings.allow_torque_without_watchdog
        yield (
            _WARNING,
            f"no {'abort connection option (6007)' if facts.heartbeat_consumers else 'heartbeat consumer (1016)'}: "
            "the drive does not stop by itself when this program dies; torque mode is "
            + ("allowed by the robot file all the same" if allowed else "refused"),
            "keep the emergency stop in your hand",
        )


def _limits(
    joint: JointSetup, drive: Drive, scale: Scale, travel_rad: tuple[float, float] | None, planned: JointPlan | None
) -> Iterator[Said]:
    if planned is not None and travel_rad is not None:
        low, high = planned.travel_rad
        if low < travel_rad[0] - _SLACK_RAD or high > travel_rad[1] + _SLACK_RAD:
            yield (
                _ERROR,
                f"the plan moves from {format_angle(low)} to {format_angle(high)}, the drive allows "
                f"{format_angle(travel_rad[0])}..{format_angle(travel_rad[1])} (607D)",
                "plan a shorter travel, or set `widen_position_limits: true` in the joint's options",
            )
    position = drive.find(od.POSITION_ACTUAL)
    here = math.nan if position is None else position * scale.position_rad
    if here < joint.position_min_rad or here > joint.position_max_rad:
        yield (
            _ERROR,
            f"stands at {format_angle(here)}, outside the robot file's limits",
            "home the robot, or correct `direction`, `gear_ratio` or the limits",
        )


def _quick_stop(joint: JointSetup, drive: Drive, facts: Facts, scale: Scale) -> Iterator[Said]:
    """A quick stop that takes long is none. 6085 is in velocity units per second unless 60AA says otherwise."""
    deceleration = drive.find(od.QUICK_STOP_DECELERATION)
    if not deceleration or drive.has(od.ACCELERATION_UNIT) or facts.velocity_unit is None:
        return
    told, assumed = velocity_unit_rad_s(facts.velocity_unit), velocity_unit_rad_s(od.MILLI_RPM)
    if told is None or assumed is None:
        return
    stop_s = joint.max_velocity_rad_s / (deceleration * abs(scale.velocity_rad_s) * told / assumed)
    if stop_s > _SLOW_STOP_S:
        yield (
            _WARNING,
            f"a quick stop from full speed would take {stop_s:.2g} s (6085 = {deceleration})",
            "raise 6085 with the vendor's tool",
        )
