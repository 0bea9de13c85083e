"""Joints and recordings that several simulation tests share."""

from __future__ import annotations

from typing import Any

import numpy as np

from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.replay import Controller, Simulated, closed_loop

INERTIA, COULOMB, VISCOUS, GRAVITY, STIFFNESS = 0.5, 4.0, 1.5, 5.0, 2e4
CONTROLLER = Controller(500.0, 2000.0, 25.0, rate_hz=500.0, velocity_filter_s=0.003, torque_limit_nm=60.0)


def bare(**changes: object) -> JointModel:
    """A noiseless joint without any effect."""
    mapping: dict[str, object] = {
        "inertia_kg_m2": INERTIA,
        "motor_inertia_share": 0.3,
        "gravity_cos_nm": GRAVITY,
        "friction": {"coulomb_nm": COULOMB, "viscous_nm_s_per_rad": VISCOUS},
        "presliding_stiffness_nm_per_rad": STIFFNESS,
        "payload": {"inertia_kg_m2": 0.1, "gravity_cos_nm": 3.0},
        "encoder": {"side": "motor", "counts_per_revolution": 0},
        "drive": {"torque_noise_per_mille": 0, "torque_quantum_per_mille": 0, "velocity_filter_s": 0},
        "servo": {"kp_nm_per_rad": 5000, "ki_nm_per_rad_s": 1e5, "kd_nm_s_per_rad": 80},
        "hand": {"stiffness_nm_per_rad": 200.0, "damping_nm_s_per_rad": 8.0},
    }
    mapping.update(changes)
    return JointModel.from_mapping(mapping, gear_ratio=100.0, rated_torque_nm=20.0, max_torque_nm=60.0)


def excitation(rate_hz: float = 500.0) -> tuple[np.ndarray, np.ndarray]:
    """Sines, creep, dwells and a chirp, 12 s: every effect has something to act on."""
    time = np.arange(round(12.0 * rate_hz)) / rate_hz
    sine = 0.3 * (1 - np.cos(2 * np.pi * 0.5 * time)) * (time < 4)
    creep = np.interp(time, [4, 5, 6, 7, 8], [0, 0, 0.06, 0.06, 0])
    burst = np.clip(time - 8.0, 0.0, 3.0)
    chirp = 0.03 * np.sin(np.pi * burst / 3) * np.sin(2 * np.pi * (0.5 + burst) * burst)
    return time, 0.2 + sine + creep + chirp


def simulate(model: JointModel, controller: Controller = CONTROLLER, **options: Any) -> Simulated:
    """The excitation on this joint."""
    time, command = excitation()
    return closed_loop(model, controller, time, command, **options)
