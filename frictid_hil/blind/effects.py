"""How the twenty named effects are drawn: from a healthy joint, the plant in which one effect acts.

Ranges are physical, from well below the noise of most joints to what a technician would call broken. ``peak_nm`` is
the largest torque the healthy joint asked for in its experiments; only saturation needs it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from frictid_hil.blind import plant
from frictid_hil.blind.joints import Joint, either_sign, log_uniform
from frictid_hil.blind.plant import Physics

Draw = Callable[[np.random.Generator, Joint, float], Physics]


def stribeck(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """Friction is higher near rest and weakens with speed."""
    return joint.physics._replace(
        weakening=joint.physics.coulomb * log_uniform(rng, 0.02, 0.6),
        weakening_velocity=log_uniform(rng, 0.02, 0.15),
        weakening_kind=int(rng.integers(3)),
    )


def viscous_nonlinearity(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """The rate curve bends where the belief has straight lines."""
    p, speed = joint.physics, joint.envelope.velocity_rad_s
    size = (joint.friction_at_speed_nm - p.coulomb) * log_uniform(rng, 0.05, 0.8)
    kind = int(rng.integers(3))
    if kind == plant.RATE_POWER:
        power = float(rng.choice([rng.uniform(0.4, 0.65), rng.uniform(1.7, 2.6)]))
        sign = 1.0 if power < 1.0 else float(rng.choice([-1.0, 1.0]))
        size *= 0.6 if sign < 0 else 1.0
        return p._replace(rate_extra=sign * size, rate_velocity=speed, rate_power=power, rate_kind=kind)
    return p._replace(rate_extra=size, rate_velocity=speed * rng.uniform(0.2, 0.5), rate_kind=kind)


def direction_asymmetry(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """Friction differs between the two directions."""
    size = either_sign(rng, 0.01, 0.25)
    return joint.physics._replace(asymmetry_coulomb=size, asymmetry_viscous=size * rng.uniform(0.3, 1.2))


def load_dependent_friction(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """Coulomb friction grows with the torque that the gear transmits."""
    return joint.physics._replace(
        load_share=log_uniform(rng, 0.01, 0.2),
        load_scale=joint.physics.gravity,
        load_kind=int(rng.integers(2)),
    )


def torque_ripple(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """A torque that repeats with the motor angle."""
    return joint.physics._replace(
        ripple=joint.physics.coulomb * log_uniform(rng, 0.008, 0.25),
        ripple_harmonic=float(rng.choice([1, 2, 4], p=[0.3, 0.5, 0.2])),
        ripple_phase=rng.uniform(0.0, 2 * math.pi),
        ripple_sharpness=rng.uniform(0.2, 0.7),
    )


def presliding_hysteresis(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """Part of the friction comes back only over milliradians after a reversal."""
    return joint.physics._replace(soft_share=log_uniform(rng, 0.04, 0.6), soft_length=log_uniform(rng, 0.002, 0.02))


def stiction_breakaway(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """Friction at rest grows with the logarithm of the dwell and is gone after a short slip."""
    return joint.physics._replace(
        ageing=joint.physics.coulomb * log_uniform(rng, 0.05, 0.7),
        ageing_time=log_uniform(rng, 0.15, 0.6),
        ageing_length=log_uniform(rng, 4e-4, 3e-3),
    )


def backlash(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """Play between motor and link, stiff beyond it."""
    inertia = joint.physics.link_inertia
    stiffness = inertia * (2 * math.pi * rng.uniform(55.0, 80.0)) ** 2
    return joint.physics._replace(
        play=log_uniform(rng, 4e-4, 1.5e-2),
        stiffness=stiffness,
        coupling_damping=2.0 * rng.uniform(0.05, 0.12) * math.sqrt(stiffness * inertia),
    )


def joint_elasticity(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """The gear twists under load."""
    inertia = joint.physics.link_inertia
    stiffness = inertia * (2 * math.pi * log_uniform(rng, 6.0, 40.0)) ** 2
    twist = joint.rated_torque_nm / stiffness
    return joint.physics._replace(
        stiffness=stiffness,
        hardening=rng.uniform(0.0, 0.3) / twist**2,
        coupling_damping=2.0 * rng.uniform(0.02, 0.06) * math.sqrt(stiffness * inertia),
    )


def torque_delay(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """Commands take effect late."""
    return joint.physics._replace(delay=log_uniform(rng, 5e-4, 1.4e-2))


def torque_constant_error(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """The joint gets more or less torque than the drive reports."""
    return joint.physics._replace(gain=1.0 + either_sign(rng, 0.008, 0.15))


def torque_saturation(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """The drive runs out of torque below the limit that the belief gives it, with a rounded knee."""
    holding = joint.physics.gravity + joint.payload.gravity_nm + 1.15 * joint.physics.coulomb
    lowest = min(max(0.65 * peak_nm, 1.2 * holding), 0.92 * peak_nm)
    return joint.physics._replace(ceiling=rng.uniform(lowest, 1.02 * peak_nm), ceiling_knee=rng.uniform(10.0, 30.0))


def velocity_lag(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """The drive's velocity is late: a two-pole filter or a moving average."""
    return joint.physics._replace(estimate_lag=log_uniform(rng, 6e-4, 1.2e-2), estimate_kind=int(rng.integers(2)))


def encoder_quantisation(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """The encoder resolves less than the belief says."""
    # One step of a coarse encoder must not shake the joint through the controller's differentiator.
    coarsest = 0.3 * joint.rated_torque_nm * plant.TICK_S / joint.control.kd
    factor = 2.0 ** float(rng.integers(3, 10))
    while factor > 2.0 and factor * joint.physics.encoder_step > coarsest:
        factor /= 2.0
    return joint.physics._replace(encoder_step=joint.physics.encoder_step * factor)


def encoder_offset(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """Zero of the encoder is not where the belief has it: gravity acts at another angle."""
    return joint.physics._replace(gravity_angle=either_sign(rng, 0.005, 0.2))


def gravity_error(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """The link weighs more or less than believed."""
    return joint.physics._replace(gravity=joint.physics.gravity * (1.0 + either_sign(rng, 0.015, 0.25)))


def inertia_error(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """The link has more or less inertia than believed."""
    return joint.physics._replace(link_inertia=joint.physics.link_inertia * (1.0 + either_sign(rng, 0.03, 0.4)))


def temperature_drift(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """Friction falls as the joint heats itself by friction, over all experiments."""
    typical_w = joint.friction_at_speed_nm * 0.25 * joint.envelope.velocity_rad_s
    heat_time = log_uniform(rng, 20.0, 150.0)
    return joint.physics._replace(
        cooling=log_uniform(rng, 0.03, 0.6), heating=1.0 / (typical_w * heat_time), heat_time=heat_time
    )


def torque_bias(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """A constant torque acts on the joint."""
    return joint.physics._replace(bias=joint.physics.coulomb * either_sign(rng, 0.015, 0.35))


def electrical_lag(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """Torque follows its command through a first-order lag, with or without a small second pole."""
    lag = log_uniform(rng, 7e-4, 1.2e-2)
    return joint.physics._replace(lag=lag, second_lag=float(rng.choice([0.0, 0.1])) * lag)


LIBRARY: dict[str, Draw] = {
    draw.__name__: draw
    for draw in (
        stribeck,
        viscous_nonlinearity,
        direction_asymmetry,
        load_dependent_friction,
        torque_ripple,
        presliding_hysteresis,
        stiction_breakaway,
        backlash,
        joint_elasticity,
        torque_delay,
        torque_constant_error,
        torque_saturation,
        velocity_lag,
        encoder_quantisation,
        encoder_offset,
        gravity_error,
        inertia_error,
        temperature_drift,
        torque_bias,
        electrical_lag,
    )
}
"""Every effect name of the diagnosis, with its draw."""
