"""Joints to be diagnosed: a healthy joint drawn at random, and what a simulator believes of it.

The belief differs by tolerances of up to 0.8 %, and every joint carries traces of effects below its own torque noise:
neither is a cause.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from frictid_hil.blind.plant import TICK_S, Controller, Physics
from frictid_hil.friction.trajectory import Array
from frictid_hil.plan.experiments import FULL, Envelope, Experiment, chosen

TOLERANCE = 0.008
PAIRS = 8
# What a zero-phase low-pass at 25 Hz leaves of the sensor noise, relative to its white part.
NOISE_LEFT = 0.40


@dataclass(frozen=True, slots=True)
class Payload:
    """What the payload adds to the link."""

    inertia_kg_m2: float
    gravity_nm: float

    def on(self, physics: Physics, mounted: bool) -> Physics:
        """The plant with the payload, where it is mounted."""
        if not mounted:
            return physics
        return physics._replace(
            link_inertia=physics.link_inertia + self.inertia_kg_m2, gravity=physics.gravity + self.gravity_nm
        )


@dataclass(frozen=True, slots=True)
class Joint:
    """A healthy joint, its controller and drive, and the belief about it."""

    physics: Physics  # the real plant, with traces
    payload: Payload  # the real payload
    belief: Physics  # the plant that the nominal model describes
    believed_payload: Payload  # the payload that it describes
    control: Controller  # the position controller (known exactly)
    envelope: Envelope  # where the experiments run
    rated_torque_nm: float  # of the drive
    torque_noise_nm: float  # standard deviation of the reported torque's white noise
    torque_quantum_nm: float  # step of the reported torque
    experiments: tuple[Experiment, ...]  # what is recorded, in order

    @property
    def floor_nm(self) -> float:
        """What torque noise leaves after the low-pass."""
        return NOISE_LEFT * self.torque_noise_nm

    @property
    def friction_at_speed_nm(self) -> float:
        """Friction at the envelope's peak speed."""
        return base_friction(self.physics, self.envelope.velocity_rad_s)


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """One draw whose logarithm is uniform."""
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


def either_sign(rng: np.random.Generator, low: float, high: float) -> float:
    """A log-uniform size with a random sign."""
    return log_uniform(rng, low, high) * float(rng.choice([-1.0, 1.0]))


def base_friction(physics: Physics, speed: float) -> float:
    """Friction of the bare plant at a steady speed, N m (its two slopes joined at the bend)."""
    low = min(speed, physics.bend_velocity)
    return physics.coulomb + physics.viscous_low * low + physics.viscous_high * (speed - low)


def draw_joint(rng: np.random.Generator, experiments: tuple[str, ...] = FULL) -> Joint:
    """A joint of random size, and the experiments that it is put through."""
    inertia = log_uniform(rng, 0.02, 5.0)
    share = rng.uniform(0.2, 0.55)
    gear_ratio = float(rng.choice([50, 51, 60, 80, 81, 100, 101, 120, 121, 160, 161, 200]))
    # Torques of real joints grow a little slower than their inertia.
    scale = 8.0 * inertia**0.75
    gravity = scale * rng.uniform(0.5, 1.6)
    coulomb = scale * rng.uniform(0.45, 1.3)
    speed = rng.uniform(1.4, 2.1)
    viscous = coulomb * rng.uniform(0.2, 0.9)
    bend_velocity = speed * float(rng.integers(2, 5)) / PAIRS
    # Steeper below the bend, by up to a factor of two.
    steepness = rng.uniform(1.0, 2.0)
    viscous_high = viscous / (speed + (steepness - 1.0) * bend_velocity)
    counts = 2.0 ** float(rng.integers(14, 20))
    payload = Payload(inertia * rng.uniform(0.15, 0.5), gravity * rng.uniform(0.4, 1.1))
    # Two significant digits, as on a name plate.
    rated = float(f"{(gravity + payload.gravity_nm + coulomb + viscous) * rng.uniform(1.05, 1.35):.2g}")
    physics = Physics(
        motor_inertia=share * inertia,
        link_inertia=(1.0 - share) * inertia,
        gravity=gravity,
        coulomb=coulomb,
        viscous_low=steepness * viscous_high,
        viscous_high=viscous_high,
        bend_velocity=bend_velocity,
        slip_length=log_uniform(rng, 1e-4, 3e-4),
        gear_ratio=gear_ratio,
        encoder_step=2.0 * math.pi / (counts * gear_ratio),
        torque_limit=3.0 * rated,
    )
    belief, believed_payload = _believed(rng, physics, payload)
    noise = rated * log_uniform(rng, 0.0025, 0.011)
    envelope = Envelope(
        centre_rad=rng.uniform(-1.6, 1.6),
        travel_rad=rng.uniform(0.5, 0.6),
        velocity_rad_s=speed,
        triangle_velocity_rad_s=rng.uniform(0.09, 0.115),
    )
    # The second posture a quarter of a turn away, towards the side with more room.
    centre = envelope.centre_rad
    envelope = replace(envelope, second_centre_rad=centre - math.copysign(math.pi / 2, centre))
    return Joint(
        physics=_with_traces(rng, physics, NOISE_LEFT * noise),
        payload=payload,
        belief=belief,
        believed_payload=believed_payload,
        control=_controller(rng, inertia, 3.0 * rated),
        envelope=envelope,
        rated_torque_nm=rated,
        torque_noise_nm=noise,
        torque_quantum_nm=0.001 * rated,
        experiments=chosen(experiments, envelope, seed=int(rng.integers(2**31))),
    )


def nominal_mapping(joint: Joint, name: str) -> dict[str, Any]:
    """``nominal.yaml`` of the joint: what its simulator believes, in the layout of an experiment set."""
    belief = joint.belief
    speeds = [joint.envelope.velocity_rad_s * (n + 1) / PAIRS for n in range(PAIRS)]
    return {
        "case": name,
        "convention": "tau = inertia*acc + gravity*cos(position) + friction",
        "timing": (
            "row k: position sampled at t_k; torque is the value applied since t_(k-1); "
            "the command of row k acts from t_k"
        ),
        "joint": {
            **told_body(belief.motor_inertia, belief.link_inertia, belief.gravity, belief.gear_ratio),
            "gear": "harmonic_drive",
            "friction": {
                "velocity_rad_s": speeds,
                "torque_nm": [base_friction(belief, speed) for speed in speeds],
                "presliding_stiffness_nm_per_rad": belief.coulomb / belief.slip_length,
            },
        },
        "payload": {
            "inertia_kg_m2": joint.believed_payload.inertia_kg_m2,
            "gravity_torque_nm": joint.believed_payload.gravity_nm,
        },
        "controller": {
            "type": "pid",
            "rate_hz": round(1.0 / TICK_S),
            "kp": joint.control.kp,
            "ki": joint.control.ki,
            "kd": joint.control.kd,
            "velocity_filter_s": joint.control.velocity_filter,
            "torque_limit_nm": joint.control.torque_limit,
            "law": "kp*(cmd-q) + integral(ki*(cmd-q)) + kd*(d cmd/dt - filtered v)",
            "integral_starts_at": "static holding torque; frozen while the limit is active",
        },
        "drive": {
            "rated_torque_nm": joint.rated_torque_nm,
            "torque_quantum_nm": joint.torque_quantum_nm,
            "torque_delay_s": 0.0,
            "current_lag_s": 0.0,
        },
        "encoder": {
            "side": "motor",
            "resolution_rad": belief.encoder_step,
            "zero_offset_rad": 0.0,
            "velocity": "backward difference of position, no filter",
        },
        "experiments": told_experiments(
            ".csv", ((e.name, e.role == "validation", e.payload, ticks(e).size * TICK_S) for e in joint.experiments)
        ),
    }


def told_body(motor_kg_m2: float, link_kg_m2: float, gravity_nm: float, gear_ratio: float) -> dict[str, float]:
    """The believed joint without its friction."""
    return {
        "inertia_kg_m2": motor_kg_m2 + link_kg_m2,
        "motor_inertia_share": motor_kg_m2 / (motor_kg_m2 + link_kg_m2),
        "gravity_torque_nm": gravity_nm,
        "gear_ratio": gear_ratio,
    }


def told_experiments(ending: str, recorded: Iterable[tuple[str, bool, bool, float]]) -> list[dict[str, Any]]:
    """The recordings of a set in order, each (name, judged on, payload mounted, duration in s)."""
    return [
        {
            "name": name,
            "file": f"{name}{ending}",
            "role": "validation" if judged else "identification",
            "payload": payload,
            "run_order": order,
            "duration_s": duration_s,
        }
        for order, (name, judged, payload, duration_s) in enumerate(recorded)
    ]


def ticks(experiment: Experiment) -> Array:
    """Times of the controller's ticks, s."""
    return np.arange(math.ceil(experiment.duration_s / TICK_S)) * TICK_S


def _believed(rng: np.random.Generator, physics: Physics, payload: Payload) -> tuple[Physics, Payload]:
    def near(value: float) -> float:
        return value * (1.0 + float(np.clip(rng.normal(0.0, 0.45 * TOLERANCE), -TOLERANCE, TOLERANCE)))

    friction = near(1.0)
    belief = physics._replace(
        motor_inertia=near(physics.motor_inertia),
        link_inertia=near(physics.link_inertia),
        gravity=near(physics.gravity),
        coulomb=physics.coulomb * friction,
        viscous_low=physics.viscous_low * friction,
        viscous_high=physics.viscous_high * friction,
        slip_length=near(physics.slip_length),
        rounding=0.0,
    )
    return belief, Payload(near(payload.inertia_kg_m2), near(payload.gravity_nm))


def _with_traces(rng: np.random.Generator, physics: Physics, floor_nm: float) -> Physics:
    """Three effects at a fraction of the noise floor."""

    def trace() -> float:
        return floor_nm * rng.uniform(0.05, 0.3)

    kinds: dict[str, dict[str, Any]] = {
        "ripple": {"ripple": trace(), "ripple_phase": rng.uniform(0.0, 6.28)},
        "weakening": {"weakening": 1.5 * trace(), "weakening_velocity": rng.uniform(0.02, 0.1)},
        "asymmetry": {"asymmetry_coulomb": trace() / physics.coulomb * float(rng.choice([-1, 1]))},
        "bias": {"bias": trace() * float(rng.choice([-1, 1]))},
        "soft": {"soft_share": min(0.05, trace() / physics.coulomb), "soft_length": rng.uniform(0.002, 0.01)},
        "rate": {"rate_extra": trace(), "rate_velocity": 2.0},
        "cogging": {"cogging": trace(), "cogging_per_turn": rng.uniform(5.0, 30.0)},
        "lag": {"lag": rng.uniform(2e-5, 6e-5)},
    }
    for name in rng.choice(list(kinds), size=3, replace=False):
        physics = physics._replace(**kinds[str(name)])
    return physics


def _controller(rng: np.random.Generator, inertia: float, limit: float) -> Controller:
    """Stiff, with more than 45 degrees of phase margin: natural frequency 22..30 rad/s, damping 0.7..0.9."""
    natural, damping = rng.uniform(22.0, 30.0), rng.uniform(0.7, 0.9)
    kp = inertia * natural**2
    return Controller(
        kp=kp,
        ki=kp * rng.uniform(3.4, 4.5),
        kd=2.0 * damping * natural * inertia,
        velocity_filter=0.003,
        torque_limit=limit,
    )
