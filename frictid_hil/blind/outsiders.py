"""Effects that no diagnosis has in its library: the right answer to each of them is ``unknown``."""

from __future__ import annotations

import math

import numpy as np

from frictid_hil.blind.effects import Draw
from frictid_hil.blind.joints import Joint, log_uniform
from frictid_hil.blind.plant import Physics


def frictional_memory(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """Friction follows the speed late, by tens of milliseconds."""
    return joint.physics._replace(memory=log_uniform(rng, 0.012, 0.06))


def friction_patch(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """A worn place: friction is higher around one position."""
    envelope = joint.envelope
    return joint.physics._replace(
        patch=joint.physics.coulomb * log_uniform(rng, 0.05, 0.5),
        patch_position=envelope.centre_rad + rng.uniform(-0.25, 0.25) * envelope.travel_rad,
        patch_width=log_uniform(rng, 0.04, 0.15),
    )


def output_cogging(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """A torque that repeats with the output angle, unrelated to the motor's."""
    return joint.physics._replace(
        cogging=joint.physics.coulomb * log_uniform(rng, 0.02, 0.25),
        cogging_per_turn=rng.uniform(6.0, 26.0),
        cogging_phase=rng.uniform(0.0, 2 * math.pi),
    )


def cable_spring(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """A cable bundle pulls back, harder the farther it is bent."""
    pull_nm = joint.physics.coulomb * log_uniform(rng, 0.03, 0.4)
    travel = joint.envelope.travel_rad
    return joint.physics._replace(
        cable=pull_nm / travel,
        cable_cubic=rng.uniform(0.3, 1.5) * pull_nm / travel**3,
        cable_rest=joint.envelope.centre_rad + rng.uniform(-0.3, 0.3),
    )


def cable_drag(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """A cable drags along over a tenth of a turn: hysteresis far longer than presliding."""
    return joint.physics._replace(
        drag=joint.physics.coulomb * log_uniform(rng, 0.04, 0.5),
        drag_length=joint.envelope.travel_rad * rng.uniform(0.3, 0.6),
    )


def bumper(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """A soft end stop reaches into the travel."""
    travel = joint.envelope.travel_rad
    depth = travel * rng.uniform(0.25, 0.6)
    return joint.physics._replace(
        bumper=joint.physics.coulomb * log_uniform(rng, 0.06, 0.8) / depth**1.5,
        bumper_position=joint.envelope.centre_rad + 0.5 * travel - 0.5 * depth,
    )


def friction_bursts(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """Friction rises now and then, with no relation to what the joint does."""
    return joint.physics._replace(bursts=log_uniform(rng, 0.08, 0.7), bursts_pace=rng.uniform(0.7, 3.0))


def torque_wander(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """A torque that drifts to and fro within tens of seconds."""
    return joint.physics._replace(
        wander=joint.physics.coulomb * log_uniform(rng, 0.03, 0.3), wander_pace=2 * math.pi / rng.uniform(15.0, 60.0)
    )


def external_vibration(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """A machine nearby shakes the link at one frequency."""
    return joint.physics._replace(
        vibration=joint.physics.coulomb * log_uniform(rng, 0.05, 0.4), vibration_hz=rng.uniform(2.0, 12.0)
    )


def structural_resonance(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """Part of the link swings on its own: a tool or a base that gives."""
    return joint.physics._replace(
        pendulum_inertia=joint.physics.link_inertia * rng.uniform(0.1, 0.35),
        pendulum_hz=rng.uniform(3.0, 8.0),
        pendulum_damping=rng.uniform(0.01, 0.05),
    )


def amplifier_dead_zone(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """Small commands give no torque, larger ones too little."""
    return joint.physics._replace(dead_zone=joint.floor_nm * log_uniform(rng, 1.0, 10.0))


def gain_droop(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """The torque constant falls with the torque asked for, unseen by the drive."""
    return joint.physics._replace(droop=log_uniform(rng, 0.04, 0.4) * joint.physics.torque_limit / (3.0 * peak_nm))


def missed_commands(rng: np.random.Generator, joint: Joint, peak_nm: float) -> Physics:
    """The drive now and then does not take a command and keeps the old one."""
    return joint.physics._replace(missed=rng.uniform(0.35, 0.9))


OUTSIDERS: dict[str, Draw] = {
    draw.__name__: draw
    for draw in (
        frictional_memory,
        friction_patch,
        output_cogging,
        cable_spring,
        cable_drag,
        bumper,
        friction_bursts,
        torque_wander,
        external_vibration,
        structural_resonance,
        amplifier_dead_zone,
        gain_droop,
        missed_commands,
    )
}
"""Every outside effect, with its draw."""
