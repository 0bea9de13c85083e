"""An identified curve as the table that a controller application interpolates."""

from __future__ import annotations

import math

import numpy as np

from frictid_drivers.motoman.batch_messages import TABLE_POINTS, FrictionTable
from frictid_drivers.motoman.joint_units import AxisUnits
from frictid_hil.friction.curve import FrictionCurve


def friction_table(
    units: AxisUnits,
    curve: FrictionCurve,
    ratio: float,
    stiffness_nm_per_rad: float,
    gravity_cos_nm: float,
    gravity_sin_nm: float,
) -> FrictionTable:
    """21 points from standstill to the fastest identified speed, in the controller's units; see ``download_table``."""
    pulses_per_rad = abs(units.pulses_per_rad)
    fastest_rad_s = curve.measured_range_rad_s[1]
    step_tenths = max(1, round(fastest_rad_s / (TABLE_POINTS - 1) * pulses_per_rad * 10.0))
    speeds_rad_s = np.arange(TABLE_POINTS) * step_tenths * 0.1 / pulses_per_rad
    return FrictionTable(
        axis=units.axis,
        ratio=ratio,
        step_tenths=step_tenths,
        stiffness_nano=max(1, round(stiffness_nm_per_rad / units.gear_ratio / pulses_per_rad * 1e9)),
        turn_pulses=round(2 * math.pi * pulses_per_rad),
        # Where positive pulses turn the joint backwards, torque and angle change sign: cosine flips, sine stays.
        gravity_cos_micro=units.motor_micro(gravity_cos_nm) * units.direction,
        gravity_sin_micro=units.motor_micro(gravity_sin_nm),
        points_micro=[units.motor_micro(float(torque)) for torque in curve.magnitude(speeds_rad_s)],
    )
