"""Small experiment sets made with the product's own simulator: quick joints for the diagnosis' tests."""

from __future__ import annotations

import math
import os
from dataclasses import fields
from pathlib import Path

import numpy as np

from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.gap.experiment_set import Controller, Experiment, ExperimentSet, Nominal
from frictid_hil.gap.forward import nominal_model
from frictid_hil.simulation.joint import Payload
from frictid_hil.simulation.replay import Controller as Loop
from frictid_hil.simulation.replay import closed_loop

STEP_S = 0.002
NOISE_NM = 0.04

NOMINAL = Nominal(
    inertia_kg_m2=0.4,
    motor_inertia_share=0.25,
    gravity_cos_nm=4.0,
    gear_ratio=100.0,
    curve=FrictionCurve.through(np.array([0.2, 0.8, 1.8]), np.array([3.2, 3.7, 4.5])),
    presliding_stiffness_nm_per_rad=20000.0,
    payload=Payload(0.1, 3.0),
    controller=Controller(500.0, 320.0, 1300.0, 18.0, 0.003, 36.0),
    rated_torque_nm=12.0,
    torque_quantum_nm=0.012,
    encoder_resolution_rad=2e-6,
)


def commands() -> dict[str, tuple[np.ndarray, bool, bool]]:
    """(command, payload, validation) by name; every one rests at its start for half a second."""
    sines = np.concatenate([_sine(0.5, k * 0.4) for k in (1, 2, 3, 4)])
    large = np.concatenate([_sine(1.0, k * 0.45) for k in (1, 2, 4)])
    slow = _triangle(0.25, 0.1, 1)
    chirp_time = np.arange(0, 6, STEP_S)
    chirp = 0.06 * np.sin(2 * np.pi * (0.3 * chirp_time + (8 - 0.3) / 12 * chirp_time**2)) / (1 + 0.8 * chirp_time)
    rests = np.concatenate([_ramp(0.012, 0.8, s, w) for s, w in ((1, 0.3), (1, 1.2), (-1, 0.6), (-1, 2.0))])
    creep = np.cumsum(rests) * STEP_S
    moves = np.concatenate([_sine(0.7, 1.2), _sine(0.4, 0.6), _triangle(0.15, 0.2, 1)])
    repeat = np.concatenate([_sine(0.6, k * 0.5) for k in (1, 3)])
    rest = np.zeros(round(0.5 / STEP_S))
    made = {
        "sines_small": (sines, False, False),
        "sines_large": (large, False, False),
        "triangle_slow": (slow, False, False),
        "sines_payload": (sines[: sines.size // 2], True, False),
        "chirp": (chirp, False, False),
        "breakaway": (creep, False, False),
        "moves_payload": (moves, True, True),
        "sines_repeat": (repeat, False, True),
    }
    return {n: (-0.4 + np.concatenate([rest, c - c[0]]), p, v) for n, (c, p, v) in made.items()}


def make(
    effects: dict[str, dict[str, float]] | None = None,
    nominal: Nominal = NOMINAL,
    seed: int = 1,
    noise_nm: float = NOISE_NM,
    only: tuple[str, ...] = (),
) -> ExperimentSet:
    """A set whose joint carries ``effects`` that its nominal model lacks."""
    random = np.random.default_rng(seed)
    model = nominal_model(nominal).with_effects(effects or {})
    c = nominal.controller
    assert c is not None
    loop = Loop(**{field.name: getattr(c, field.name) for field in fields(Loop)})
    state = None
    experiments = []
    for order, (name, (command, payload, validation)) in enumerate(commands().items()):
        if only and name not in only:
            continue
        time = STEP_S * np.arange(command.size)
        rows = closed_loop(model, loop, time, command, payload=payload, state=state)
        state = rows.state
        torque = rows.torque_nm + noise_nm * random.standard_normal(time.size)
        experiments.append(
            Experiment(
                name=name,
                validation=validation,
                payload=payload,
                run_order=order,
                time_s=time,
                position_rad=rows.position_rad,
                velocity_rad_s=rows.velocity_rad_s,
                torque_nm=np.round(torque / nominal.torque_quantum_nm) * nominal.torque_quantum_nm,
                position_command_rad=command,
            )
        )
    return ExperimentSet("made", nominal, tuple(experiments))


def practice_data() -> Path | None:
    """Folder of the practice cases, or None."""
    return _folder("FRICTID_PRACTICE_DATA", "gap-practice")


def real_data() -> Path | None:
    """Folder of the real recordings, or None."""
    return _folder("FRICTID_REAL_DATA", "real")


def practice_wide_data() -> Path | None:
    """Folder of the practice cases of the wide world, or None."""
    return _folder("FRICTID_PRACTICE_WIDE_DATA", "gap-practice-wide")


def real_more_data() -> Path | None:
    """Folder of further real sets with what is known of them, or None."""
    return _folder("FRICTID_REAL_MORE_DATA", "real-more")


def _folder(variable: str, name: str) -> Path | None:
    named = os.environ.get(variable)
    folder = Path(named) if named else Path(__file__).resolve().parents[3] / "shared" / "data" / name
    return folder if folder.is_dir() else None


def _sine(travel: float, speed: float) -> np.ndarray:
    rate = 2 * speed / travel
    t = np.arange(0, 2 * math.pi / rate, STEP_S)
    return 0.5 * travel * (1 - np.cos(rate * t))


def _triangle(travel: float, speed: float, times: int) -> np.ndarray:
    up = np.arange(0, travel, speed * STEP_S)
    return np.concatenate([up, up[::-1]] * times)


def _ramp(speed: float, moving_s: float, sign: int, wait_s: float) -> np.ndarray:
    return np.concatenate([np.zeros(round(wait_s / STEP_S)), np.full(round(moving_s / STEP_S), sign * speed)])
