"""A geared joint written after the estimators were finished, to judge their intervals by: nothing was tuned on it.

It shares no formula with the product's simulation nor with the plants of the tests:

    presliding      a hysteron of Bouc and Wen, z' = k v (1 - |z|^1.5 (0.6 sgn(v z) + 0.4))
    friction        Fc z (1 + b / (1 + (v/vs)^2)) + a asinh(v/va), 3 to 8 % stronger one way
    efficiency      the gear takes 2 to 6 % of the torque it transmits to the link, accelerating it included
    place           friction varies along the travel (a wave of 40 to 70 deg), and with 1, 3 and 5 waves a motor turn
    torque          a cogging that does not depend on direction, 6 waves a motor turn
    temperature     friction falls by up to 1 %, exponentially with 8 s
    drive           P position loop around a PI velocity loop, 131072 counts, torque noise that is not white (half of it
                    passes a low-pass of 2 ms), one cycle of delay
    integrator      Heun's rule, 20 us

The joints are drawn, not written down: size, speeds and shares of all these come from a seeded generator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numba import njit

from frictid_hil.friction.trajectory import Array

_SUBSTEP_S = 2e-5
_WARM_UP_S = 8.0


@dataclass(frozen=True)
class HeldOutJoint:
    """One drawn joint; radians, N m."""

    inertia: float
    link_part: float
    gravity: float
    gravity_phase: float
    coulomb: float
    rise: float
    rise_velocity: float
    eyring: float
    eyring_velocity: float
    asymmetry: float
    stiffness: float
    loss: float
    place: float
    place_wave: float
    ripple: float
    cogging: float
    cooling: float
    gear_ratio: float
    max_torque: float
    rated_torque: float
    noise: float
    start: float

    def holding(self, q: float) -> float:
        """Gravity at a place."""
        return self.gravity * math.cos(q + self.gravity_phase)

    def steady(self, v: Array, middle: float) -> Array:
        """Odd part of the friction at constant speed, mean over the motor's turn, cold."""
        rubbing = self.coulomb * (1 + self.rise / (1 + (v / self.rise_velocity) ** 2))
        rubbing = rubbing + self.eyring * np.arcsinh(v / self.eyring_velocity)
        here = 1 + self.place * math.sin(self.place_wave * middle)
        odd: Array = rubbing * here + self.loss * abs(self.holding(middle))
        return odd

    def warm(self, run_s: float) -> float:
        """Mean share of the cold friction that is left over a run of this length."""
        return 1.0 - self.cooling * (1.0 - _WARM_UP_S / run_s * (1.0 - math.exp(-run_s / _WARM_UP_S)))


def drawn_arm(seed: int) -> list[HeldOutJoint]:
    """Six joints from heavy to light."""
    rng = np.random.default_rng(seed)
    joints = []
    for size in (1.0, 1.6, 0.8, 0.25, 0.12, 0.04):
        inertia = size * rng.uniform(0.8, 1.25)
        coulomb = (3.0 + 9.0 * size) * rng.uniform(0.8, 1.25)
        # A tenth more than what the fastest cycle at 10 deg takes.
        gravity = 20.0 * size * rng.uniform(0.0, 1.0)
        most = 1.1 * (inertia * 47.0 + gravity + 2.2 * coulomb)
        joints.append(
            HeldOutJoint(
                inertia=inertia,
                link_part=rng.uniform(0.3, 0.7),
                gravity=gravity,
                gravity_phase=rng.uniform(-0.5, 0.5),
                coulomb=coulomb,
                rise=rng.uniform(0.05, 0.3),
                rise_velocity=math.radians(rng.uniform(1.0, 4.0)),
                eyring=coulomb * rng.uniform(0.15, 0.4),
                eyring_velocity=rng.uniform(0.1, 0.5),
                asymmetry=rng.uniform(0.03, 0.08),
                stiffness=coulomb * rng.uniform(900.0, 1500.0),
                loss=rng.uniform(0.02, 0.06),
                place=rng.uniform(0.0, 0.04),
                place_wave=2 * math.pi / math.radians(rng.uniform(40.0, 70.0)),
                ripple=rng.uniform(0.01, 0.05),
                cogging=coulomb * rng.uniform(0.005, 0.02),
                cooling=rng.uniform(0.0, 0.01),
                gear_ratio=float(rng.choice([80.0, 100.0, 121.0, 160.0])),
                max_torque=most,
                rated_torque=most / 3,
                noise=0.005,
                start=rng.uniform(-0.4, 0.4),
            )
        )
    return joints


@njit(cache=True)
def _rates(j: Any, wear: float, torque: float, q: float, v: float, z: float) -> tuple[float, float, float]:
    angle = j.gear_ratio * q
    waves = math.sin(angle) + 0.6 * math.sin(3 * angle + 1.0) + 0.4 * math.cos(5 * angle)
    scale = wear * (1.0 + j.place * math.sin(j.place_wave * q)) * (1.0 + j.ripple * waves)
    scale *= 1.0 + j.asymmetry * (1.0 if v > 0 else -1.0)
    rubbing = j.coulomb * (1 + j.rise / (1 + (v / j.rise_velocity) ** 2)) * z
    rubbing = scale * (rubbing + j.eyring * math.asinh(v / j.eyring_velocity))
    gravity = j.gravity * math.cos(q + j.gravity_phase)
    cogging = j.cogging * math.sin(6 * angle + 0.5)
    # The gear's loss opposes motion and grows with what it transmits, the link's acceleration included.
    free = (torque - rubbing - cogging - gravity) / j.inertia
    nearly = free - z * j.loss * abs(gravity) / j.inertia
    loss = z * j.loss * abs(gravity + j.link_part * j.inertia * nearly)
    rate = j.stiffness / j.coulomb * v
    turning = 1.0 if v * z > 0 else -1.0
    return v, free - loss / j.inertia, rate * (1.0 - abs(z) ** 1.5 * (0.6 * turning + 0.4))


@njit(cache=True)
def _simulate(
    j: Any, command: Array, rate: Array, step_s: float, substeps: int, noise: Array
) -> tuple[Array, Array, Array]:
    n = command.size
    out_q, out_v, out_f = np.empty(n), np.empty(n), np.empty(n)
    h = step_s / substeps
    count = 2 * math.pi / 131072.0 / j.gear_ratio
    q, v, z = command[0], 0.0, 0.0
    applied = j.gravity * math.cos(q + j.gravity_phase)
    integral = waiting = applied
    last = math.floor(q / count + 0.5) * count
    slow = speed = 0.0
    bandwidth = 75.0 if j.inertia > 0.5 else 110.0
    for k in range(n):
        seen = math.floor(q / count + 0.5) * count
        speed += 0.6 * ((seen - last) / step_s - speed)
        last = seen
        slow += 0.4 * (noise[k, 1] - slow)
        out_q[k], out_v[k] = seen, speed
        out_f[k] = applied + j.noise * j.rated_torque * (0.7 * noise[k, 0] + 1.4 * slow)
        wanted = rate[k] + 0.45 * bandwidth * (command[k] - seen)
        gap = wanted - speed
        u = 1.4 * bandwidth * j.inertia * gap + integral
        if abs(u) < j.max_torque:
            integral += 0.35 * bandwidth**2 * j.inertia * gap * step_s
        applied, waiting = waiting, min(max(u, -j.max_torque), j.max_torque)
        wear = 1.0 - j.cooling * (1.0 - math.exp(-k * step_s / _WARM_UP_S))
        for _ in range(substeps):
            a, b, c = _rates(j, wear, applied, q, v, z)
            d, e, f = _rates(j, wear, applied, q + h * a, v + h * b, z + h * c)
            q += h * (a + d) / 2
            v += h * (b + e) / 2
            z = min(max(z + h * (c + f) / 2, -1.0), 1.0)
    return out_q, out_v, out_f


def drive(
    joint: HeldOutJoint, command: Array, rate: Array, *, step_s: float = 0.001, seed: int = 1
) -> tuple[Array, Array, Array]:
    """Position, drive velocity and drive torque under position control; rows as a bus reports them.

    The torque of row k was applied during the step that ends there.
    """
    names = [field.name for field in fields(joint)]
    values = tuple(float(getattr(joint, name)) for name in names)
    numbers = np.array([values], dtype=[(name, "f8") for name in names])[0]
    white = np.random.default_rng(seed).normal(size=(command.size, 2))
    columns: tuple[Array, Array, Array] = _simulate(numbers, command, rate, step_s, round(step_s / _SUBSTEP_S), white)
    return columns
