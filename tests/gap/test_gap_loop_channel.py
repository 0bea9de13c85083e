"""The closed loop's own torque: how it answers, and what a coarse encoder hides along the motion."""

from __future__ import annotations

from dataclasses import replace

import gap_sets
import numpy as np
import pytest

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.diagnosis import Diagnosis
from frictid_hil.gap.experiment_set import Nominal
from frictid_hil.gap.forward import Effects, Replay, Simulation
from frictid_hil.gap.linear_loop import answered
from frictid_hil.gap.loop_channel import STANDS_S, drift_nm, loop_channel
from frictid_hil.gap.reading import HIDES
from frictid_hil.gap.residuals import LowPass, recordings, rms
from frictid_hil.simulation.effects import all_effects

COARSE = replace(gap_sets.NOMINAL, encoder_resolution_rad=6e-4)
QUICK = ("sines_small", "triangle_slow", "sines_repeat")


def columns(effects: Effects, nominal: Nominal) -> tuple[Array, Array]:
    """(what the simulator's torque changes by with an effect, what the linearised loop says of it), settled rows."""
    experiments = gap_sets.make(nominal=nominal, only=QUICK)
    replay = Replay(experiments).without_steps()
    ((name, values),) = effects.items()
    bare, changed = replay({}), replay(effects)
    assert nominal.controller is not None
    form = all_effects()[name].inverse
    assert form is not None
    (strength,) = values.values()
    simulated, linear = [], []
    for r in recordings(replace(experiments, experiments=replay.recorded())):
        assert r.view is not None
        (asked,) = form.regressors([r.view], {})
        low_pass, first = LowPass.at(1.0 / r.step_s), bare[r.experiment.name].settled
        told = strength * low_pass(answered(asked, r.view, nominal, nominal.controller))[:, 0]
        simulated.append((bare[r.experiment.name].torque_nm - changed[r.experiment.name].torque_nm)[first:])
        linear.append(told[first:])
    return np.concatenate(simulated), np.concatenate(linear)


@pytest.mark.parametrize("gradual", [False, True])
@pytest.mark.parametrize(
    ("effects", "share"),
    [
        ({"friction_level_error": {"error_share": 0.02}}, 0.1),
        ({"gravity_error": {"error_share": 0.02}}, 0.1),
        ({"torque_bias": {"bias_nm": 0.05}}, 0.05),
        ({"viscous_error": {"error_share": 0.05}}, 0.1),
        ({"inertia_error": {"error_share": 0.05}}, 0.3),
    ],
)
def test_the_linearised_loop_answers_as_the_simulated_one(effects: Effects, share: float, gradual: bool) -> None:
    nominal = replace(gap_sets.NOMINAL, yields_gradually=gradual)
    simulated, linear = columns(effects, nominal)
    assert rms(simulated - linear) < share * rms(simulated)


def test_what_is_asked_at_no_time_is_answered_at_none() -> None:
    (r, *_) = recordings(gap_sets.make(only=QUICK))
    assert r.view is not None and gap_sets.NOMINAL.controller is not None
    nothing = np.zeros((r.view.position_rad.size, 2))
    assert not answered(nothing, r.view, gap_sets.NOMINAL, gap_sets.NOMINAL.controller).any()


def test_a_joint_at_rest_does_not_ring_up() -> None:
    (r, *_) = recordings(gap_sets.make(only=QUICK))
    nominal = replace(gap_sets.NOMINAL, yields_gradually=True)
    assert r.view is not None and nominal.controller is not None
    tremble = 1e-9 * (-1.0) ** np.arange(r.view.position_rad.size)
    at_rest = replace(r.view, velocity_rad_s=tremble, slip=np.full_like(tremble, 0.98), gradual_rad=2e-4)
    asked = np.ones((tremble.size, 1))
    assert float(np.max(np.abs(answered(asked, at_rest, nominal, nominal.controller)))) < 3.0


def test_a_standing_joints_integral_says_nothing() -> None:
    """It moves for a second, stands for two, flickering by a count, and moves on."""
    step_s, count_rad = 0.002, 1e-3
    time_s = step_s * np.arange(2000)
    position = np.where(time_s < 1.0, 0.3 * time_s, np.where(time_s < 3.0, 0.3, 0.3 + 0.3 * (time_s - 3.0)))
    position = position + count_rad * (np.arange(2000) % 2)
    drift = drift_nm(0.1 * time_s, position, 2.0 * count_rad, step_s)
    stands = (time_s > 1.0 + STANDS_S + 0.01) & (time_s < 3.0)
    assert np.all(drift[time_s < 1.0 + STANDS_S - 0.01] == 0.0) and np.all(drift[time_s > 3.01] == 0.0)
    assert np.allclose(drift[stands], 0.1 * (time_s[stands] - 1.0 - STANDS_S), atol=2e-3)


def told(effects: dict[str, dict[str, float]]) -> Diagnosis:
    return diagnose(gap_sets.make(effects, COARSE, noise_nm=0.01))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "number", "value"),
    [
        ("friction_level_error", "error_share", 0.1),
        ("gravity_error", "error_share", 0.1),
        ("torque_bias", "bias_nm", 0.3),
    ],
)
def test_a_cause_that_steps_hide_is_found_in_the_loops_torque(effect: str, number: str, value: float) -> None:
    found = told({effect: {number: value}})
    assert found.reasons["encoder"] == HIDES
    assert found.verdict == "explained" and found.causes[0].effect == effect
    one = found.causes[0].parameters[number]
    assert one.low is not None and one.high is not None and one.low < value < one.high
    assert found.after.forward_torque_nm is not None and found.before.forward_torque_nm is not None
    assert found.after.forward_torque_nm < 0.5 * found.before.forward_torque_nm
    assert found.before.inverse_nm is not None  # the figures along the motion are told all the same


@pytest.mark.slow
def test_a_healthy_joint_with_a_coarse_encoder_is_none() -> None:
    assert told({}).verdict == "none"


@pytest.mark.slow
def test_what_no_effect_names_is_unknown_behind_a_coarse_encoder_too() -> None:
    ripple = {"amplitude_nm": 2.0, "cycles_per_motor_revolution": 2.0, "phase_rad": 0.7}
    left_out = diagnose(
        gap_sets.make({"torque_ripple": ripple}, COARSE, noise_nm=0.01),
        library=["friction_level_error", "viscous_error", "inertia_error"],
    )
    assert left_out.verdict == "unknown"


def test_a_loop_that_runs_away_is_no_channel(monkeypatch: pytest.MonkeyPatch) -> None:
    experiments = gap_sets.make(nominal=COARSE, only=QUICK)
    replay = Replay(experiments)
    simulation = Simulation(replay, True, replay({}, validation=True), 0.01, 0.01)
    believed = recordings(replace(experiments, experiments=replay.recorded()))
    stays = loop_channel(experiments.nominal, believed, simulation, {}, (), (), (0.0, 0.0))
    assert stays is not None and stays.name == "loop"
    runs = replay({})
    away = {name: replace(run, torque_nm=np.full_like(run.torque_nm, np.nan)) for name, run in runs.items()}
    monkeypatch.setattr(Replay, "__call__", lambda *_, **__: away)
    assert loop_channel(experiments.nominal, believed, simulation, {}, (), (), (0.0, 0.0)) is None
