"""How much joints that move together drive each other, on torques made of known matrices."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from frictid_hil.errors import IdentificationError
from frictid_hil.friction.coupling import companions, coupled_inertia, pull
from frictid_hil.friction.estimate import estimate
from frictid_hil.friction.intervals import aligned_pairs
from frictid_hil.friction.recording import CycleRecording, synchronised
from frictid_hil.friction.trajectory import Array, Procedure, position
from frictid_hil.plan.plan import Shake

STEP_S = 0.004
PROCEDURE = Procedure(math.radians(20), math.radians(115))
NAMES = ("0", "1", "2")
INERTIA = np.array([[2.4, 0.6, -0.05], [0.6, 0.64, 0.04], [-0.05, 0.04, 0.065]])
LAG_S = (0.0024, 0.0021, 0.0031)
COULOMB = (20.0, 12.0, 4.0)


def friction_nm(joint: int, velocity: Array) -> Array:
    torque: Array = COULOMB[joint] * (np.tanh(velocity / 1e-3) + 0.1 * velocity)
    return torque


def recorded(
    paths: dict[str, Array], time_s: Array, *, noise: float, matrix: Array = INERTIA
) -> dict[str, CycleRecording]:
    """Torques that these positions take, accelerations by differences on a grid forty times finer."""
    random = np.random.default_rng(3)
    fine = np.linspace(time_s[0], time_s[-1], 40 * (time_s.size - 1) + 1)
    motion = {name: np.interp(fine, fine, path) for name, path in paths.items()}
    velocity = {name: np.gradient(q, fine) for name, q in motion.items()}
    acceleration = np.column_stack([np.gradient(velocity[name], fine) for name in NAMES])
    records = {}
    for i, name in enumerate(NAMES):
        torque = acceleration @ matrix[i] + friction_nm(i, velocity[name]) + 5.0 * np.cos(motion[name])
        kept = slice(None, None, 40)
        records[name] = CycleRecording(
            time_s=time_s,
            position_rad=motion[name][kept],
            torque_nm=torque[kept] + noise * COULOMB[i] * random.standard_normal(time_s.size),
            procedure=PROCEDURE,
            gear_ratio=100.0,
            where=f"joint {name}",
        )
    return records


def stretches(*, noise: float = 0.01, alike: bool = False) -> dict[str, CycleRecording]:
    shakes = [Shake.beside(0.2 * i, PROCEDURE, 0 if alike else i) for i in range(3)]
    time_s = np.arange(0.0, shakes[0].duration_s, STEP_S)
    fine = np.linspace(time_s[0], time_s[-1], 40 * (time_s.size - 1) + 1)
    lags = (0.002,) * 3 if alike else LAG_S
    return recorded(
        {name: shakes[i].position_rad(np.maximum(fine - lags[i], 0.0)) for i, name in enumerate(NAMES)},
        time_s,
        noise=noise,
    )


def cycles(matrix: Array = INERTIA) -> dict[str, CycleRecording]:
    time_s = np.arange(-0.4, PROCEDURE.duration_s + 0.4, STEP_S)
    fine = np.linspace(time_s[0], time_s[-1], 40 * (time_s.size - 1) + 1)
    paths = {name: 0.2 * i + position(PROCEDURE, fine - LAG_S[i]) for i, name in enumerate(NAMES)}
    return recorded(paths, time_s, noise=0.0, matrix=matrix)


def test_the_matrix_is_found_and_its_deviation_is_honest() -> None:
    known = coupled_inertia(stretches(noise=0.01))
    for i, name in enumerate(NAMES):
        for j, other in enumerate(NAMES):
            if i == j:
                assert other not in known[name]
                continue
            value, deviation = known[name][other]
            assert value == known[other][name][0]
            assert abs(value - INERTIA[i, j]) < 4 * deviation + 0.002 * math.sqrt(INERTIA[i, i] * INERTIA[j, j])
            assert deviation < 0.03 * math.sqrt(INERTIA[i, i] * INERTIA[j, j])


@pytest.mark.slow
def test_what_unlike_lags_leave_in_the_curve_is_taken_off() -> None:
    moved, lone = cycles(), cycles(np.diag(np.diag(INERTIA)))
    for name in NAMES[:2]:
        alone = replace(moved[name], coupled=True)
        informed = replace(alone, companions=companions(stretches(), moved, name))
        left, right, by_itself = estimate(alone), estimate(informed), estimate(lone[name]).curve
        speeds = np.asarray(by_itself.velocity_rad_s)
        before = np.abs(left.curve.magnitude(speeds) - by_itself.magnitude(speeds)).max() / by_itself.coulomb_nm
        after = np.abs(right.curve.magnitude(speeds) - by_itself.magnitude(speeds)).max() / by_itself.coulomb_nm
        assert before > 0.002
        assert after < 0.1 * before
        assert any("nothing was taken off" in note for note in left.notes)
        assert not any("nothing was taken off" in note for note in right.notes)
        assert right.terms is not None
        assert np.all(right.terms.link > 0)


def test_joints_that_shake_alike_cannot_be_told_apart() -> None:
    with pytest.raises(IdentificationError, match="cannot be told from the coupling stretch"):
        coupled_inertia(stretches(alike=True))


@pytest.mark.parametrize("amplitude_deg", [5, 20, 50])
@pytest.mark.parametrize("place", [0, 5])
def test_shaking_keeps_to_the_travel_and_never_reverses(amplitude_deg: float, place: int) -> None:
    procedure = Procedure(math.radians(amplitude_deg), math.radians(115))
    shake = Shake.beside(0.3, procedure, place)
    time_s = np.linspace(0.0, shake.duration_s, 20001)
    path = shake.position_rad(time_s) - 0.3
    assert path[0] == path[-1] == pytest.approx(0.0, abs=1e-12)
    assert path.min() >= -1e-12 and path.max() <= procedure.amplitude_rad + 1e-12
    speed = np.gradient(path, time_s)
    half = time_s.size // 2
    assert speed[1:half].min() > -1e-6 and speed[half + 1 : -1].max() < 1e-6
    assert abs(speed[0]) < 1e-3 and abs(speed[-1]) < 1e-3
    fastest = procedure.velocity_rad_s * procedure.angular_frequencies_rad_s[-1]
    assert np.abs(np.gradient(speed, time_s)).max() < 0.75 * fastest


@pytest.mark.slow
def test_least_squares_follows_an_inertia_that_changes_along_the_travel() -> None:
    """As of the swing axis while the arm folds; a joint that moves alone has no such thing."""
    lone = cycles(np.diag(np.diag(INERTIA)))["0"]
    q, v, a = lone.position_rad, np.gradient(lone.position_rad, STEP_S), np.zeros_like(lone.position_rad)
    a[1:-1] = np.diff(lone.position_rad, 2) / STEP_S**2
    folding = replace(lone, torque_nm=lone.torque_nm + 4.0 * (q - 0.17) * a + 2.0 * v**2, coupled=True)
    truth = estimate(lone, "least-squares").curve
    speeds = np.linspace(0.2, 2.0, 50)

    def off(recording: CycleRecording) -> float:
        curve = estimate(recording, "least-squares").curve
        return float(np.abs(curve.magnitude(speeds) - truth.magnitude(speeds)).mean() / truth.coulomb_nm)

    assert off(folding) < 0.003
    assert off(folding) < 0.3 * off(replace(folding, coupled=False))


@pytest.mark.slow
def test_gravity_does_not_stay_in_windows_that_cover_unlike_positions() -> None:
    """A servo that stays behind by friction passes the same places at other speeds forwards than backwards."""
    time_s = np.arange(-0.4, PROCEDURE.duration_s + 0.4, STEP_S)
    fine = np.linspace(time_s[0], time_s[-1], 40 * (time_s.size - 1) + 1)
    ahead = [position(PROCEDURE, fine - lag) for lag in LAG_S]
    behind = [q - 0.003 * np.tanh(np.gradient(q, fine) / 0.2) for q in ahead]
    light = recorded({name: 0.2 * i + behind[i] for i, name in enumerate(NAMES)}, time_s, noise=0.0)
    heavy = {
        name: replace(one, torque_nm=one.torque_nm + 4 * COULOMB[i] * np.sin(one.position_rad))
        for i, (name, one) in enumerate(light.items())
    }
    shaken = stretches(noise=0.0)
    for i, name in enumerate(NAMES):
        coupled = replace(heavy[name], coupled=True, companions=companions(shaken, heavy, name))
        motion = synchronised(coupled)
        freed = replace(motion, torque_nm=motion.torque_nm - pull(coupled, motion).torque_nm)
        left_in = aligned_pairs(coupled, freed)
        taken_off = estimate(coupled, "aligned").pairs
        truth = friction_nm(i, left_in.mean_speed_rad_s)
        errors = [np.abs(100 * (pairs.torque_nm / truth - 1)).max() for pairs in (left_in, taken_off)]
        assert errors[1] < 0.25 < 0.5 < errors[0]
