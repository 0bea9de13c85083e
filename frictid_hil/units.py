"""Units as people type and read them; inside, everything is rad, rad/s, N m, s, degC (m, m/s, N on a prismatic axis).

``parse_quantity("20deg", "angle")`` gives radians; a number without its unit is an error that lists the units it
could have had.
"""

from __future__ import annotations

import math
import re

from frictid_hil.errors import UsageError

_DEG = math.pi / 180.0

_UNITS: dict[str, dict[str, float]] = {
    "angle": {"deg": _DEG, "rad": 1.0, "mrad": 1e-3},
    "angular velocity": {"deg/s": _DEG, "rad/s": 1.0, "rpm": 2 * math.pi / 60, "mrad/s": 1e-3},
    "length": {"m": 1.0, "mm": 1e-3, "um": 1e-6},
    "speed": {"m/s": 1.0, "mm/s": 1e-3},
    "torque": {"Nm": 1.0, "N m": 1.0, "mNm": 1e-3},
    "force": {"N": 1.0, "kN": 1e3},
    "duration": {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0},
    "frequency": {"Hz": 1.0, "kHz": 1e3},
    "stiffness": {"Nm/rad": 1.0, "N m/rad": 1.0, "Nm/deg": 1.0 / _DEG, "N m/deg": 1.0 / _DEG},
}

_QUANTITY = re.compile(r"^\s*([+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*$", re.ASCII)


def parse_quantity(text: str, dimension: str) -> float:
    """Convert a typed quantity, e.g. ``20deg``, ``115 deg/s``, ``0.5s``, to the SI unit of its dimension.

    Raises:
        UsageError: not a finite number, no unit, or a unit of another dimension.
    """
    units = _UNITS[dimension]
    known, example = ", ".join(units), f"write it as e.g. 20{next(iter(units))}"
    match = _QUANTITY.match(text)
    if match is None:
        raise UsageError(f"{text!r} is not a number with a unit; {dimension} takes {known}", next_step=example)
    number, unit = match.groups()
    if not unit:
        raise UsageError(f"{text!r} has no unit; {dimension} takes {known}", next_step=example)
    if unit not in units:
        raise UsageError(f"{text!r}: {unit!r} is not a unit of {dimension}; it takes {known}", next_step=example)
    value = float(number) * units[unit]
    if not math.isfinite(value):
        raise UsageError(f"{text!r} is not a finite number")
    return value


def format_figure(value: float | None, form: str = ".4g", unit: str = "", unknown: str = "") -> str:
    """A figure with its unit, or what is told where it is None."""
    return unknown if value is None else f"{value:{form}} {unit}".rstrip()


def degrees(angle_rad: float) -> float:
    """Radians to degrees."""
    return angle_rad / _DEG


def radians(angle_deg: float) -> float:
    """Degrees to radians."""
    return angle_deg * _DEG


def format_angle(angle_rad: float) -> str:
    """An angle as a person reads it: ``20.0 deg``."""
    return f"{angle_rad / _DEG:.4g} deg"


def format_velocity(velocity_rad_s: float) -> str:
    """An angular velocity as a person reads it: ``115 deg/s``."""
    return f"{velocity_rad_s / _DEG:.4g} deg/s"


def format_torque(torque_nm: float) -> str:
    """A torque as a person reads it: ``12.3 N m``."""
    return f"{torque_nm:.4g} N m"


def format_duration(duration_s: float) -> str:
    """A duration as a person reads it: ``96.0 s``, ``2 min 05 s``, ``until interrupted``."""
    if math.isinf(duration_s):
        return "until interrupted"
    if duration_s < 120:
        return f"{duration_s:.1f} s"
    minutes, seconds = divmod(round(duration_s), 60)
    return f"{minutes} min {seconds:02d} s"
