"""A geared joint written for these tests alone, differently from the product's simulation: generalised Maxwell slip
(four slip springs side by side), optionally two masses, with the effects that no estimator here contains."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from frictid_hil.friction import trajectory
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.recording import CycleRecording, Repeat, Skew
from frictid_hil.friction.trajectory import Procedure


@dataclass(frozen=True)
class Joint:
    inertia: float = 1.9
    gravity_cos: float = 40.0
    gravity_sin: float = 4.0
    bias: float = 0.0
    coulomb: float = 22.0
    stribeck: float = 0.2
    stribeck_velocity: float = math.radians(2.0)
    viscous: float = 6.0
    saturating: float = 5.0
    saturating_velocity: float = 0.9
    asymmetry: float = 0.05
    stiffness: float = 30000.0
    shares: tuple[float, ...] = (0.4, 0.3, 0.2, 0.1)
    """Stiffness shares of the slip springs; their strengths are equal."""
    gear_ratio: float = 224.0
    ripple: float = 0.03
    load: float = 0.0
    drift: float = 0.0
    link_share: float = 0.0
    link_frequency_hz: float = 30.0
    link_hardening: float = 0.0
    """By which share the spring is stiffer under the torque that the drive is rated for."""
    max_torque: float = 213.0
    rated_torque: float = 71.0
    noise: float = 0.005
    quantum: float = 0.001
    counts: float = 131072.0
    velocity_filter_s: float = 0.001
    bandwidth: float = 70.0
    start: float = 0.3

    def truth(self, top: float) -> FrictionCurve:
        v = np.concatenate([np.geomspace(1e-4, 0.2, 150), np.linspace(0.21, 1.2 * top, 300)])
        return FrictionCurve.through(v, self.steady(v))

    def steady(self, v):
        s = self.coulomb * (1 + self.stribeck * np.exp(-((v / self.stribeck_velocity) ** 2)))
        return s + self.viscous * v + self.saturating * np.tanh(v / self.saturating_velocity)


NUMBERS = (
    "inertia", "link_share", "link_stiffness", "gravity_cos", "gravity_sin", "gravity_level", "bias", "coulomb",
    "stribeck", "stribeck_velocity", "viscous", "saturating", "saturating_velocity", "asymmetry", "stiffness",
    "gear_ratio", "ripple", "load", "drift", "max_torque", "quantum_nm", "count_rad", "link_hardening", "rated_torque",
)  # fmt: skip
"""A joint as the compiled loop takes it: a record of floats (a class of ours would be named in numba's cache)."""


@njit(cache=True)
def _simulate(command, velocity_command, step, substeps, j, shares, gains, blend, delay, white):
    n = command.size
    out_q, out_v, out_f = np.empty(n), np.empty(n), np.empty(n)
    h = step / substeps
    flexible = j.link_share > 0
    motor = j.inertia * (1 - j.link_share)
    link = j.inertia * j.link_share
    damping = 0.04 * math.sqrt(j.link_stiffness * link)
    q = command[0]
    hold = j.gravity_cos * math.cos(q) + j.gravity_sin * math.sin(q)
    q_link = q - hold / j.link_stiffness if flexible else q
    v = v_link = v_meas = 0.0
    z = np.zeros(shares.size)
    integral = applied = hold + j.bias
    pipe = np.full(delay + 1, applied)
    last_q = math.floor(q / j.count_rad + 0.5) * j.count_rad
    ripple = 2 * j.gear_ratio
    for k in range(n):
        q_meas = math.floor(q / j.count_rad + 0.5) * j.count_rad
        v_meas += blend * ((q_meas - last_q) / step - v_meas)
        last_q = q_meas
        out_q[k] = q_meas
        out_v[k] = v_meas
        out_f[k] = math.floor((applied + white[k]) / j.quantum_nm + 0.5) * j.quantum_nm
        e = command[k] - q_meas
        u = gains[0] * e + gains[1] * (velocity_command[k] - v_meas) + integral
        if abs(u) < j.max_torque:
            integral += gains[2] * e * step
        for i in range(delay):
            pipe[i] = pipe[i + 1]
        pipe[delay] = min(max(u, -j.max_torque), j.max_torque)
        applied = pipe[0]
        heat = 1.0 + j.drift * (k * step / 16.0)
        for _ in range(substeps):
            gravity = j.gravity_cos * math.cos(q_link) + j.gravity_sin * math.sin(q_link)
            side = 1.0 + j.asymmetry if v > 0 else 1.0 - j.asymmetry
            stress = 1.0 + j.load * (abs(gravity) / j.gravity_level - 1.0) if j.gravity_level < 1e9 else 1.0
            wave = math.sin(ripple * q) + 0.4 * math.sin(2 * ripple * q + 0.7)
            wave += 0.3 * (abs(math.sin(0.5 * ripple * q + 0.3)) - 2 / math.pi)
            scale = side * stress * heat * (1.0 + j.ripple * wave)
            strength = j.coulomb * (1 + j.stribeck * math.exp(-((v / j.stribeck_velocity) ** 2)))
            bound = scale * strength / shares.size
            friction = scale * (j.viscous * v + j.saturating * math.tanh(v / j.saturating_velocity))
            friction += 0.3 * j.ripple * j.coulomb * math.sin(ripple * q + 1.1)
            for i in range(shares.size):
                z[i] = min(max(z[i] + j.stiffness * shares[i] * v * h, -bound), bound)
                friction += z[i]
            if flexible:
                twist = j.link_stiffness * (q - q_link)
                twist *= 1.0 + j.link_hardening * (twist / j.rated_torque) ** 2
                twist += damping * (v - v_link)
                v += h * (applied - friction - j.bias - twist) / motor
                v_link += h * (twist - gravity) / link
                q += h * v
                q_link += h * v_link
            else:
                v += h * (applied - friction - j.bias - gravity) / motor
                q += h * v
                q_link = q
    return out_q, out_v, out_f


def record(
    joint: Joint,
    procedure: Procedure,
    *,
    seed: int = 1,
    step_s: float = 0.001,
    delay: int = 1,
    lead_s: float = 0.3,
    repeat: bool = True,
) -> CycleRecording:
    """The joint driven through a hold, the cycles, the third cycle again as drift check, and a hold."""
    lead = round(lead_s / step_s)
    starts = procedure.cycle_starts_s
    again = min(3, procedure.cycles)
    again_s = float(starts[again] - starts[again - 1]) if repeat else 0.0
    n = 2 * lead + math.ceil((procedure.duration_s + again_s) / step_s)
    time = (np.arange(n) - lead) * step_s
    after = time - procedure.duration_s
    path = np.where(after < 0, time, np.where(after < again_s, after + starts[again - 1], -1.0))
    command = joint.start + trajectory.position(procedure, path)
    velocity = trajectory.velocity(procedure, path)
    q, v, f = drive(joint, command, velocity, step_s=step_s, delay=delay, seed=seed)
    return CycleRecording(
        time_s=time,
        position_rad=q,
        torque_nm=f,
        procedure=procedure,
        velocity_rad_s=v,
        command_rad=command,
        skew=Skew(torque_delay_s=step_s / 2),
        gear_ratio=joint.gear_ratio,
        torque_limit_nm=joint.max_torque,
        repeat=Repeat(again, procedure.duration_s) if repeat else None,
    )


def drive(joint: Joint, command, velocity, *, step_s: float = 0.001, delay: int = 1, seed: int = 1):
    """Position, drive velocity and drive torque of the joint under position control, shape of ``command``."""
    w = joint.bandwidth
    gains = np.array([w**2, 1.32 * w, 0.25 * w**3]) * joint.inertia
    middle = float(np.mean(command))
    gravity = joint.gravity_cos * math.cos(middle) + joint.gravity_sin * math.sin(middle)
    link, motor = joint.inertia * joint.link_share, joint.inertia * (1 - joint.link_share)
    # The resonance of the two masses free of everything else.
    stiffness = (2 * math.pi * joint.link_frequency_hz) ** 2 * link * motor / joint.inertia
    derived = {
        "gravity_level": abs(gravity) if gravity else 1e9,
        "link_stiffness": stiffness,
        "quantum_nm": joint.quantum * joint.rated_torque,
        "count_rad": 2 * math.pi / joint.counts / joint.gear_ratio,
    }
    values = tuple(derived[name] if name in derived else float(getattr(joint, name)) for name in NUMBERS)
    numbers = np.array([values], dtype=[(name, "f8") for name in NUMBERS])[0]
    blend = 1.0 - math.exp(-step_s / joint.velocity_filter_s) if joint.velocity_filter_s > 0 else 1.0
    white = joint.noise * joint.rated_torque * np.random.default_rng(seed).normal(size=command.size)
    substeps = max(1, round(step_s / 5e-5))
    return _simulate(command, velocity, step_s, substeps, numbers, np.array(joint.shares), gains, blend, delay, white)


ARM = (
    Joint(1.1, 0, 0, 0, 12, 0.2, viscous=3, saturating=3, gear_ratio=100, stiffness=18e3, max_torque=95,
          rated_torque=32),
    Joint(),
    Joint(0.8, 18, 5, 0, 13, 0.2, viscous=3, saturating=3, gear_ratio=120, stiffness=20e3, max_torque=114,
          rated_torque=38),
    Joint(0.12, 2, 1, 0, 4.5, 0.2, viscous=1.2, saturating=0.8, gear_ratio=120, stiffness=6.5e3, max_torque=34,
          rated_torque=11, bandwidth=100),
    Joint(0.1, 2, 0.5, 0, 4, 0.2, viscous=1, saturating=0.8, gear_ratio=100, stiffness=5e3, max_torque=28,
          rated_torque=9.5, bandwidth=100),
    Joint(0.03, 0.1, 0.1, 0, 3, 0.2, viscous=0.8, saturating=0.5, gear_ratio=81.5, stiffness=3.5e3, max_torque=23,
          rated_torque=7.8, bandwidth=160),
)  # fmt: skip
"""Six joints about the size of a small arm's; none is the product's shipped one."""


def degrees_procedure(amplitude_deg: float = 20.0, cycles: int = 10) -> Procedure:
    return Procedure(math.radians(amplitude_deg), math.radians(115.0), cycles)
