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
from dataclasses import dataclass

from frictid_drivers.cia402.facts import Facts
from frictid_hil.errors import HardwareError
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import Finding, Severity
from frictid_hil.units import format_angle

_TURN = 2.0 * math.pi
_ANGLES = {0xB4: _TURN, 0x10: 1.0, 0x41: math.pi / 180.0}  # revolution, radian, degree in 60A8 and 60A9
_TIMES = {0x03: 1.0, 0x47: 60.0}  # 60A9 denominators: second, minute
_RPM = _TURN / 60.0
_POSITION_REVERSED, _VELOCITY_REVERSED = 0x80, 0x40

RATIO_TOLERANCE = 0.005
RATED_TOLERANCE = 0.01
COARSE_VELOCITY_RAD_S = 0.001  # a joint-side velocity step above this blurs the low end of a friction curve
COARSE_POSITION_RAD = math.radians(0.02)
"""A joint-side position step above this is absurd: no friction shows in a velocity formed from it."""
_COUNTS = 1 << 31


@dataclass(frozen=True, slots=True)
class Scale:
    """What one unit of the drive is worth on the joint side; signs carry the joint's direction."""

    position_rad: float  # of 6064, 607A, 607D
    velocity_rad_s: float  # of 606C, 60FF
    torque_nm: float  # of 6077, 6071, 6072, 60B2
    rated_torque_nm: float  # what 1000 per mille are, always positive
    gear_ratio: float


def scale_of(facts: Facts, joint: JointSetup, velocity_unit: int | None) -> tuple[Scale, list[Finding]]:
    """Joint-side factors from the drive's figures, and what does not fit the robot file; an ERROR forbids motion.

    ``velocity_unit`` is 60A9 as it is or will be set, None where there is none. Options override what a drive says
    wrongly or not at all: ``position_units_per_revolution`` (of the joint), ``velocity_unit_rad_s`` (joint side) and
    ``rated_torque_side: joint``.
    """
    doubts = _Doubts(f"joint {joint.name}")
    shafts_per_joint = 1.0 if _shaft_is_joint(facts, joint, doubts) else joint.gear_ratio
    position = _TURN / _position_units(facts, joint, shafts_per_joint, doubts)
    velocity = _velocity_unit(facts, joint, velocity_unit, shafts_per_joint, position, doubts)
    rated = _rated_torque(facts, joint, doubts)
    unit_mnm = facts.quirks.torque_unit_mnm
    torque = rated / 1000.0 if unit_mnm is None else unit_mnm * 1e-3 * joint.gear_ratio
    sign = float(joint.direction)
    _resolution(joint, position, doubts)
    _polarity(facts, position, doubts)
    return Scale(sign * position, sign * velocity, sign * torque, rated, joint.gear_ratio), doubts.findings


class _Doubts:
    """What does not fit the robot file, as findings."""

    def __init__(self, subject: str) -> None:
        self._subject = subject
        self.findings: list[Finding] = []

    def error(self, message: str, next_step: str) -> None:
        self.findings.append(Finding(Severity.ERROR, self._subject, message, next_step))

    def warning(self, message: str, next_step: str = "") -> None:
        self.findings.append(Finding(Severity.WARNING, self._subject, message, next_step))


def _resolution(joint: JointSetup, position_rad: float, doubts: _Doubts) -> None:
    cure = "correct 60A8, 6092 or 608F with the vendor's tool, or give `position_units_per_revolution` (of the joint)"
    would = "one unit of position would be"
    if position_rad > COARSE_POSITION_RAD:
        doubts.error(f"{would} {format_angle(position_rad)} at the joint: absurdly coarse", cure)
    if max(abs(joint.position_min_rad), abs(joint.position_max_rad)) / position_rad >= _COUNTS:
        doubts.error(f"{would} {position_rad:.3g} rad at the joint: the limits do not fit 32 bits", cure)


def _polarity(facts: Facts, position_rad: float, doubts: _Doubts) -> None:
    reversed_ = facts.polarity & (_POSITION_REVERSED | _VELOCITY_REVERSED)
    if reversed_ in (_POSITION_REVERSED, _VELOCITY_REVERSED):
        doubts.error(
            f"position and velocity run against each other (607E = {facts.polarity:#04x})",
            "set both or none of bits 7 and 6 of 607E with the vendor's tool",
        )
    elif reversed_:
        doubts.warning(
            f"position and velocity are turned (607E = {facts.polarity:#04x}); a motion shows whether torque is",
        )
    if facts.home_offset:
        doubts.warning(
            f"positions are shifted by a home offset of {format_angle(facts.home_offset * position_rad)} (607C)",
        )


def unit_rad(code: int) -> float | None:
    """One unit of 60A8 (byte 3: signed power of ten, byte 2: unit), rad of its shaft; None for all that is no angle."""
    angle, power = _ANGLES.get(code >> 16 & 0xFF), code >> 24 & 0xFF
    return None if angle is None else 10.0 ** (power - 256 if power > 127 else power) * angle


def velocity_unit_rad_s(code: int) -> float | None:
    """One unit of 60A9 (as 60A8, byte 1 the time), rad/s of its shaft; None for a unit that is no angle per time."""
    angle, time_s = unit_rad(code), _TIMES.get(code >> 8 & 0xFF)
    return None if angle is None or time_s is None else angle / time_s


def _shaft_is_joint(facts: Facts, joint: JointSetup, doubts: _Doubts) -> bool:
    """True where the driving shaft of 6091 is the joint itself."""
    if facts.gear is None:
        return False
    told = facts.gear[0] / facts.gear[1]
    if abs(told / joint.gear_ratio - 1.0) <= RATIO_TOLERANCE:
        return True
    if facts.gear[0] == facts.gear[1]:
        doubts.warning(
            f"the drive does not know the gear (6091 is 1:1); the robot file's {joint.gear_ratio:g} is used",
        )
        return False
    doubts.error(
        f"gear ratio is {joint.gear_ratio:g} in the robot file and {told:g} in the drive "
        f"(6091 = {facts.gear[0]}:{facts.gear[1]})",
        "correct `gear_ratio` in the robot file, or 6091 with the vendor's tool",
    )
    return True


def _position_units(facts: Facts, joint: JointSetup, shafts_per_joint: float, doubts: _Doubts) -> float:
    """Units per revolution of the joint."""
    given = joint.options.get("position_units_per_revolution")
    if given is not None:
        return float(given)
    if facts.position_unit is not None and (angle := unit_rad(facts.position_unit)) is not None:
        _same_feed(facts, _TURN / angle, doubts)
        return _TURN / angle * shafts_per_joint
    if facts.quirks.position_unit_deg is not None:
        return 360.0 / facts.quirks.position_unit_deg
    if facts.feed is not None and facts.feed[0] != facts.feed[1]:
        return facts.feed[0] / facts.feed[1] * shafts_per_joint
    if facts.encoder is not None:
        # Increments are counted at the motor, whichever shaft 6091 speaks of.
        if facts.feed is not None:
            doubts.warning(
                f"6092 is {facts.feed[0]}:{facts.feed[1]}, as it leaves the factory: positions are taken for encoder "
                "increments (608F); the first motion shows whether they are",
            )
        return facts.encoder[0] / facts.encoder[1] * joint.gear_ratio
    doubts.error(
        "the drive tells neither its position unit (60A8), nor its feed constant (6092), nor its encoder (608F)",
        "give `position_units_per_revolution` (of the joint) in the joint's options",
    )
    return 1e6


def _same_feed(facts: Facts, units_per_turn: float, doubts: _Doubts) -> None:
    """6092 says the same as 60A8, or is as it left the factory."""
    if facts.feed is None or facts.feed[0] == facts.feed[1]:
        return
    fed = facts.feed[0] / facts.feed[1]
    if abs(fed / units_per_turn - 1.0) > RATIO_TOLERANCE:
        doubts.error(
            f"its units contradict each other: 60A8 makes {units_per_turn:g} units of one revolution, "
            f"6092 makes {fed:g} ({facts.feed[0]}:{facts.feed[1]})",
            "correct one of them with the vendor's tool, or give `position_units_per_revolution` (of the joint)",
        )


def _velocity_unit(
    facts: Facts, joint: JointSetup, code: int | None, shafts_per_joint: float, position_rad: float, doubts: _Doubts
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
        (doubts.warning if code is None else doubts.error)(
            f"the drive {said}: velocity is taken for position units per second; the first motion shows whether it is",
            "give `velocity_unit_rad_s` (joint side) in the joint's options",
        )
        unit = position_rad
    if unit > COARSE_VELOCITY_RAD_S:
        doubts.warning(
            f"one unit of velocity is {unit:.3g} rad/s at the joint: too coarse for the low end of a friction curve",
            "set 60A9 to 0.001 rpm (FDB44700h) where the drive allows it; velocity from position is used either way",
        )
    return unit


def _rated_torque(facts: Facts, joint: JointSetup, doubts: _Doubts) -> float:
    if not facts.rated_torque_mnm:
        doubts.warning(
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
        doubts.error(
            f"rated torque is {joint.rated_torque_nm:g} N m in the robot file and {rated:g} N m in the drive "
            f"(6076 = {facts.rated_torque_mnm} mN m, gear {joint.gear_ratio:g})",
            hint,
        )
    return rated


def raise_on_error(findings: list[Finding]) -> None:
    """``HardwareError`` in the words of the first ERROR."""
    for finding in findings:
        if finding.severity is Severity.ERROR:
            raise HardwareError(finding.message, where=finding.subject, next_step=finding.next_step)
