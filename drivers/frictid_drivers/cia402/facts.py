"""What a drive says of itself, read once and without a single write, and what its integers are worth on the joint side.

Position (6064) is in units of which 6092 says how many make one revolution of the driving shaft; where a drive has no
6092 they are encoder increments (608F). The driving shaft is the joint where the drive knows the gear (6091 equals the
robot file's ratio), and the motor where 6091 is 1:1. Velocity (606C) is in units of 60A9 of that same shaft. Torque
(6077) is in per mille of 6076, which is on the motor side.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from frictid_drivers.cia402 import objects as od
from frictid_hil.errors import HardwareError
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import Finding, Severity

_TURN = 2.0 * math.pi
_ANGLES = {0xB4: _TURN, 0x10: 1.0, 0x41: math.pi / 180.0}
"""60A9 numerators: revolution, radian, degree."""
_TIMES = {0x03: 1.0, 0x47: 60.0}
"""60A9 denominators: second, minute."""

RATIO_TOLERANCE = 0.005
RATED_TOLERANCE = 0.01
COARSE_VELOCITY_RAD_S = 0.001
"""A joint-side velocity step above this blurs the low end of a friction curve."""


@dataclass(frozen=True, slots=True)
class Facts:
    """As read; None where the drive does not have the object."""

    device_type: int
    vendor: int
    product: int
    revision: int
    serial: int
    name: str
    hardware: str
    software: str
    modes: int | None
    rated_torque_mnm: int | None
    encoder: tuple[int, int] | None
    gear: tuple[int, int] | None
    feed: tuple[int, int] | None
    velocity_unit: int | None
    heartbeat_consumers: int | None
    sync_counter: bool
    torque_offset: bool
    target_torque: bool

    def supports(self, mode: int) -> bool:
        """6502 lists the mode; a drive without 6502 is taken at its word when the mode is set."""
        return self.modes is None or bool(self.modes & od.MODE_BITS.get(mode, 0))


class Source(Protocol):
    """What can be asked for objects: a drive, or an EDS file."""

    def read(self, item: od.Object) -> int:
        """A value that must be there."""
        ...

    def find(self, item: od.Object) -> int | None:
        """A value, None where there is none."""
        ...

    def find_text(self, index: int) -> str:
        """A text, "" where there is none."""
        ...


def read_facts(drive: Source) -> Facts:
    """Ask the drive; about thirty uploads, no download.

    Raises:
        HardwareError: no answer.
    """

    def pair(first: od.Object, second: od.Object) -> tuple[int, int] | None:
        a, b = drive.find(first), drive.find(second)
        return (a, b) if a and b else None

    return Facts(
        device_type=drive.find(od.DEVICE_TYPE) or 0,
        vendor=drive.find(od.VENDOR) or 0,
        product=drive.find(od.PRODUCT) or 0,
        revision=drive.find(od.REVISION) or 0,
        serial=drive.find(od.SERIAL) or 0,
        name=drive.find_text(od.DEVICE_NAME),
        hardware=drive.find_text(od.HARDWARE_VERSION),
        software=drive.find_text(od.SOFTWARE_VERSION),
        modes=drive.find(od.SUPPORTED_MODES),
        rated_torque_mnm=drive.find(od.RATED_TORQUE_MNM),
        encoder=pair(od.ENCODER_INCREMENTS, od.ENCODER_REVOLUTIONS),
        gear=pair(od.GEAR_MOTOR, od.GEAR_SHAFT),
        feed=pair(od.FEED, od.FEED_SHAFT),
        velocity_unit=drive.find(od.VELOCITY_UNIT),
        heartbeat_consumers=drive.find(od.HEARTBEAT_CONSUMERS),
        sync_counter=drive.find(od.SYNC_OVERFLOW) is not None and drive.find(od.pdo_sync_start(1)) is not None,
        torque_offset=drive.find(od.TORQUE_OFFSET) is not None,
        target_torque=drive.find(od.TARGET_TORQUE) is not None,
    )


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


def velocity_unit_rad_s(code: int) -> float | None:
    """One unit of 60A9, rad/s of its shaft; None for a unit that is no angle per time.

    Source: object 60A9: byte 3 is the SI prefix as a signed power of ten, byte 2 the angle, byte 1 the time.
    """
    prefix, angle, time_s = code >> 24 & 0xFF, _ANGLES.get(code >> 16 & 0xFF), _TIMES.get(code >> 8 & 0xFF)
    if angle is None or time_s is None:
        return None
    return float(10.0 ** (prefix - 256 if prefix > 127 else prefix) * angle / time_s)


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
    units = _position_units(facts, joint.options, shafts_per_joint, shaft_is_joint, joint.gear_ratio)
    if units is None:
        report(
            Severity.ERROR,
            "the drive tells neither its feed constant (6092) nor its encoder (608F)",
            "give `position_units_per_revolution` (of the joint) in the joint's options",
        )
        units = 1.0
    velocity = _velocity_unit(joint.options, velocity_unit, shafts_per_joint, report)
    rated = _rated_torque(facts, joint, report)
    sign = float(joint.direction)
    return Scale(sign * _TURN / units, sign * velocity, sign * rated / 1000.0, rated, joint.gear_ratio), findings


Report = Callable[..., None]


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


def _position_units(
    facts: Facts, options: Mapping[str, Any], shafts_per_joint: float, shaft_is_joint: bool, gear_ratio: float
) -> float | None:
    given = options.get("position_units_per_revolution")
    if given is not None:
        return float(given)
    if facts.feed is not None:
        return facts.feed[0] / facts.feed[1] * shafts_per_joint
    if facts.encoder is not None:
        # Increments are counted at the motor, whichever shaft 6091 speaks of.
        ratio = facts.gear[0] / facts.gear[1] if shaft_is_joint and facts.gear else gear_ratio
        return facts.encoder[0] / facts.encoder[1] * ratio
    return None


def _velocity_unit(options: Mapping[str, Any], code: int | None, shafts_per_joint: float, report: Report) -> float:
    given = options.get("velocity_unit_rad_s")
    unit = float(given) if given is not None else None
    if unit is None and code is not None:
        shaft = velocity_unit_rad_s(code)
        unit = None if shaft is None else shaft / shafts_per_joint
    if unit is None:
        said = "has no 60A9" if code is None else f"has a velocity unit (60A9 = {code:#010x}) that is no angle per time"
        report(Severity.ERROR, f"the drive {said}", "give `velocity_unit_rad_s` (joint side) in the joint's options")
        return 1.0
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
