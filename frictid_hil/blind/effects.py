"""How effects are drawn: from a healthy joint, what changes in the plant where one acts.

Ranges are physical, from well below the noise of most joints to what a technician would call broken. ``peak_nm`` is
the largest torque the healthy joint asked for in its experiments; only limits of the drive need it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from frictid_hil.blind import plant
from frictid_hil.blind.joints import Joint, either_sign, log_uniform
from frictid_hil.blind.plant import Physics

Changes = dict[str, Any]  # numbers of ``Physics`` by name
Draw = Callable[[np.random.Generator, Joint, float], Changes]


def _viscous_nonlinearity(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Changes:
    """The rate curve bends where the belief has straight lines."""
    speed = joint.envelope.velocity_rad_s
    size = (joint.friction_at_speed_nm - joint.physics.coulomb) * log_uniform(rng, 0.05, 0.8)
    kind = int(rng.integers(3))
    if kind != plant.RATE_POWER:
        return {"rate_extra": size, "rate_velocity": speed * rng.uniform(0.2, 0.5), "rate_kind": kind}
    power = float(rng.choice([rng.uniform(0.4, 0.65), rng.uniform(1.7, 2.6)]))
    sign = 1.0 if power < 1.0 else float(rng.choice([-1.0, 1.0]))
    size *= 0.6 if sign < 0 else 1.0
    return {"rate_extra": sign * size, "rate_velocity": speed, "rate_power": power, "rate_kind": kind}


def _direction_asymmetry(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Changes:
    """Friction differs between the two directions."""
    size = either_sign(rng, 0.01, 0.25)
    return {"asymmetry_coulomb": size, "asymmetry_viscous": size * rng.uniform(0.3, 1.2)}


def _backlash(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Changes:
    """Play between motor and link, stiff beyond it."""
    inertia = joint.physics.link_inertia
    stiffness = inertia * (2 * math.pi * rng.uniform(55.0, 80.0)) ** 2
    return {
        "play": log_uniform(rng, 4e-4, 1.5e-2),
        "stiffness": stiffness,
        "coupling_damping": 2.0 * rng.uniform(0.05, 0.12) * math.sqrt(stiffness * inertia),
    }


def _joint_elasticity(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Changes:
    """The gear twists under load."""
    inertia = joint.physics.link_inertia
    stiffness = inertia * (2 * math.pi * log_uniform(rng, 6.0, 40.0)) ** 2
    return {
        "stiffness": stiffness,
        "hardening": rng.uniform(0.0, 0.3) / (joint.rated_torque_nm / stiffness) ** 2,
        "coupling_damping": 2.0 * rng.uniform(0.02, 0.06) * math.sqrt(stiffness * inertia),
    }


def _torque_saturation(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Changes:
    """The drive runs out of torque below the limit that the belief gives it, with a rounded knee."""
    holding = joint.physics.gravity + joint.payload.gravity_nm + 1.15 * joint.physics.coulomb
    lowest = min(max(0.65 * peak_nm, 1.2 * holding), 0.92 * peak_nm)
    return {"ceiling": rng.uniform(lowest, 1.02 * peak_nm), "ceiling_knee": rng.uniform(10.0, 30.0)}


def _encoder_quantisation(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Changes:
    """The encoder resolves less than the belief says."""
    # One step of a coarse encoder must not shake the joint through the controller's differentiator.
    coarsest = 0.3 * joint.rated_torque_nm * plant.TICK_S / joint.control.kd
    factor = 2.0 ** float(rng.integers(3, 10))
    while factor > 2.0 and factor * joint.physics.encoder_step > coarsest:
        factor /= 2.0
    return {"encoder_step": joint.physics.encoder_step * factor}


def _temperature_drift(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Changes:
    """Friction falls as the joint heats itself by friction, over all experiments."""
    typical_w = joint.friction_at_speed_nm * 0.25 * joint.envelope.velocity_rad_s
    heat_time = log_uniform(rng, 20.0, 150.0)
    return {"cooling": log_uniform(rng, 0.03, 0.6), "heating": 1.0 / (typical_w * heat_time), "heat_time": heat_time}


def _electrical_lag(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Changes:
    """Torque follows its command through a first-order lag, with or without a small second pole."""
    lag = log_uniform(rng, 7e-4, 1.2e-2)
    return {"lag": lag, "second_lag": float(rng.choice([0.0, 0.1])) * lag}


LIBRARY: dict[str, Draw] = {  # every effect name of the diagnosis, with its draw
    # Friction is higher near rest and weakens with speed.
    "stribeck": lambda rng, j, _: {
        "weakening": j.physics.coulomb * log_uniform(rng, 0.02, 0.6),
        "weakening_velocity": log_uniform(rng, 0.02, 0.15),
        "weakening_kind": int(rng.integers(3)),
    },
    "viscous_nonlinearity": _viscous_nonlinearity,
    "direction_asymmetry": _direction_asymmetry,
    # Coulomb friction grows with the torque that the gear transmits.
    "load_dependent_friction": lambda rng, j, _: {
        "load_share": log_uniform(rng, 0.01, 0.2),
        "load_scale": j.physics.gravity,
        "load_kind": int(rng.integers(2)),
    },
    "torque_ripple": lambda rng, j, _: {
        "ripple": j.physics.coulomb * log_uniform(rng, 0.008, 0.25),
        "ripple_harmonic": float(rng.choice([1, 2, 4], p=[0.3, 0.5, 0.2])),
        "ripple_phase": rng.uniform(0.0, 2 * math.pi),
        "ripple_sharpness": rng.uniform(0.2, 0.7),
    },
    # Part of the friction comes back only over milliradians after a reversal.
    "presliding_hysteresis": lambda rng, j, _: {
        "soft_share": log_uniform(rng, 0.04, 0.6),
        "soft_length": log_uniform(rng, 0.002, 0.02),
    },
    # Friction at rest grows with the logarithm of the dwell and is gone after a short slip.
    "stiction_breakaway": lambda rng, j, _: {
        "ageing": j.physics.coulomb * log_uniform(rng, 0.05, 0.7),
        "ageing_time": log_uniform(rng, 0.15, 0.6),
        "ageing_length": log_uniform(rng, 4e-4, 3e-3),
    },
    "backlash": _backlash,
    "joint_elasticity": _joint_elasticity,
    "torque_delay": lambda rng, j, _: {"delay": log_uniform(rng, 5e-4, 1.4e-2)},
    # The joint gets more or less torque than the drive reports.
    "torque_constant_error": lambda rng, j, _: {"gain": 1.0 + either_sign(rng, 0.008, 0.15)},
    "torque_saturation": _torque_saturation,
    # The drive's velocity is late: a two-pole filter or a moving average.
    "velocity_lag": lambda rng, j, _: {
        "estimate_lag": log_uniform(rng, 6e-4, 1.2e-2),
        "estimate_kind": int(rng.integers(2)),
    },
    "encoder_quantisation": _encoder_quantisation,
    # Zero of the encoder is not where the belief has it: gravity acts at another angle.
    "encoder_offset": lambda rng, j, _: {"gravity_angle": either_sign(rng, 0.005, 0.2)},
    "gravity_error": lambda rng, j, _: {"gravity": j.physics.gravity * (1.0 + either_sign(rng, 0.015, 0.25))},
    "inertia_error": lambda rng, j, _: {"link_inertia": j.physics.link_inertia * (1.0 + either_sign(rng, 0.03, 0.4))},
    "temperature_drift": _temperature_drift,
    "torque_bias": lambda rng, j, _: {"bias": j.physics.coulomb * either_sign(rng, 0.015, 0.35)},
    "electrical_lag": _electrical_lag,
}


def _cable_spring(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Changes:
    """A cable bundle pulls back, harder the farther it is bent."""
    pull_nm = joint.physics.coulomb * log_uniform(rng, 0.03, 0.4)
    travel = joint.envelope.travel_rad
    return {
        "cable": pull_nm / travel,
        "cable_cubic": rng.uniform(0.3, 1.5) * pull_nm / travel**3,
        "cable_rest": joint.envelope.centre_rad + rng.uniform(-0.3, 0.3),
    }


def _bumper(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Changes:
    """A soft end stop reaches into the travel."""
    travel = joint.envelope.travel_rad
    depth = travel * rng.uniform(0.25, 0.6)
    return {
        "bumper": joint.physics.coulomb * log_uniform(rng, 0.06, 0.8) / depth**1.5,
        "bumper_position": joint.envelope.centre_rad + 0.5 * travel - 0.5 * depth,
    }


OUTSIDERS: dict[str, Draw] = {  # in no library: the right answer to each is ``unknown``
    # Friction follows the speed late, by tens of milliseconds.
    "frictional_memory": lambda rng, j, _: {"memory": log_uniform(rng, 0.012, 0.06)},
    # A worn place: friction is higher around one position.
    "friction_patch": lambda rng, j, _: {
        "patch": j.physics.coulomb * log_uniform(rng, 0.05, 0.5),
        "patch_position": j.envelope.centre_rad + rng.uniform(-0.25, 0.25) * j.envelope.travel_rad,
        "patch_width": log_uniform(rng, 0.04, 0.15),
    },
    # A torque that repeats with the output angle, unrelated to the motor's.
    "output_cogging": lambda rng, j, _: {
        "cogging": j.physics.coulomb * log_uniform(rng, 0.02, 0.25),
        "cogging_per_turn": rng.uniform(6.0, 26.0),
        "cogging_phase": rng.uniform(0.0, 2 * math.pi),
    },
    "cable_spring": _cable_spring,
    # A cable drags along over a tenth of a turn: hysteresis far longer than presliding.
    "cable_drag": lambda rng, j, _: {
        "drag": j.physics.coulomb * log_uniform(rng, 0.04, 0.5),
        "drag_length": j.envelope.travel_rad * rng.uniform(0.3, 0.6),
    },
    "bumper": _bumper,
    # Friction rises now and then, with no relation to what the joint does.
    "friction_bursts": lambda rng, j, _: {
        "bursts": log_uniform(rng, 0.08, 0.7),
        "bursts_pace": rng.uniform(0.7, 3.0),
    },
    # A torque that drifts to and fro within tens of seconds.
    "torque_wander": lambda rng, j, _: {
        "wander": j.physics.coulomb * log_uniform(rng, 0.03, 0.3),
        "wander_pace": 2 * math.pi / rng.uniform(15.0, 60.0),
    },
    # A machine nearby shakes the link at one frequency.
    "external_vibration": lambda rng, j, _: {
        "vibration": j.physics.coulomb * log_uniform(rng, 0.05, 0.4),
        "vibration_hz": rng.uniform(2.0, 12.0),
    },
    # Part of the link swings on its own: a tool or a base that gives.
    "structural_resonance": lambda rng, j, _: {
        "pendulum_inertia": j.physics.link_inertia * rng.uniform(0.1, 0.35),
        "pendulum_hz": rng.uniform(3.0, 8.0),
        "pendulum_damping": rng.uniform(0.01, 0.05),
    },
    # Small commands give no torque, larger ones too little.
    "amplifier_dead_zone": lambda rng, j, _: {"dead_zone": j.floor_nm * log_uniform(rng, 1.0, 10.0)},
    # The torque constant falls with the torque asked for, unseen by the drive.
    "gain_droop": lambda rng, j, peak_nm: {
        "droop": log_uniform(rng, 0.04, 0.4) * j.physics.torque_limit / (3.0 * peak_nm)
    },
    # The drive now and then does not take a command and keeps the old one.
    "missed_commands": lambda rng, j, _: {"missed": rng.uniform(0.35, 0.9)},
}


def changed(effect: str, rng: np.random.Generator, joint: Joint, peak_nm: float) -> Changes:
    """What an effect, of the library or from outside, changes in a joint: its size as truth records it."""
    drawn = (LIBRARY | OUTSIDERS)[effect](rng, joint, peak_nm)
    differing = {name for name, value in drawn.items() if value != getattr(joint.physics, name)}
    return {name: drawn[name] for name in Physics._fields if name in differing}
