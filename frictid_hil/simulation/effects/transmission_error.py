"""A gear whose ratio breathes with the motor's angle: the kinematic error of a harmonic drive."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Parting, Region, Signature
from frictid_hil.simulation.inverse import InverseForm, Shape, View, periodic_lines


def friction(
    other_nm: float,
    velocity_rad_s: float,
    position_rad: float,
    load_nm: float,
    link_kg_m2: float,
    acceleration_rad_s2: float,
    gear_ratio: float,
    amplitude_rad: float,
    cycles_per_motor_revolution: float,
    phase_rad: float,
    second_amplitude_rad: float,
    second_cycles_per_motor_revolution: float,
    second_phase_rad: float,
) -> float:
    """What the link, pushed ahead and held back by the error e(q), does to the motor."""
    if amplitude_rad == 0.0 and second_amplitude_rad == 0.0:
        return other_nm
    first = cycles_per_motor_revolution * gear_ratio
    second = second_cycles_per_motor_revolution * gear_ratio
    first_rad = first * position_rad + phase_rad
    second_rad = second * position_rad + second_phase_rad
    slope = -amplitude_rad * first * math.sin(first_rad) - second_amplitude_rad * second * math.sin(second_rad)
    bend = -amplitude_rad * first * first * math.cos(first_rad)
    bend -= second_amplitude_rad * second * second * math.cos(second_rad)
    pushed_nm = link_kg_m2 * (slope * acceleration_rad_s2 + bend * velocity_rad_s * velocity_rad_s)
    return other_nm + slope * load_nm + pushed_nm


def regressors(views: Sequence[View], shape: Shape) -> list[Array]:
    """The reaction per radian of the error's cosine and sine, for the multiples that the shape names."""
    columns = []
    for v in views:
        link = v.link_inertia_kg_m2 + v.payload_inertia_kg_m2
        per_slope = v.load_nm + link * v.acceleration_rad_s2
        per_bend = link * v.velocity_rad_s**2
        parts = []
        for cycles in shape.values():
            turns = cycles * v.gear_ratio
            cos, sin = np.cos(turns * v.position_rad), np.sin(turns * v.position_rad)
            parts += [-turns * sin * per_slope - turns**2 * cos * per_bend]
            parts += [turns * cos * per_slope - turns**2 * sin * per_bend]
        columns.append(np.stack(parts, axis=1))
    return columns


def _illustrate(p: Mapping[str, float]) -> Illustration:
    turns = np.linspace(0.0, 2.0, 400)
    motor_rad = 2.0 * np.pi * turns
    error = p["amplitude_rad"] * np.cos(motor_rad * p["cycles_per_motor_revolution"] + p["phase_rad"])
    second_rad = motor_rad * p["second_cycles_per_motor_revolution"] + p["second_phase_rad"]
    error = error + p["second_amplitude_rad"] * np.cos(second_rad)
    return Illustration("motor revolutions", "error (rad)", (("error", turns, error),))


EFFECT = Effect(
    name="transmission_error",
    summary="The gear's ratio breathes with the motor's angle.",
    documentation=(
        "The link stands at q + e(q), e a line or two in the motor's angle: e = amplitude * cos(k * gear_ratio * q + "
        "phase), twice per motor revolution in a harmonic drive, some 1e-4 rad. The link is pushed ahead and held "
        "back, so the motor feels e' * tau_L + J_L * (e' * acc + e'' * v^2): a ripple that grows with speed squared, "
        "where a torque ripple does not. Sources: F. Ghorbel, P. Gandhi, F. Alpeter, 'On the kinematic error in "
        "harmonic drive gears', J. Mechanical Design 123, 2001; T. D. Tuttle, W. P. Seering, IEEE Trans. Robotics and "
        "Automation 12(3), 1996."
    ),
    parameters=(
        Parameter("amplitude_rad", 0.0, 0.05, 1e-4, "amplitude, joint side", off=0.0),
        Parameter("cycles_per_motor_revolution", 0.5, 64.0, 2.0, "spatial frequency k", replayed=False),
        Parameter("phase_rad", -6.2832, 6.2832, 0.0, "phase at joint position 0"),
        Parameter("second_amplitude_rad", 0.0, 0.05, 3e-5, "amplitude of a second line, joint side", off=0.0),
        Parameter("second_cycles_per_motor_revolution", 0.5, 64.0, 4.0, "its spatial frequency", replayed=False),
        Parameter("second_phase_rad", -6.2832, 6.2832, 0.0, "its phase at joint position 0"),
    ),
    signature=Signature((Channel.PLANT,), (Region.POSITION, Region.FREQUENCY, Region.ACCELERATION)),
    hooks=(Hook("friction", friction),),
    illustrate=_illustrate,
    parted=(Parting("torque_ripple", "sines_large", "an error of the gear grows with speed squared", 15.0),),
    inverse=InverseForm(
        shapes=(
            *({"first": k} for k in (1.0, 2.0, 4.0)),
            {"first": 1.0, "second": 2.0},
            {"first": 2.0, "second": 4.0},
        ),
        regressors=regressors,
        parameters=periodic_lines("rad"),
        continuous=False,
    ),
)
