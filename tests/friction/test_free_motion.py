from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from frictid_hil.errors import IdentificationError
from frictid_hil.friction.free_motion import FreeMotion, free_motion


def joint(seed: int, *, travel: float = 1.2, noise: float = 0.15, seconds: float = 40.0, step: float = 0.002) -> Any:
    """A random walk of five sines with known friction, inertia and gravity."""
    dice = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, step)
    hz = dice.uniform(0.05, 0.9, 5)
    size = dice.uniform(0.3, 1.0, 5) / hz
    size *= travel / 2 / size.sum()
    phase = dice.uniform(0, 2 * np.pi, 5)
    w = 2 * np.pi * hz
    q = np.sin(np.outer(time, w) + phase) @ size
    v = np.cos(np.outer(time, w) + phase) @ (size * w)
    a = -np.sin(np.outer(time, w) + phase) @ (size * w**2)
    torque = 0.6 * a + 3.0 * np.cos(q) - 0.7 * np.sin(q) + 0.2 + friction(np.abs(v)) * np.tanh(v / 1e-3)
    return time, q, torque + noise * dice.standard_normal(time.size)


def friction(speed: np.ndarray) -> np.ndarray:
    return 1.5 + 0.8 * speed / (1.0 + 0.4 * speed)


@pytest.mark.slow
def test_intervals_hold_the_truth_and_are_narrow() -> None:
    held = of = 0
    for seed in range(15):
        found = free_motion(*joint(seed))
        truth = friction(np.array(found.curve.velocity_rad_s))
        held += int(np.count_nonzero(np.abs(np.array(found.curve.torque_nm) - truth) <= found.half_width_nm))
        of += truth.size
        assert np.all(np.abs(np.array(found.curve.torque_nm) / truth - 1.0) < 0.04)
        assert found.inertia_kg_m2 is not None and abs(found.inertia_kg_m2.value - 0.6) < 0.05
        assert all(gate.passed for gate in found.gates)
    assert held / of > 0.85


def test_gravity_is_told_over_a_long_travel_and_not_over_a_short_one() -> None:
    wide = free_motion(*joint(3, travel=4.0))
    assert wide.gravity_cos_nm is not None and abs(wide.gravity_cos_nm.value - 3.0) < 0.1
    short = free_motion(*joint(3, travel=0.3))
    assert short.gravity_cos_nm is None
    assert "too short" in short.untold["gravity_cos_nm"]
    assert abs(short.curve.torque_nm[-1] / friction(np.array(short.curve.velocity_rad_s))[-1] - 1.0) < 0.1


def test_a_motion_without_acceleration_has_no_inertia_in_it() -> None:
    time = np.arange(0.0, 60.0, 0.005)
    v = np.where((time // 3.0) % 2 == 0, 1.0, -1.0) * np.repeat([0.1, 0.2, 0.4, 0.3, 0.15], time.size // 5)
    q = np.cumsum(v) * 0.005 + 1e-5 * np.random.default_rng(2).standard_normal(time.size)
    torque = friction(np.abs(v)) * np.sign(v) + 0.3 * np.random.default_rng(1).standard_normal(time.size)
    found = free_motion(time, q, torque)
    assert found.inertia_kg_m2 is None
    assert "no larger than their noise" in found.untold["inertia_kg_m2"]


def test_irregular_times_and_gaps() -> None:
    time, q, torque = joint(5)
    keep = (np.random.default_rng(2).uniform(size=time.size) > 0.2) & ~((time > 15.0) & (time < 17.0))
    found = free_motion(time[keep], q[keep], torque[keep])
    truth = friction(np.array(found.curve.velocity_rad_s))
    assert np.all(np.abs(np.array(found.curve.torque_nm) / truth - 1.0) < 0.06)


def gate(found: FreeMotion, name: str) -> bool:
    return next(gate.passed for gate in found.gates if gate.name == name)


def test_what_cannot_be_told_is_refused_or_gated() -> None:
    time, q, torque = joint(1)
    with pytest.raises(IdentificationError, match="both ways"):
        free_motion(time, 2.0 * time + 0.01 * q, torque)
    with pytest.raises(IdentificationError, match="does not move"):
        free_motion(time, 0.0 * q, torque)
    other = np.where(time > 20.0, 2.0, 1.0) * torque
    assert not gate(free_motion(time, q, other), "halves_agree")
    with pytest.raises(IdentificationError, match="F_0"):
        free_motion(time, q, -torque)
    assert not gate(free_motion(*joint(1, noise=30.0, seconds=8.0)), "friction_interval")


def test_halves_of_rising_speeds_are_compared_where_both_stayed() -> None:
    step, travel, fastest, cycles, yields = 0.005, 0.35, 2.0, 10, 0.004
    parts = []
    for speed in fastest * np.arange(1, cycles + 1) / cycles:
        time = np.arange(0.0, np.pi * travel / speed, step)
        parts.append(0.5 * travel * (1.0 - np.cos(2.0 * speed / travel * time)))
    q = np.concatenate(parts)
    v = np.gradient(q, step)
    slip = [0.0]  # friction begins as a spring that yields
    for moved in np.diff(q):
        slip.append(float(np.clip(slip[-1] + moved, -yields, yields)))
    torque = 0.1 * np.gradient(v, step) + friction(np.abs(v)) * np.array(slip) / yields
    torque += 0.05 * np.random.default_rng(1).standard_normal(q.size)
    time = step * np.arange(q.size)
    assert gate(free_motion(time, q, torque), "halves_agree")
    warmer = np.where(time > time[-1] / 2, 1.0, 1.6) * torque
    assert not gate(free_motion(time, q, warmer), "halves_agree")
