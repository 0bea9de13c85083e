"""The traps of a diagnosis: each of these sets has led a plausible method to a wrong answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import gap_sets
import numpy as np
import pytest
from scipy import signal

from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.gap.cautions import below_first_pair
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.diagnosis import Value
from frictid_hil.gap.experiment_set import Controller, Experiment, ExperimentSet
from frictid_hil.gap.findings import Finding
from frictid_hil.gap.forward import nominal_model
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.replay import Controller as Loop
from frictid_hil.simulation.replay import closed_loop

PRESLIDING = {"presliding_hysteresis": {"share": 0.5, "distance_rad": 0.02}}
SPRING_RAD = 3.03 / 20000.0  # friction at the start over its stiffness, of the sets that are made here
WITHOUT_LOOP = [pytest.param(False, id="no controller"), pytest.param(True, id="closed loop")]


def _as_told(experiments: ExperimentSet, loop: bool) -> ExperimentSet:
    nominal = experiments.nominal if loop else replace(experiments.nominal, controller=None)
    return replace(experiments, nominal=nominal)


def _each(experiments: ExperimentSet, change: Callable[[Experiment], Experiment]) -> ExperimentSet:
    return replace(experiments, experiments=tuple(change(e) for e in experiments.experiments))


# -- traces below the floor -------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)])
def test_traces_that_are_real_but_drown_in_noise_are_no_cause(seed: int) -> None:
    traces = {
        "direction_asymmetry": {"coulomb_share": 0.003},
        "torque_ripple": {"amplitude_nm": 0.008, "cycles_per_motor_revolution": 2.0},
        "gravity_error": {"error_share": 0.002},
        "velocity_lag": {"time_constant_s": 1e-5},
    }
    found = diagnose(gap_sets.make(traces, seed=seed))
    assert found.verdict == "none" and not found.causes
    assert found.after == found.before
    assert found.improved_model() is None or not found.improved_model().effects


@pytest.mark.slow
def test_a_torque_constant_takes_nothing_back_from_presliding() -> None:
    withheld = {
        "torque_constant_error": {"error_share": -0.1},
        "presliding_hysteresis": {"share": 0.07, "distance_rad": 0.003},
    }
    found = diagnose(gap_sets.make(withheld))
    assert found.verdict == "explained" and [cause.effect for cause in found.causes] == list(withheld)


# -- the tool's own figures -------------------------------------------------------------------------------------------


def _loop(c: Controller) -> Loop:
    return Loop(
        c.kp_nm_per_rad, c.ki_nm_per_rad_s, c.kd_nm_s_per_rad, c.rate_hz, c.velocity_filter_s, c.torque_limit_nm
    )


def _torque_in_the_logs(experiments: ExperimentSet, model: JointModel) -> float:
    """RMS between recorded and simulated torque over the validation logs, formed here without the diagnosis.

    From 0.3 s after the joint has left its first place by three times what its friction's spring bends.
    """
    assert experiments.nominal.controller is not None
    loop, state, parts = _loop(experiments.nominal.controller), None, []
    for e in experiments.experiments:
        assert e.position_command_rad is not None and e.torque_nm is not None
        rows = closed_loop(model, loop, e.time_s, e.position_command_rad, payload=e.payload, state=state)
        state = rows.state
        b, a = signal.butter(4, 20.0 / (0.5 / gap_sets.STEP_S))
        if e.validation:
            moved = np.abs(e.position_rad - e.position_rad[0]) > 3.0 * SPRING_RAD
            settled = int(np.argmax(moved)) + round(0.3 / gap_sets.STEP_S)
            parts.append(signal.filtfilt(b, a, e.torque_nm - rows.torque_nm, padlen=15)[settled:])
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "effects",
    [
        {},
        {"torque_bias": {"bias_nm": 0.25}},
        pytest.param(PRESLIDING, marks=pytest.mark.slow),
        pytest.param({"joint_elasticity": {"compliance_rad_per_nm": 6e-4}}, marks=pytest.mark.slow),
        pytest.param({"torque_delay": {"delay_s": 0.003}}, marks=pytest.mark.slow),
    ],
    ids=lambda effects: next(iter(effects), "healthy"),
)
def test_no_gap_is_reported_that_is_larger_than_the_logs_contain(effects: dict[str, dict[str, float]]) -> None:
    experiments = gap_sets.make(effects)
    found = diagnose(experiments)
    nominal = nominal_model(experiments.nominal)
    before, after = found.before.forward_torque_nm, found.after.forward_torque_nm
    assert before is not None and after is not None
    assert before == pytest.approx(_torque_in_the_logs(experiments, nominal), rel=0.01)
    improved = found.improved_model()
    assert improved is not None
    assert after == pytest.approx(_torque_in_the_logs(experiments, improved), rel=0.01)
    # The simulator that made the logs leaves their noise alone: less than that is no floor, more is no gap.
    truth = _torque_in_the_logs(experiments, nominal.with_effects(effects))
    floor = found.noise_floor.forward_torque_nm
    assert floor is not None and floor == pytest.approx(truth, rel=0.15)
    assert after >= 0.95 * truth
    assert sum(c.gap_closed_percent or 0.0 for c in found.causes) <= 100.5


@pytest.mark.slow
def test_the_inverse_gap_of_a_known_bias_is_that_bias() -> None:
    found = diagnose(gap_sets.make({"torque_bias": {"bias_nm": 0.25}}))
    healthy = diagnose(gap_sets.make())
    assert found.before.inverse_nm is not None and healthy.before.inverse_nm is not None
    assert found.before.inverse_nm == pytest.approx(np.hypot(0.25, healthy.before.inverse_nm), rel=0.05)


# -- one sinusoid -----------------------------------------------------------------------------------------------------


def _one_sinusoid(monkeypatch: pytest.MonkeyPatch, effects: dict[str, dict[str, float]], logs: int) -> ExperimentSet:
    cycle = 0.5 * 0.8 * (1.0 - np.cos(2.0 * np.arange(0.0, np.pi, gap_sets.STEP_S)))
    command = -0.4 + np.concatenate([np.zeros(250), cycle, cycle, cycle])
    named = {f"sine_{k}": (command, False, k > 0) for k in range(logs)}
    monkeypatch.setattr(gap_sets, "commands", lambda: named)
    return gap_sets.make(effects)


@pytest.mark.slow
@pytest.mark.parametrize("loop", WITHOUT_LOOP)
@pytest.mark.parametrize("logs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_presliding_on_one_sinusoid_is_ambiguous_with_a_delay(
    loop: bool, logs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = diagnose(_as_told(_one_sinusoid(monkeypatch, PRESLIDING, logs), loop))
    assert found.verdict == "ambiguous"
    assert {c.effect for c in found.causes} >= {"presliding_hysteresis", "torque_delay"}
    assert all(c.confidence <= 0.5 for c in found.causes)
    assert "sinusoid" in found.reasons
    assert found.next_experiment is not None
    assert set(found.next_experiment.separates) == {"presliding_hysteresis", "torque_delay"}
    assert found.next_experiment.plan["experiments"] and found.next_experiment.duration_s > 0.0
    assert found.model is None or not found.model.effects, "nothing is applied"


@pytest.mark.slow
def test_presliding_on_varied_motion_is_sure() -> None:
    found = diagnose(gap_sets.make(PRESLIDING))
    assert found.causes[0].effect == "presliding_hysteresis" and found.causes[0].confidence >= 0.9
    assert "sinusoid" not in found.reasons


@pytest.mark.slow
def test_a_late_position_on_one_sinusoid_is_ambiguous_with_presliding(monkeypatch: pytest.MonkeyPatch) -> None:
    made = _one_sinusoid(monkeypatch, {}, 2)

    def late(e: Experiment) -> Experiment:
        assert e.position_command_rad is not None
        position = np.interp(e.time_s - 0.04, e.time_s, e.position_command_rad)
        return replace(e, position_rad=position, torque_nm=None, velocity_rad_s=None)

    found = diagnose(_each(made, late))
    assert found.verdict == "ambiguous"
    assert found.causes[0].effect == "torque_delay"
    assert "presliding_hysteresis" in found.causes[0].confusable_with


# -- a curve that bends below its first pair --------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("loop", WITHOUT_LOOP)
@pytest.mark.parametrize(
    ("speeds", "torques"),
    [
        ((0.01, 0.03, 0.08), (2.7, 2.85, 3.02)),
        pytest.param((0.02,), (2.5,), marks=pytest.mark.slow),
        pytest.param((0.05,), (2.9,), marks=pytest.mark.slow),
    ],
)
def test_a_curve_concave_below_its_first_pair_is_no_stribeck_without_a_warning(
    speeds: tuple[float, ...], torques: tuple[float, ...], loop: bool
) -> None:
    known = np.array([0.2, 0.8, 1.8]), np.array([3.2, 3.7, 4.5])
    true = FrictionCurve.through(np.array([*speeds, *known[0]]), np.array([*torques, *known[1]]))
    made = gap_sets.make(nominal=replace(gap_sets.NOMINAL, curve=true))
    found = diagnose(_as_told(replace(made, nominal=gap_sets.NOMINAL), loop))
    named = [c for c in found.causes if c.effect == "stribeck"]
    assert all(c.confidence < 0.6 for c in named)
    assert not named or "0.2 rad/s" in found.reasons["stribeck"]


@pytest.mark.parametrize(
    ("rest", "loop"),
    [
        (0.95, False),
        pytest.param(0.95, True, marks=pytest.mark.slow),
        pytest.param(0.9, False, marks=pytest.mark.slow),
        pytest.param(0.9, True, marks=pytest.mark.slow),
    ],
)
def test_a_level_that_is_off_is_no_curve_because_of_what_nobody_measured_near_rest(rest: float, loop: bool) -> None:
    """Below a hundredth of its largest speed friction falls by 5 or 10 %, and all of it is believed 10 % too low."""
    speeds = np.geomspace(0.02, 2.0, 10)
    torques = 2.6 + 0.5 * speeds
    true = FrictionCurve.through(np.array([0.003, *speeds]), np.array([rest * torques[0], *torques]))
    made = gap_sets.make(nominal=replace(gap_sets.NOMINAL, curve=true))
    low = replace(
        gap_sets.NOMINAL,
        curve=FrictionCurve.through(speeds, 0.9 * torques),
        presliding_stiffness_nm_per_rad=0.9 * 20000.0,
    )
    found = diagnose(_as_told(replace(made, nominal=low), loop))
    assert found.verdict == "explained" and found.causes[0].effect == "friction_level_error"
    assert found.causes[0].parameters["error_share"].value == pytest.approx(1 / 0.9 - 1, abs=0.01)
    assert {c.effect for c in found.causes} <= {"friction_level_error", "presliding_hysteresis"}


@pytest.mark.slow
def test_a_true_stribeck_effect_is_named_and_carries_the_warning() -> None:
    effect = {"stribeck": {"share": 0.3, "stribeck_velocity_rad_s": 0.06, "exponent": 1.4}}
    found = diagnose(gap_sets.make(effect))
    assert found.causes[0].effect == "stribeck" and "stribeck" in found.reasons


@pytest.mark.parametrize(("low", "warned"), [(0.15, True), (0.25, False)])
def test_a_rise_that_lies_above_the_first_pair_was_measured_and_carries_no_warning(low: float, warned: bool) -> None:
    speed = Value(low + 0.05, low, low + 0.1)
    found = Finding("stribeck", 0.99, 0.99, 10.0, 1.0, {"stribeck_velocity_rad_s": speed})
    curve = FrictionCurve.through(np.array([0.2, 0.8, 1.8]), np.array([3.2, 3.7, 4.5]))
    assert (below_first_pair([found], curve) is not None) is warned


# -- winners within a log that lose across logs -----------------------------------------------------------------------


def _flipped_bias(e: Experiment) -> Experiment:
    assert e.torque_nm is not None
    return replace(e, torque_nm=e.torque_nm + (-0.25 if e.validation else 0.25))


def _bias_of_one_half(e: Experiment) -> Experiment:
    assert e.torque_nm is not None
    return replace(e, torque_nm=e.torque_nm + (0.0 if e.validation else 0.25))


def _flipped_ripple(e: Experiment) -> Experiment:
    assert e.torque_nm is not None
    wave = 0.3 * np.cos(200.0 * e.position_rad + (np.pi if e.validation else 0.0))
    return replace(e, torque_nm=e.torque_nm + wave)


@pytest.mark.slow
@pytest.mark.parametrize("loop", WITHOUT_LOOP)
@pytest.mark.parametrize("change", [_flipped_bias, _bias_of_one_half, _flipped_ripple])
def test_what_wins_within_its_logs_and_loses_on_others_is_not_reported(
    change: Callable[[Experiment], Experiment], loop: bool
) -> None:
    found = diagnose(_as_told(_each(gap_sets.make(), change), loop))
    assert found.verdict in ("none", "unknown")
    assert not found.causes
    assert found.after == found.before
