"""A torque that repeats with the motor angle: cogging, commutation, wave-generator error."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature

# -- forward: what the joint does ---------------------------------------------------------------------------------


def shaft(
    torque_nm: float,
    position_rad: float,
    gear_ratio: float,
    amplitude_nm: float,
    cycles_per_motor_revolution: float,
    phase_rad: float,
) -> float:
    """What is left of the motor's torque after the ripple has taken its part."""
    if amplitude_nm == 0.0:
        return torque_nm
    return torque_nm - amplitude_nm * math.cos(cycles_per_motor_revolution * gear_ratio * position_rad + phase_rad)


# -- inverse: what a recording shows (used by the diagnosis) ------------------------------------------------------

# -- the effect ---------------------------------------------------------------------------------------------------


def illustrate(parameters: Mapping[str, float]) -> Illustration:
    """Ripple over two motor revolutions."""
    p = EFFECT.complete(parameters or EFFECT.typical)
    turns = np.linspace(0.0, 2.0, 400)
    angle = 2.0 * np.pi * turns * p["cycles_per_motor_revolution"] + p["phase_rad"]
    return Illustration("motor revolutions", "torque (N m)", (("ripple", turns, p["amplitude_nm"] * np.cos(angle)),))


EFFECT = Effect(
    name="torque_ripple",
    summary="A torque that repeats with the motor angle.",
    documentation=(
        "Cogging, commutation and the wave generator of a harmonic drive add a torque periodic in the motor "
        "angle: amplitude * cos(k * gear_ratio * q + phase); k = 2 per motor revolution is the wave generator's "
        "own, 1 an eccentricity, 4 its overtone. The drive must deliver it, so the measured torque carries it. It "
        "shows at slow steady speed, as a line in the spectrum over motor angle. Sources: T. D. Tuttle, W. P. "
        "Seering, 'A nonlinear model of a harmonic drive gear transmission', IEEE Trans. Robotics and Automation "
        "12(3), 1996; F. Ghorbel, P. Gandhi, F. Alpeter, 'On the kinematic error in harmonic drive gears', J. "
        "Mechanical Design 123, 2001."
    ),
    parameters=(
        Parameter("amplitude_nm", 0.0, 50.0, 0.3, "amplitude, joint side", off=0.0),
        Parameter("cycles_per_motor_revolution", 0.5, 64.0, 2.0, "spatial frequency k"),
        Parameter("phase_rad", -6.2832, 6.2832, 0.0, "phase at joint position 0"),
    ),
    signature=Signature((Channel.PLANT,), (Region.POSITION, Region.FREQUENCY)),
    hooks=(Hook("shaft", shaft),),
    illustrate=illustrate,
)
