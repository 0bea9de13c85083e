"""What a drive's integers are worth on the joint side.

Position (6064) is in the unit of 60A8 where that is an angle, of the driving shaft. Else it is in units of which 6092
says how many make one revolution of that shaft (CiA 402: increments x feed / (resolution x gear)), or in encoder
increments (608F) where a drive has no 6092, or 6092 as it left the factory: 1:1 would be one unit per revolution.
The driving shaft is the joint where the drive knows the gear (6091 equals the robot file's ratio), and the motor where
6091 is 1:1. Velocity (606C) is in units of 60A9 of that same shaft. Torque (6077) is in per mille of 6076, which is on
the motor side. What stays a guess here is proven by the first motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from frictid_drivers.cia402.facts import Facts
from frictid_hil.errors import HardwareError
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import Finding, Severity
from frictid_hil.units import format_angle

_TURN = 2.0 * math.pi
_ANGLES = {0xB4: _TURN, 0x10: 1.0, 0x41: math.pi / 180.0}
"""Revolution, radian, degree in 60A8 and 60A9."""
_TIMES = {0x03: 1.0, 0x47: 60.0}
"""60A9 denominators: second, minute."""
_RPM = _TURN / 60.0
_POSITION_REVERSED, _VELOCITY_REVERSED = 0x80, 0x40

RATIO_TOLERANCE = 0.005
RATED_TOLERANCE = 0.01
COARSE_VELOCITY_RAD_S = 0.001
"""A joint-side velocity step above this blurs the low end of a friction curve."""
COARSE_POSITION_RAD = math.radians(0.02)
"""A joint-side position step above this is absurd: no friction shows in a velocity formed from it."""
_COUNTS = 1 << 31


@dataclass(frozen=True, slots=True)
class Scale:
    """What one unit of the drive is worth on the joint side; signs carry the joint's direction.

    Attributes:
        position_rad: of 6064, 607A, 607D.
        velocity_rad_s: of 606C, 60FF.
        torque_nm: of 6077, 6071, 6072, 60B2.
        rated_torque_nm: what 1000 per mille are, always positive.
        gear_ratio: as used.
    """

    position_rad: float
    velocity_rad_s: float
    torque_nm: float
    rated_torque_nm: float
    gear_ratio: float


def scale_of(facts: Facts, joint: JointSetup, velocity_unit: int | None) -> tuple[Scale, list[Finding]]:
    """Joint-side factors from the drive's own figures, and everything that does not fit the robot file.

    Args:
        facts: of the drive.
        joint: of the robot file. Options ``position_units_per_revolution`` (of the joint), ``velocity_unit_rad_s``
            (joint side) and ``rated_torque_side: joint`` override what a drive says wrongly or not at all.
        velocity_unit: 60A9 as it is or will be set, None where the drive has none.

    Returns:
        The factors, and findings; an ERROR among them forbids motion.
    """
    subject = f"joint {joint.name}"
    findings: list[Finding] = []

    def report(severity: Severity, message: str, next_step: str = "") -> None:
        findings.append(Finding(severity, subject, message, next_step))

    shaft_is_joint = _gear(facts, joint, report)
    shafts_per_joint = 1.0 if shaft_is_joint else joint.gear_ratio
    units = _position_units(facts, joint, shafts_per_joint, report)
    position = _TURN / units
    velocity = _velocity_unit(facts, joint, velocity_unit, shafts_per_joint, position, report)
    rated = _rated_torque(facts, joint, report)
    unit_mnm = facts.quirks.torque_unit_mnm
    torque = rated / 1000.0 if unit_mnm is None else unit_mnm * 1e-3 * joint.gear_ratio
    sign = float(joint.direction)
    _resolution(joint, position, report)
    _polarity(facts, position, report)
    return Scale(sign * position, sign * velocity, sign * torque, rated, joint.gear_ratio), findings


Report = Callable[..., None]


def _resolution(joint: JointSetup, position_rad: float, report: Report) -> None:
    if position_rad > COARSE_POSITION_RAD:
        report(
            Severity.ERROR,
            f"one unit of position would be {format_angle(position_rad)} at the joint: absurdly coarse",
            "correct 60A8, 6092 or 608F with the vendor's tool, or give `position_units_per_revolution` (of the joint)",
        )
    furthest = max(abs(joint.position_min_rad), abs(joint.position_max_rad))
    if furthest / position_rad >= _COUNTS:
        report(
            Severity.ERROR,
            f"one unit of position would be {position_rad:.3g} rad at the joint: the limits do not fit 32 bits",
            "correct 60A8, 6092 or 608F with the vendor's tool, or give `position_units_per_revolution` (of the joint)",
        )


def _polarity(facts: Facts, position_rad: float, report: Report) -> None:
    reversed_ = facts.polarity & (_POSITION_REVERSED | _VELOCITY_REVERSED)
    if reversed_ in (_POSITION_REVERSED, _VELOCITY_REVERSED):
        report(
            Severity.ERROR,
            f"position and velocity run against each other (607E = {facts.polarity:#04x})",
            "set both or none of bits 7 and 6 of 607E with the vendor's tool",
        )
    elif reversed_:
        report(
            Severity.WARNING,
            f"position and velocity are turned (607E = {facts.polarity:#04x}); a motion shows whether torque is",
        )
    if facts.home_offset:
        report(
            Severity.WARNING,
            f"positions are shifted by a home offset of {format_angle(facts.home_offset * position_rad)} (607C)",
        )


def unit_rad(code: int) -> float | None:
    """One unit of 60A8, rad of its shaft; None for increments and all that is no angle.

    Source: object 60A8: byte 3 is the SI prefix as a signed power of ten, byte 2 the unit.
    """
    angle = _ANGLES.get(code >> 16 & 0xFF)
    return None if angle is None else _prefix(code) * angle


def velocity_unit_rad_s(code: int) -> float | None:
    """One unit of 60A9, rad/s of its shaft; None for a unit that is no angle per time.

    Source: object 60A9: byte 3 is the SI prefix as a signed power of ten, byte 2 the angle, byte 1 the time.
    """
    angle, time_s = _ANGLES.get(code >> 16 & 0xFF), _TIMES.get(code >> 8 & 0xFF)
    return None if angle is None or time_s is None else _prefix(code) * angle / time_s


def _prefix(code: int) -> float:
    power = code >> 24 & 0xFF
    return float(10.0 ** (power - 256 if power > 127 else power))


def _gear(facts: Facts, joint: JointSetup, report: Report) -> bool:
    """True where the driving shaft of 6091 is the joint itself."""
    if facts.gear is None:
        return False
    told = facts.gear[0] / facts.gear[1]
    if abs(told / joint.gear_ratio - 1.0) <= RATIO_TOLERANCE:
        return True
    if facts.gear[0] == facts.gear[1]:
        report(
            Severity.WARNING,
            f"the drive does not know the gear (6091 is 1:1); the robot file's {joint.gear_ratio:g} is used",
        )
        return False
    report(
        Severity.ERROR,
        f"gear ratio is {joint.gear_ratio:g} in the robot file and {told:g} in the drive "
        f"(6091 = {facts.gear[0]}:{facts.gear[1]})",
        "correct `gear_ratio` in the robot file, or 6091 with the vendor's tool",
    )
    return True


def _position_units(facts: Facts, joint: JointSetup, shafts_per_joint: float, report: Report) -> float:
    """Units per revolution of the joint."""
    given = joint.options.get("position_units_per_revolution")
    if given is not None:
        return float(given)
    if facts.position_unit is not None and (angle := unit_rad(facts.position_unit)) is not None:
        _same_feed(facts, _TURN / angle, report)
        return _TURN / angle * shafts_per_joint
    if facts.quirks.position_unit_deg is not None:
        return 360.0 / facts.quirks.position_unit_deg
    if facts.feed is not None and facts.feed[0] != facts.feed[1]:
        return facts.feed[0] / facts.feed[1] * shafts_per_joint
    if facts.encoder is not None:
        # Increments are counted at the motor, whichever shaft 6091 speaks of.
        if facts.feed is not None:
            report(
                Severity.WARNING,
                f"6092 is {facts.feed[0]}:{facts.feed[1]}, as it leaves the factory: positions are taken for encoder "
                "increments (608F); the first motion shows whether they are",
            )
        return facts.encoder[0] / facts.encoder[1] * joint.gear_ratio
    report(
        Severity.ERROR,
        "the drive tells neither its position unit (60A8), nor its feed constant (6092), nor its encoder (608F)",
        "give `position_units_per_revolution` (of the joint) in the joint's options",
    )
    return 1e6


def _same_feed(facts: Facts, units_per_turn: float, report: Report) -> None:
    """6092 says the same as 60A8, or is as it left the factory."""
    if facts.feed is None or facts.feed[0] == facts.feed[1]:
        return
    fed = facts.feed[0] / facts.feed[1]
    if abs(fed / units_per_turn - 1.0) > RATIO_TOLERANCE:
        report(
            Severity.ERROR,
            f"its units contradict each other: 60A8 makes {units_per_turn:g} units of one revolution, "
            f"6092 makes {fed:g} ({facts.feed[0]}:{facts.feed[1]})",
            "correct one of them with the vendor's tool, or give `position_units_per_revolution` (of the joint)",
        )


def _velocity_unit(
    facts: Facts, joint: JointSetup, code: int | None, shafts_per_joint: float, position_rad: float, report: Report
) -> float:
    given = joint.options.get("velocity_unit_rad_s")
    told = None if code is None else velocity_unit_rad_s(code)
    quirk = facts.quirks.velocity_unit
    if given is not None:
        unit = float(given)
    elif told is not None:
        unit = told / shafts_per_joint
    elif isinstance(quirk, int | float):
        unit = float(quirk) / joint.gear_ratio
    elif quirk == "rpm":
        unit = _RPM / joint.gear_ratio
    elif quirk is not None:
        unit = position_rad * (0.1 if str(quirk).startswith("tenth") else 1.0)
    else:
        said = "has no 60A9" if code is None else f"has a velocity unit (60A9 = {code:#010x}) that is no angle per time"
        report(
            Severity.WARNING if code is None else Severity.ERROR,
            f"the drive {said}: velocity is taken for position units per second; the first motion shows whether it is",
            "give `velocity_unit_rad_s` (joint side) in the joint's options",
        )
        unit = position_rad
    if unit > COARSE_VELOCITY_RAD_S:
        report(
            Severity.WARNING,
            f"one unit of velocity is {unit:.3g} rad/s at the joint: too coarse for the low end of a friction curve",
            "set 60A9 to 0.001 rpm (FDB44700h) where the drive allows it; velocity from position is used either way",
        )
    return unit


def _rated_torque(facts: Facts, joint: JointSetup, report: Report) -> float:
    if not facts.rated_torque_mnm:
        report(
            Severity.WARNING,
            f"the drive tells no rated torque (6076); the robot file's {joint.rated_torque_nm:g} N m is used",
        )
        return joint.rated_torque_nm
    motor_side = facts.rated_torque_mnm * 1e-3
    at_joint = joint.options.get("rated_torque_side", "motor") == "joint"
    rated = motor_side if at_joint else motor_side * joint.gear_ratio
    if abs(rated / joint.rated_torque_nm - 1.0) > RATED_TOLERANCE:
        hint = "correct `rated_torque_nm` in the robot file, or 6076 with the vendor's tool"
        if not at_joint and abs(motor_side / joint.rated_torque_nm - 1.0) <= RATED_TOLERANCE:
            hint = "6076 seems to be on the joint side here: set `rated_torque_side: joint` in the joint's options"
        report(
            Severity.ERROR,
            f"rated torque is {joint.rated_torque_nm:g} N m in the robot file and {rated:g} N m in the drive "
            f"(6076 = {facts.rated_torque_mnm} mN m, gear {joint.gear_ratio:g})",
            hint,
        )
    return rated


def raise_on_error(findings: list[Finding]) -> None:
    """Turn the first ERROR into an exception.

    Raises:
        HardwareError: with the finding's words.
    """
    for finding in findings:
        if finding.severity is Severity.ERROR:
            raise HardwareError(finding.message, where=finding.subject, next_step=finding.next_step)
