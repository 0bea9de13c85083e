"""A torque that repeats with the motor angle: cogging, commutation, wave-generator error."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature
from frictid_hil.simulation.inverse import InverseForm, Shape, View

# -- forward: what the joint does ---------------------------------------------------------------------------------


def shaft(
    torque_nm: float,
    position_rad: float,
    gear_ratio: float,
    amplitude_nm: float,
    cycles_per_motor_revolution: float,
    phase_rad: float,
    second_amplitude_nm: float,
    second_cycles_per_motor_revolution: float,
    second_phase_rad: float,
) -> float:
    """What is left of the motor's torque after the ripple has taken its part."""
    if amplitude_nm == 0.0 and second_amplitude_nm == 0.0:
        return torque_nm
    motor_rad = gear_ratio * position_rad
    ripple_nm = amplitude_nm * math.cos(cycles_per_motor_revolution * motor_rad + phase_rad)
    ripple_nm += second_amplitude_nm * math.cos(second_cycles_per_motor_revolution * motor_rad + second_phase_rad)
    return torque_nm - ripple_nm


# -- inverse: what a recording shows (used by the diagnosis) ------------------------------------------------------


def regressors(views: Sequence[View], shape: Shape) -> list[Array]:
    """Cosine and sine of the motor angle's multiples that the shape names."""
    columns = []
    for v in views:
        motor_rad = v.gear_ratio * v.position_rad
        columns.append(np.stack([f(k * motor_rad) for k in shape.values() for f in (np.cos, np.sin)], axis=1))
    return columns


def ripples(shape: Shape, coefficients: Array) -> dict[str, float]:
    """Amplitudes and phases of the one or two lines."""
    found: dict[str, float] = {}
    for index, cycles in enumerate(shape.values()):
        cos, sin = float(coefficients[2 * index]), float(coefficients[2 * index + 1])
        prefix = "second_" if index else ""
        found[f"{prefix}amplitude_nm"] = math.hypot(cos, sin)
        found[f"{prefix}cycles_per_motor_revolution"] = cycles
        found[f"{prefix}phase_rad"] = math.atan2(-sin, cos)
    return found


# -- the effect ---------------------------------------------------------------------------------------------------


def illustrate(parameters: Mapping[str, float]) -> Illustration:
    """Ripple over two motor revolutions."""
    p = EFFECT.complete(parameters or EFFECT.typical)
    turns = np.linspace(0.0, 2.0, 400)
    motor_rad = 2.0 * np.pi * turns
    torque = p["amplitude_nm"] * np.cos(motor_rad * p["cycles_per_motor_revolution"] + p["phase_rad"])
    second_rad = motor_rad * p["second_cycles_per_motor_revolution"] + p["second_phase_rad"]
    torque = torque + p["second_amplitude_nm"] * np.cos(second_rad)
    return Illustration("motor revolutions", "torque (N m)", (("ripple", turns, torque),))


EFFECT = Effect(
    name="torque_ripple",
    summary="A torque that repeats with the motor angle.",
    documentation=(
        "Cogging, commutation and the wave generator of a harmonic drive add a torque periodic in the motor "
        "angle: amplitude * cos(k * gear_ratio * q + phase), one line or two; k = 2 per motor "
        "revolution is the wave generator's "
        "own, 1 an eccentricity, 4 its overtone. The drive must deliver it, so the measured torque carries it. It "
        "shows at slow steady speed, as a line in the spectrum over motor angle. Sources: T. D. Tuttle, W. P. "
        "Seering, 'A nonlinear model of a harmonic drive gear transmission', IEEE Trans. Robotics and Automation "
        "12(3), 1996; F. Ghorbel, P. Gandhi, F. Alpeter, 'On the kinematic error in harmonic drive gears', J. "
        "Mechanical Design 123, 2001."
    ),
    parameters=(
        Parameter("amplitude_nm", 0.0, 50.0, 0.3, "amplitude, joint side", off=0.0),
        Parameter("cycles_per_motor_revolution", 0.5, 64.0, 2.0, "spatial frequency k", replayed=False),
        Parameter("phase_rad", -6.2832, 6.2832, 0.0, "phase at joint position 0"),
        Parameter("second_amplitude_nm", 0.0, 50.0, 0.1, "amplitude of a second line, joint side", off=0.0),
        Parameter("second_cycles_per_motor_revolution", 0.5, 64.0, 4.0, "its spatial frequency", replayed=False),
        Parameter("second_phase_rad", -6.2832, 6.2832, 0.0, "its phase at joint position 0"),
    ),
    signature=Signature((Channel.PLANT,), (Region.POSITION, Region.FREQUENCY)),
    hooks=(Hook("shaft", shaft),),
    illustrate=illustrate,
    inverse=InverseForm(
        shapes=tuple({"first": k} for k in (1.0, 2.0, 4.0))
        + tuple({"first": a, "second": b} for a, b in ((1.0, 2.0), (2.0, 4.0), (1.0, 4.0))),
        regressors=regressors,
        parameters=ripples,
        continuous=False,
    ),
)
