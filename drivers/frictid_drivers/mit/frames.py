"""The frame that all MIT-mode actuators share, and the ranges without which it means nothing.

Position, velocity, gains and torque travel as fractions of ranges that are set in the motor; nothing on the wire says
which. Layout of a command, most significant bit first: position 16, velocity 12, kp 12, kd 12, torque 12.
"""

from __future__ import annotations

from dataclasses import dataclass

FULL = 0xFFFF
TWELVE = 0xFFF


@dataclass(frozen=True, slots=True)
class Ranges:
    """What the ends of the number ranges mean; position, velocity and torque are symmetric, gains begin at 0."""

    position_rad: float
    velocity_rad_s: float
    torque_nm: float
    kp_nm_per_rad: float = 500.0
    kd_nm_s_per_rad: float = 5.0


@dataclass(frozen=True, slots=True)
class Motion:
    """What an actuator is told in its own direction: torque = kp (p - p_now) + kd (v - v_now) + torque."""

    position_rad: float = 0.0
    velocity_rad_s: float = 0.0
    kp_nm_per_rad: float = 0.0
    kd_nm_s_per_rad: float = 0.0
    torque_nm: float = 0.0


def to_number(value: float, low: float, high: float, most: int) -> int:
    """The nearest of the numbers 0..most that stand for low..high; the makers' own code truncates."""
    return min(max(round((value - low) / (high - low) * most), 0), most)


def to_value(number: int, low: float, high: float, most: int) -> float:
    """What a number stands for."""
    return low + number * (high - low) / most


def step(end: float, most: int) -> float:
    """One number's worth of a symmetric range."""
    return 2.0 * end / most


def _spans(ranges: Ranges, most: int) -> tuple[tuple[float, float, int], ...]:
    """Lowest and highest value of position (16 bits), velocity, kp, kd and torque, and their highest number."""
    return (
        (-ranges.position_rad, ranges.position_rad, FULL),
        (-ranges.velocity_rad_s, ranges.velocity_rad_s, most),
        (0.0, ranges.kp_nm_per_rad, most),
        (0.0, ranges.kd_nm_s_per_rad, most),
        (-ranges.torque_nm, ranges.torque_nm, most),
    )


def command_numbers(motion: Motion, ranges: Ranges, most: int) -> tuple[int, ...]:
    """The numbers of position (16 bits), velocity, kp, kd and torque (0..most)."""
    told = (motion.position_rad, motion.velocity_rad_s, motion.kp_nm_per_rad, motion.kd_nm_s_per_rad, motion.torque_nm)
    return tuple(to_number(value, *span) for value, span in zip(told, _spans(ranges, most), strict=True))


def motion_of(p: int, v: int, kp: int, kd: int, t: int, ranges: Ranges, most: int) -> Motion:
    """The reverse of ``command_numbers``."""
    return Motion(*(to_value(n, *span) for n, span in zip((p, v, kp, kd, t), _spans(ranges, most), strict=True)))


def report_of(p: int, v: int, t: int, ranges: Ranges, most: int) -> tuple[float, float, float]:
    """Position, velocity and torque that an answer's numbers stand for."""
    position, velocity, _, _, torque = _spans(ranges, most)
    return to_value(p, *position), to_value(v, *velocity), to_value(t, *torque)


def pack_motion(motion: Motion, ranges: Ranges) -> bytes:
    """The eight bytes of a command."""
    p, v, kp, kd, t = command_numbers(motion, ranges, TWELVE)
    return (p << 48 | v << 36 | kp << 24 | kd << 12 | t).to_bytes(8, "big")


def unpack_motion(data: bytes, ranges: Ranges) -> Motion:
    """The command in eight bytes."""
    word = int.from_bytes(data, "big")
    velocity, kp, kd, torque = (word >> at & TWELVE for at in (36, 24, 12, 0))
    return motion_of(word >> 48, velocity, kp, kd, torque, ranges, TWELVE)


def pack_report(position_rad: float, velocity_rad_s: float, torque_nm: float, ranges: Ranges) -> bytes:
    """The five bytes of position 16, velocity 12, torque 12 that answers carry."""
    p, v, _, _, t = command_numbers(Motion(position_rad, velocity_rad_s, torque_nm=torque_nm), ranges, TWELVE)
    return (p << 24 | v << 12 | t).to_bytes(5, "big")


def unpack_report(data: bytes, ranges: Ranges) -> tuple[float, float, float]:
    """Position, velocity and torque of five bytes."""
    word = int.from_bytes(data[:5], "big")
    return report_of(word >> 24, word >> 12 & TWELVE, word & TWELVE, ranges, TWELVE)
