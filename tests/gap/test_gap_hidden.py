"""Causes that hide: behind tolerances, in one log alone, within one sample, behind a coarse encoder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gap_sets
import numpy as np
import pytest

from frictid_hil.blind.generator import Assignment, draw_case, write_case
from frictid_hil.config.nominal import Tolerance
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.experiment_set import Experiment, ExperimentSet
from frictid_hil.gap.plant_channel import plant_channel
from frictid_hil.gap.prepared import believed_joint, simulated_joint
from frictid_hil.gap.residuals import demand_of, recordings, rms
from frictid_hil.gap.tolerances import Tolerances
from frictid_hil.gap.verdict import DOUBTED
from frictid_hil.simulation.effects.torque_saturation import HARD, reported


@pytest.mark.slow
def test_a_scale_of_all_parts_is_not_lost_behind_their_tolerances() -> None:
    found = diagnose(gap_sets.make({"torque_constant_error": {"error_share": -0.02}}))
    assert found.causes[0].effect == "torque_constant_error"
    assert found.causes[0].parameters["error_share"].value == pytest.approx(-0.02, abs=0.004)


@pytest.mark.slow
def test_a_torque_gain_that_droops_is_no_wrong_torque_constant() -> None:
    made = gap_sets.make()

    def drooping(e: Experiment) -> Experiment:
        assert e.torque_nm is not None
        top = float(np.max(np.abs(e.torque_nm)))
        return replace(e, torque_nm=e.torque_nm * (1.0 + 0.1 * np.abs(e.torque_nm) / top))

    droops = replace(made, experiments=tuple(drooping(e) for e in made.experiments))
    found = diagnose(droops)
    assert found.verdict == "unknown" and "torque" in found.reasons["cause"]
    assert found.before.inverse_nm is not None and gap_sets.NOMINAL.curve is not None
    share = found.before.inverse_nm / gap_sets.NOMINAL.curve.coulomb_nm
    assert diagnose(droops, negligible=0.5 * share).verdict == "unknown"
    assert diagnose(droops, negligible=5.0 * share).verdict == "none", "somebody has said that it means nothing"


@pytest.mark.slow
def test_a_cable_that_pulls_back_is_no_shifted_zero() -> None:
    made = gap_sets.make()

    def pulled(e: Experiment) -> Experiment:
        assert e.torque_nm is not None
        bent = e.position_rad - 0.2
        return replace(e, torque_nm=e.torque_nm + 1.5 * bent + 6.0 * bent**3)

    found = diagnose(replace(made, experiments=tuple(pulled(e) for e in made.experiments)))
    assert found.verdict == "unknown" and "position" in found.reasons["cause"]


def _reported_early(delay_s: float, early_s: float) -> ExperimentSet:
    """A late drive whose report comes early, so that a part of its delay is over when the torque is reported."""
    made, random = gap_sets.make({"torque_delay": {"delay_s": delay_s}}, noise_nm=0.0), np.random.default_rng(3)

    def early(e: Experiment) -> Experiment:
        assert e.torque_nm is not None
        torque = np.interp(e.time_s + early_s, e.time_s, e.torque_nm)
        return replace(e, torque_nm=torque + 0.02 * random.standard_normal(torque.size))

    return replace(made, experiments=tuple(early(e) for e in made.experiments))


@pytest.mark.slow
def test_a_delay_that_is_over_when_the_torque_is_reported_is_found_in_the_plant() -> None:
    found = diagnose(_reported_early(0.0015, 0.0015))
    assert found.causes[0].effect == "torque_delay"
    assert found.causes[0].parameters["delay_s"].value == pytest.approx(0.0015, abs=0.0004)


@pytest.mark.slow
def test_a_delay_that_the_report_tells_in_whole_ticks_is_found_whole() -> None:
    """Torque is reported as it is at a tick, so that it shows 4 ms of 5.4: the tick to come has yet to act."""
    found = diagnose(_reported_early(0.0054, 0.0014))
    assert found.verdict == "explained" and found.causes[0].effect == "torque_delay"
    assert found.causes[0].parameters["delay_s"].value == pytest.approx(0.0054, abs=0.0006)


@pytest.mark.slow
def test_a_delay_beyond_the_stated_one_is_told_and_simulated_beside_it() -> None:
    believed = {"torque_delay": {"delay_s": 0.004}}
    nominal = replace(gap_sets.NOMINAL, believed_effects=believed)
    found = diagnose(replace(gap_sets.make({"torque_delay": {"delay_s": 0.008}}), nominal=nominal))
    assert found.verdict == "explained" and found.causes[0].effect == "torque_delay"
    assert found.causes[0].parameters["delay_s"].value == pytest.approx(0.004, abs=0.0005)
    before, after = (f.forward_torque_nm for f in (found.before, found.after))
    assert before is not None and after is not None and after < 0.3 * before


@pytest.mark.slow
def test_a_coarse_encoder_is_not_taken_for_friction() -> None:
    found = diagnose(gap_sets.make({"encoder_quantisation": {"step_rad": 4e-4}}))
    assert [c.effect for c in found.causes][:1] == ["encoder_quantisation"]
    assert found.verdict == "explained"


def test_a_round_knee_approaches_the_clip() -> None:
    demand = np.linspace(-3.0, 3.0, 61)
    clip = reported(demand, 0.5, 0.002, 2.0, HARD)
    assert clip.max() == 1.0
    knees = [reported(demand, 0.5, 0.002, 2.0, n) for n in (8.0, 20.0, 50.0)]
    distances = [float(np.max(np.abs(knee - clip))) for knee in knees]
    assert distances == sorted(distances, reverse=True)
    assert all(np.abs(knee).max() <= 1.0 for knee in knees)


def _drawn(effects: tuple[str, ...], index: int, seed: int, folder: Path) -> ExperimentSet:
    """A joint of the blind world, whose plant shares no formula with the diagnosis."""
    write_case(draw_case(index, seed, Assignment("single" if len(effects) == 1 else "double", effects)), folder)
    return ExperimentSet.load(folder)


@pytest.mark.slow
def test_a_lag_of_the_drive_is_told_behind_a_velocity_that_lags_by_another_filter(tmp_path: Path) -> None:
    found = diagnose(_drawn(("electrical_lag", "velocity_lag"), 0, 112304, tmp_path))
    assert {c.effect for c in found.causes[:2]} == {"electrical_lag", "velocity_lag"}
    lag = next(c for c in found.causes if c.effect == "electrical_lag")
    assert lag.parameters["time_constant_s"].value == pytest.approx(0.0078, abs=0.0004)


@pytest.mark.slow
def test_a_controller_that_acts_on_a_late_velocity_closes_the_loop(tmp_path: Path) -> None:
    """The lag was named, and left all of a closed loop's gap of five floors: it changed the report alone."""
    found = diagnose(_drawn(("velocity_lag",), 3, 114207, tmp_path))
    (lag,) = found.causes
    assert lag.effect == "velocity_lag" and lag.parameters["loop_share"].value == 1.0
    before, after, floor = (f.forward_torque_nm for f in (found.before, found.after, found.noise_floor))
    assert before is not None and after is not None and floor is not None
    assert before > 5.0 * floor and after < 1.5 * floor


@pytest.mark.slow
def test_a_lag_of_the_report_alone_leaves_the_controllers_velocity_as_it_is() -> None:
    found = diagnose(gap_sets.make({"velocity_lag": {"time_constant_s": 0.01}}))
    lag = next(c for c in found.causes if c.effect == "velocity_lag")
    assert lag.parameters["loop_share"].value == 0.0


@pytest.mark.slow
def test_play_is_found_behind_a_coarse_encoder(tmp_path: Path) -> None:
    found = diagnose(_drawn(("backlash", "encoder_quantisation"), 42, 102306, tmp_path))
    assert {c.effect for c in found.causes[:2]} == {"backlash", "encoder_quantisation"}


@pytest.mark.slow
def test_an_error_well_within_its_tolerance_is_no_gap_and_one_beyond_it_is_named() -> None:
    made = gap_sets.make({"friction_level_error": {"error_share": -0.007}})
    assert diagnose(made).verdict == "none"
    exact = replace(made.nominal, tolerances=Tolerances.of(Tolerance(friction_torque=0.001)))
    found = diagnose(replace(made, nominal=exact))
    assert found.verdict == "explained" and found.causes[0].effect == "friction_level_error"


@pytest.mark.slow
def test_a_cable_is_unknown_where_most_of_it_has_no_name_although_gravity_would_describe_it(tmp_path: Path) -> None:
    found = diagnose(_drawn(("cable_spring",), 116, 113207, tmp_path))
    assert found.verdict == "unknown" and "position" in found.reasons["cause"]


@pytest.mark.slow
def test_an_error_of_three_one_sigma_is_doubted_where_something_has_no_name(tmp_path: Path) -> None:
    found = diagnose(_drawn(("cable_spring",), 35, 113207, tmp_path))
    told = {cause.effect: cause.confidence for cause in found.causes}
    assert told["gravity_error"] == DOUBTED


@pytest.mark.slow
def test_an_error_of_the_belief_that_makes_four_floors_in_the_loop_is_named_small_as_it_is_along_the_motion(
    tmp_path: Path,
) -> None:
    """It made 1.6 floors along the motion and less than 5 % of the friction, and was taken for what a belief allows."""
    found = diagnose(_drawn(("torque_constant_error",), 67, 113407, tmp_path))
    assert found.verdict == "explained" and found.causes[0].effect == "torque_constant_error"


def _rows_kept(e: Experiment, every: int) -> Experiment:
    assert e.velocity_rad_s is not None and e.torque_nm is not None and e.position_command_rad is not None
    return replace(
        e,
        time_s=e.time_s[::every],
        position_rad=e.position_rad[::every],
        velocity_rad_s=e.velocity_rad_s[::every],
        torque_nm=e.torque_nm[::every],
        position_command_rad=e.position_command_rad[::every],
    )


def test_a_log_that_lacks_ticks_folds_the_jumps_of_a_coarse_encoders_torque_into_noise() -> None:
    """Such a healthy joint had a gap of two floors along the motion, and its causes were looked for there."""
    made = gap_sets.make(nominal=replace(gap_sets.NOMINAL, encoder_resolution_rad=5e-4))
    thin = replace(made, experiments=tuple(_rows_kept(e, 5) for e in made.experiments))
    logs = recordings(thin)
    smooth, stepped = believed_joint(thin, simulated_joint(thin, logs))
    found = [plant_channel(thin.nominal, logs, (), (), smooth, steps) for steps in ((), stepped)]
    floors = [channel.known_floor for channel in found if channel is not None]
    assert found[1] is not None
    shown = rms(np.concatenate([log.y[log.told] for log in found[1].logs]))
    assert floors[0] < 0.85 * shown and 0.9 * shown < floors[1] < 1.25 * shown
    assert believed_joint(made, simulated_joint(made, recordings(made)))[1] == ()
    # An encoder that nobody states has no steps; noise of the position itself stays.
    unstated = replace(thin, nominal=replace(thin.nominal, encoder_resolution_rad=None))
    smooth, stepped = believed_joint(unstated, simulated_joint(unstated, logs))
    alone, both = (plant_channel(unstated.nominal, logs, (), (), smooth, steps) for steps in ((), stepped))
    assert alone is not None and both is not None and 0.0 < alone.known_floor == both.known_floor


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effects", "index", "play_rad"),
    [(("backlash",), 96, 0.0138), (("temperature_drift", "backlash"), 98, 0.00455)],
    ids=["alone", "beside drift"],
)
def test_play_whose_phase_is_lost_along_the_motion_is_sought_in_closed_loop(
    tmp_path: Path, effects: tuple[str, ...], index: int, play_rad: float
) -> None:
    """Both were ``unknown``: along the motion wrong gravity, torque constant and efficiency stood in for it."""
    found = diagnose(_drawn(effects, index, 114707, tmp_path))
    assert found.verdict == "explained" and "link" in found.reasons
    assert {c.effect for c in found.causes[: len(effects)]} == set(effects)
    play = next(c for c in found.causes if c.effect == "backlash").parameters["gap_rad"]
    assert play.value == pytest.approx(play_rad, rel=0.15)
    assert len(effects) > 1 or all(c.confidence < 0.5 for c in found.causes[1:])
    before, after = (f.forward_torque_nm for f in (found.before, found.after))
    assert before is not None and after is not None and after < 0.33 * before


@pytest.mark.slow
def test_a_demand_column_beside_a_known_controller_does_not_hide_the_joint() -> None:
    """The believed joint was recorded with the set's own demand, and all of its gap lay between demand and torque."""
    made = gap_sets.make({"inertia_error": {"error_share": 0.3}})
    controller = gap_sets.NOMINAL.controller
    assert controller is not None
    told = [replace(e, torque_demand_nm=demand_of(controller, e, e.step_s)) for e in made.experiments]
    found = diagnose(replace(made, experiments=tuple(told)))
    assert found.verdict == "explained" and [c.effect for c in found.causes] == ["inertia_error"]
