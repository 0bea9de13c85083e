"""The diagnosis on joints made with the product's own simulator: verdicts, figures, traps."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import gap_sets
import numpy as np
import pytest

from frictid_hil.gap import diagnose as diagnosis
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.diagnosis import Figures
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.forward import Replay, pooled
from frictid_hil.gap.reading import HIDES, STIFF, Reading
from frictid_hil.gap.residuals import LowPass, recordings, rms

SINGLES = {
    "stribeck": {"share": 0.12, "stribeck_velocity_rad_s": 0.06, "exponent": 1.4},
    "viscous_nonlinearity": {"share": 0.08, "knee_rad_s": 0.3, "bend": 2.0},
    "direction_asymmetry": {"coulomb_share": 0.07, "viscous_share": 0.15},
    "load_dependent_friction": {"linear_share": 0.1},
    "torque_ripple": {"amplitude_nm": 0.3, "cycles_per_motor_revolution": 2.0, "phase_rad": 0.7},
    "presliding_hysteresis": {"share": 0.2, "distance_rad": 0.008},
    "stiction_breakaway": {"share": 0.3, "dwell_time_s": 0.5, "travel_rad": 2e-3},
    "joint_elasticity": {"compliance_rad_per_nm": 6e-4, "relaxation_s": 1e-3},
    "torque_delay": {"delay_s": 0.003},
    "torque_constant_error": {"error_share": 0.05},
    "torque_saturation": {"limit_share": 0.3},
    "velocity_lag": {"time_constant_s": 0.006},
    "encoder_offset": {"offset_rad": 0.06},
    "gravity_error": {"error_share": 0.08},
    "inertia_error": {"error_share": 0.2},
    "torque_bias": {"bias_nm": 0.25},
    "electrical_lag": {"time_constant_s": 0.004},
    "temperature_drift": {"coulomb_share": 0.3, "viscous_share": 0.3, "power_w": 1.0, "time_constant_s": 30.0},
    "encoder_quantisation": {"step_rad": 1e-4},
}


@pytest.fixture(scope="module")
def healthy() -> ExperimentSet:
    return gap_sets.make()


@pytest.mark.slow
def test_healthy_joint_has_no_gap(healthy: ExperimentSet) -> None:
    d = diagnose(healthy)
    assert d.verdict == "none" and not d.causes
    assert d.before.forward_torque_nm == pytest.approx(d.noise_floor.forward_torque_nm, rel=0.1)


def traces(part: float) -> dict[str, dict[str, float]]:
    """Three causes; each makes about as much as noise where ``part`` is one."""
    return {
        "torque_bias": {"bias_nm": 0.012 * part},
        "torque_ripple": {"amplitude_nm": 0.008 * part, "cycles_per_motor_revolution": 2.0},
        "presliding_hysteresis": {"share": 0.006 * part, "distance_rad": 0.01},
    }


@pytest.mark.slow
def test_traces_below_the_floor_are_not_reported() -> None:
    d = diagnose(gap_sets.make(traces(0.6)))
    assert d.verdict == "none" and not d.causes


@pytest.mark.slow
def test_traces_that_show_together_are_reported_although_they_are_small_in_practice() -> None:
    d = diagnose(gap_sets.make(traces(1.0)))
    assert d.before.forward_torque_nm < 2.0 * d.noise_floor.forward_torque_nm
    assert d.verdict == "explained" and {"presliding_hysteresis", "torque_ripple"} <= {c.effect for c in d.causes}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gravity_error", pytest.param("torque_delay", marks=pytest.mark.slow)])
def test_single_effect_is_named_and_closed(name: str) -> None:
    d = diagnose(gap_sets.make({name: SINGLES[name]}))
    assert d.verdict == "explained"
    assert d.causes[0].effect == name and d.causes[0].confidence >= 0.8
    before, after = d.before.forward_torque_nm, d.after.forward_torque_nm
    floor = d.noise_floor.forward_torque_nm
    assert before is not None and after is not None and floor is not None
    assert before > 1.5 * floor and (before - after) / (before - floor) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(SINGLES))
def test_every_effect_is_named(name: str) -> None:
    d = diagnose(gap_sets.make({name: SINGLES[name]}, seed=3))
    tied = d.causes[0].confusable_with if d.verdict == "ambiguous" else ()
    assert name in (d.causes[0].effect, *tied)


@pytest.mark.slow
def test_parameters_come_back_with_intervals_that_hold_them() -> None:
    d = diagnose(gap_sets.make({"gravity_error": SINGLES["gravity_error"]}))
    value = d.causes[0].parameters["error_share"]
    assert value.value == pytest.approx(0.08, abs=0.004)
    assert value.low is not None and value.high is not None and value.low < value.value < value.high
    drawn = [sample["gravity_error"]["error_share"] for sample in d.samples if "gravity_error" in sample]
    assert np.quantile(drawn, [0.025, 0.975]) == pytest.approx([value.low, value.high]) and len(d.samples) == 400


@pytest.mark.slow
def test_a_cause_seen_in_inverse_dynamics_alone_is_named() -> None:
    # The controller hides most of this break-away from its own replay.
    d = diagnose(gap_sets.make({"stiction_breakaway": {"share": 0.15, "dwell_time_s": 0.5, "travel_rad": 2e-3}}))
    assert d.verdict == "explained" and d.causes[0].effect == "stiction_breakaway"


@pytest.mark.slow
def test_a_large_delay_is_explained_whatever_it_leaves_in_the_plant() -> None:
    d = diagnose(gap_sets.make({"torque_delay": {"delay_s": 0.007}}))
    assert d.verdict == "explained" and d.causes[0].effect == "torque_delay"


@pytest.mark.slow
def test_a_cause_within_noise_is_told_where_no_doubt_is_left_of_it() -> None:
    d = diagnose(gap_sets.make({"torque_ripple": {"amplitude_nm": 0.02, "cycles_per_motor_revolution": 2.0}}))
    assert d.before.inverse_nm is not None and d.noise_floor.inverse_nm is not None
    assert d.before.inverse_nm < 2.0 * d.noise_floor.inverse_nm
    assert d.verdict == "explained" and d.causes[0].effect == "torque_ripple" and d.causes[0].confidence >= 0.95


def drive_that_is_late_at_times(share: float) -> ExperimentSet:
    """A drive whose torque comes two rows late in a share of all spans of 25 rows."""
    random, made = np.random.default_rng(5), gap_sets.make(noise_nm=0.0)
    experiments = []
    for one in made.experiments:
        assert one.torque_nm is not None
        rows = one.torque_nm.size
        late = np.repeat(random.random(rows // 25 + 1) < share, 25)[:rows]
        torque = np.where(late, np.concatenate([one.torque_nm[:2], one.torque_nm[:-2]]), one.torque_nm)
        noise = gap_sets.NOISE_NM * random.standard_normal(rows)
        experiments.append(replace(one, torque_nm=np.round((torque + noise) / 0.012) * 0.012))
    return replace(made, experiments=tuple(experiments))


@pytest.mark.slow
def test_a_small_cause_that_the_validation_logs_never_come_to_is_listed_beside_a_larger_one() -> None:
    """A drive that clips by one and a half floors was left out: the validation log never came to its limit."""
    clips = {"limit_share": 0.36, "exponent": 60.0}
    made = gap_sets.make({"torque_bias": {"bias_nm": 0.3}, "torque_saturation": clips})
    logs = (replace(log, validation=log.name == "sines_repeat") for log in made.experiments)
    found = diagnose(replace(made, experiments=tuple(logs)))
    assert [cause.effect for cause in found.causes][:2] == ["torque_bias", "torque_saturation"]
    assert found.causes[1].confidence > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.6, 0.8])
def test_a_drive_that_is_late_at_times_has_no_delay(share: float) -> None:
    d = diagnose(drive_that_is_late_at_times(share))
    assert d.verdict == "unknown" and "comes and goes" in d.reasons["cause"]


@pytest.mark.slow
def test_a_drive_that_is_late_all_the_time_has_a_delay() -> None:
    d = diagnose(drive_that_is_late_at_times(1.0))
    assert d.verdict == "explained" and d.causes[0].effect == "torque_delay" and d.causes[0].confidence >= 0.9


@pytest.mark.slow
def test_two_effects_are_both_named() -> None:
    d = diagnose(gap_sets.make({n: SINGLES[n] for n in ("torque_ripple", "torque_bias")}))
    assert {c.effect for c in d.causes[:2]} == {"torque_ripple", "torque_bias"}
    assert sum(c.gap_closed_percent or 0.0 for c in d.causes) <= 100.5


@pytest.mark.slow
def test_without_the_right_effect_in_the_library_no_wrong_one_is_sure() -> None:
    from frictid_hil.simulation.effects import all_effects

    library = set(all_effects()) - {"torque_ripple"}
    d = diagnose(gap_sets.make({"torque_ripple": SINGLES["torque_ripple"]}), library=library)
    assert d.verdict == "unknown" or all(c.confidence < 0.9 for c in d.causes)
    assert "torque_ripple" not in {c.effect for c in d.causes}


@pytest.mark.slow
def test_json_is_plain_and_shares_add_up(healthy: ExperimentSet) -> None:
    d = diagnose(gap_sets.make({"direction_asymmetry": SINGLES["direction_asymmetry"]}))
    document = json.loads(json.dumps(d.to_json()))
    assert set(document["gap"]) >= {"before", "after", "noise_floor"}
    gap = document["gap"]
    assert (
        set(gap["before"])
        == set(gap["after_interval_95"])
        == {*("inverse_nm", "forward_torque_nm", "forward_position_rad")}
    )
    low, high = gap["after_interval_95"]["inverse_nm"]
    assert low < gap["after"]["inverse_nm"] < high < 0.5 * gap["before"]["inverse_nm"]
    assert gap["band"] == {"low_hz": 0.0, "high_hz": 20.0}
    assert gap["raw"]["inverse_nm"] > gap["before"]["inverse_nm"]  # a low-pass only takes away
    assert gap["raw"]["noise_floor"]["inverse_nm"] <= gap["raw"]["inverse_nm"]
    assert sum(w["share_of_gap"] for w in document["where"]) == pytest.approx(1.0)
    assert document["causes"][0]["parameters"]["coulomb_share"]["interval_95"] is not None


@pytest.mark.slow
def test_same_answer_twice(healthy: ExperimentSet) -> None:
    experiments = gap_sets.make({"torque_bias": SINGLES["torque_bias"]})
    assert diagnose(experiments).to_json() == diagnose(experiments).to_json()


@pytest.mark.slow
def test_improved_model_closes_the_gap_in_the_simulator() -> None:
    effect = {"direction_asymmetry": SINGLES["direction_asymmetry"]}
    experiments = gap_sets.make(effect)
    d = diagnose(experiments)
    model = d.improved_model()
    assert model is not None
    assert set(model.effects) == {"direction_asymmetry", *d.fitted_along}
    assert all(value.low < value.value < value.high for own in d.fitted_along.values() for value in own.values())
    left = pooled(Replay(experiments)(model.effects, validation=True), "torque_nm")
    assert left == pytest.approx(d.after.forward_torque_nm, rel=1e-6)


def test_an_encoders_steps_make_about_what_sets_two_joints_with_other_counts_apart(healthy: ExperimentSet) -> None:
    made_nm = []
    for step_rad in (None, 1e-4, 3e-4):
        nominal = replace(healthy.nominal, encoder_resolution_rad=step_rad)
        replay = Replay(replace(healthy, nominal=nominal))
        made_nm.append(replay.steps_nm(replay({}, validation=True), True))
    elsewhere = [
        replace(e, position_command_rad=e.position_command_rad + 1.2e-4)
        for e in healthy.experiments
        if e.position_command_rad is not None
    ]
    here = replay({}, validation=True)
    there = Replay(replace(healthy, nominal=nominal, experiments=tuple(elsewhere)))({}, validation=True)
    apart = {n: replace(run, torque_nm=run.torque_nm - there[n].torque_nm) for n, run in here.items()}
    apart_nm = pooled(apart, "torque_nm")
    assert made_nm[0] == 0.0 < 2.0 * made_nm[1] < made_nm[2]
    assert 1.0 < apart_nm / made_nm[2] < 2.0  # of two draws, the root of two


@pytest.mark.slow
def test_unknown_applies_nothing_and_never_enlarges_the_gap() -> None:
    experiments = gap_sets.make()
    # A torque over position that no effect has: the recording alone knows it.
    odd = [
        replace(e, torque_nm=e.torque_nm + 0.6 * np.sin(9.0 * e.position_rad) * np.sign(np.gradient(e.position_rad)))
        for e in experiments.experiments
        if e.torque_nm is not None
    ]
    d = diagnose(replace(experiments, experiments=tuple(odd)))
    assert d.verdict == "unknown"
    assert d.after == d.before
    assert d.model is not None and not d.model.effects
    assert "cause" in d.reasons


def test_low_pass_once_a_healthy_joint_has_no_backlash(healthy: ExperimentSet) -> None:
    logs = recordings(healthy)
    low_pass = LowPass.at(500.0)
    for recording in logs:
        assert recording.plant_nm is not None and recording.actuation_nm is not None
        noise = rms(low_pass(recording.actuation_nm))
        assert rms(low_pass(recording.plant_nm)) < 3.0 * noise


@pytest.mark.slow
def test_concave_curve_below_its_first_pair_is_not_called_stribeck() -> None:
    from frictid_hil.friction.curve import FrictionCurve

    # The true curve bends down towards standstill; the nominal one was drawn straight through its first two pairs.
    speeds = np.array([0.01, 0.03, 0.08, 0.2, 0.8, 1.8])
    true = replace(gap_sets.NOMINAL, curve=FrictionCurve.through(speeds, np.array([2.7, 2.85, 3.02, 3.2, 3.7, 4.5])))
    made = gap_sets.make(nominal=true)
    d = diagnose(replace(made, nominal=gap_sets.NOMINAL))
    assert not any(c.effect == "stribeck" and c.confidence >= 0.6 for c in d.causes)


@pytest.mark.parametrize(
    ("left_nm", "first"),
    [
        ({"joint_elasticity": 0.7, "inertia_error": 0.1}, "inertia_error"),
        ({"joint_elasticity": 0.7, "inertia_error": 0.69}, "joint_elasticity"),  # which leaves about as much
        ({"joint_elasticity": 0.1, "inertia_error": 0.05}, "joint_elasticity"),  # which leaves hardly a gap
        ({"viscous_nonlinearity": 0.5, "friction_level_error": 0.1}, "friction_level_error"),
        ({"viscous_nonlinearity": 0.5, "friction_level_error": 0.49}, "viscous_nonlinearity"),
    ],
)
def test_the_closed_loop_judges_how_the_recordings_were_read(
    monkeypatch: pytest.MonkeyPatch, left_nm: dict[str, float], first: str
) -> None:
    """An elastic joint passes for a wrong inertia along a motion, and a coarse encoder hides which curve is wrong."""
    along, other = left_nm

    def along_motion(_: object, allowed: Sequence[str]) -> Any:
        return Reading(tuple(allowed), (), (), (), {"name": along if along in allowed else other})

    def stiff(_: object, reading: Any) -> Any:
        return replace(reading, reasons={"name": other, "link": STIFF})

    def in_loop(_: object, reading: Any) -> Any:
        return replace(reading, reasons={"name": other, "encoder": HIDES})

    def answered(_: object, reading: Any, __: float) -> SimpleNamespace:
        name = reading.reasons["name"]
        before, after = (Figures(forward_torque_nm=nm) for nm in (1.0, left_nm[name]))
        return SimpleNamespace(
            verdict="explained", causes=(SimpleNamespace(effect=name),), before=before, after=after,
            noise_floor=Figures(inverse_nm=0.2, forward_torque_nm=0.05), reasons=reading.reasons,
        )  # fmt: skip

    monkeypatch.setattr(diagnosis, "prepared", lambda *_: None)
    monkeypatch.setattr(diagnosis, "in_the_better_way", lambda _, reading: reading)
    monkeypatch.setattr(diagnosis, "beside_a_link", lambda *_: None)
    stand_ins = {
        "along_the_motion": along_motion, "without_links": stiff, "in_the_loop": in_loop, "_answer": answered,
    }  # fmt: skip
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(diagnosis, name, stand_in)
    answer = diagnose(cast(ExperimentSet, None))
    assert answer.causes[0].effect == first
    assert ("link" in answer.reasons) is (first == "inertia_error")


@pytest.mark.slow
def test_an_error_that_a_belief_allows_for_comes_after_what_it_does_not() -> None:
    """A level 2 % off makes more than this bias, and is a fifth of its tolerance."""
    found = diagnose(gap_sets.make({"friction_level_error": {"error_share": 0.02}, "torque_bias": {"bias_nm": 0.05}}))
    bias, level = found.causes
    assert (bias.effect, level.effect) == ("torque_bias", "friction_level_error")
    assert bias.gap_closed_percent is not None and level.gap_closed_percent is not None
    assert level.gap_closed_percent > bias.gap_closed_percent
