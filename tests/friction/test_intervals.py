"""The intervals are judged where they are hard: on plants with effects that no estimator here contains."""

from dataclasses import replace

import numpy as np
import pytest

from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.estimate import estimate
from frictid_hil.friction.intervals import aligned_pairs, coulomb_half_width_nm, window_terms
from frictid_hil.friction.recording import Skew, synchronised
from frictid_hil.friction.skew import Delay, seen_delay

UNKNOWN = {
    "ripple": {"ripple": 0.1},
    "soft": {"link_share": 0.5, "link_frequency_hz": 28.0},
    "load": {"load": 0.05},
    "plain": {},
}


def outcome(plants, joint, seed, method, amplitude=20):
    """(error, half width) at every knot, as shares of the friction; true skew drawn as it was declared."""
    procedure = plants.procedure(amplitude)
    recording = plants.record(joint, procedure, seed=seed)
    uncertainty = 1e-4
    wrong = np.random.default_rng(seed + 77).normal() * uncertainty
    recording = replace(recording, skew=Skew(torque_delay_s=5e-4 + wrong, uncertainty_s=uncertainty))
    result = estimate(recording, method)
    knots = np.array(result.curve.velocity_rad_s)
    level = np.mean(result.curve.torque_nm)
    error = np.array(result.curve.torque_nm) - joint.steady(knots)
    return error / level, result.half_width_nm / level


@pytest.mark.slow
@pytest.mark.parametrize("method", ["function-a", "aligned", "least-squares"])
@pytest.mark.parametrize("indices", [(1, 3), (0, 5)])
def test_nine_of_ten_knots_are_covered_and_the_intervals_are_not_useless(plants, method, indices):
    errors, widths = [], []
    for kind, effects in UNKNOWN.items():
        for index in indices:
            error, width = outcome(plants, replace(plants.arm[index], **effects), 3 * index + len(kind), method)
            errors.append(error)
            widths.append(width)
    error, width = np.concatenate(errors), np.concatenate(widths)
    assert np.mean(np.abs(error) <= width) >= 0.90
    assert np.sqrt(np.mean(width**2)) <= 5 * np.sqrt(np.mean(error**2))


@pytest.mark.slow
def test_a_drifting_joint_gets_wide_intervals(plants):
    error, width = outcome(plants, replace(plants.arm[1], drift=-0.05), 1, "aligned")
    assert np.mean(np.abs(error) <= width) >= 0.9
    assert np.mean(width) > 0.03


def test_skew_that_is_left_open_widens_the_fast_knots_only(plants):
    recording = plants.record(plants.arm[1], plants.procedure(20))
    recording = replace(recording, skew=Skew(torque_delay_s=5e-4, uncertainty_s=1e-3))
    motion = synchronised(recording)
    terms = window_terms(recording, motion, aligned_pairs(recording, motion), None, None, None, None)
    assert terms.skew[0] < 0.01 * terms.skew[-1]
    predicted = 0.93 * 1.9 * recording.procedure.velocity_rad_s * 1e-3
    predicted *= recording.procedure.angular_frequencies_rad_s[-1] ** 2
    assert terms.skew[-1] == pytest.approx(predicted, rel=0.15)


@pytest.mark.parametrize(("wrong_s", "left_open_s"), [(0.0, (0.0, 3e-4)), (5e-4, (3e-4, 8e-4)), (4e-3, (1e-3, 1e-3))])
def test_data_narrow_what_the_declaration_leaves_open_but_never_widen_it(plants, wrong_s, left_open_s):
    recording = plants.record(plants.arm[1], plants.procedure(10))
    recording = replace(recording, skew=Skew(torque_delay_s=5e-4 + wrong_s, uncertainty_s=1e-3))
    motion = synchronised(recording)
    low, high = left_open_s
    assert low <= seen_delay(recording, motion, 25.0).open_s(recording.skew.uncertainty_s) <= high


@pytest.mark.slow
def test_the_seen_delay_widens_an_interval_and_moves_no_curve(plants, monkeypatch):
    recording = plants.record(plants.arm[1], plants.procedure(10))
    recording = replace(recording, skew=Skew(torque_delay_s=1e-3, uncertainty_s=1e-3))
    with_it = estimate(recording)
    monkeypatch.setattr("frictid_hil.friction.cleaned.seen_delay", lambda *_: Delay(1.0, 1.0))
    without = estimate(recording)
    assert with_it.curve == without.curve
    assert np.all(with_it.half_width_nm <= without.half_width_nm)


def extended(recording, more_nm):
    """The recording with that much more friction, given speed, acceleration and place along the travel (-1 to 1)."""
    motion = synchronised(recording)
    inside = (motion.time_s >= 0) & (motion.time_s < recording.procedure.duration_s)
    low, high = np.min(motion.position_rad[inside]), np.max(motion.position_rad[inside])
    place = (2 * motion.position_rad - low - high) / (high - low)
    more = np.sign(motion.velocity_rad_s) * more_nm(motion.velocity_rad_s, motion.acceleration_rad_s2, place)
    return replace(recording, torque_nm=recording.torque_nm + more)


@pytest.mark.slow
@pytest.mark.parametrize("amplitude", [20, 5])
def test_friction_that_rises_along_the_travel_is_no_scatter_of_its_mean(plants, amplitude):
    recording = plants.record(plants.arm[0], plants.procedure(amplitude))
    level = np.full(10, 12.0)
    plain, sloped = estimate(recording), estimate(extended(recording, lambda v, a, x: 0.05 * 12.0 * x))
    moved = np.array(sloped.curve.torque_nm) - np.array(plain.curve.torque_nm)
    assert np.all(np.abs(moved) < 0.003 * level)
    assert np.all(np.abs(sloped.terms.scatter - plain.terms.scatter) < 0.003 * level)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["aligned", "least-squares"])
@pytest.mark.parametrize(
    "more_nm",
    [lambda v, a, x: 0.04 * 1.1 * np.abs(a), lambda v, a, x: 0.03 * 12.0 * (3 * x**2 - 1) / 2],
    ids=["load", "bend along the travel"],
)
def test_what_place_and_load_do_to_a_curve_is_in_its_interval(plants, method, more_nm):
    recording = plants.record(plants.arm[0], plants.procedure(10))
    plain, more = estimate(recording, method), estimate(extended(recording, more_nm), method)
    fast = np.array(plain.curve.velocity_rad_s) > 0.2
    changed_nm = np.interp(plain.curve.velocity_rad_s, more.curve.velocity_rad_s, more.curve.torque_nm)
    moved = float(np.sqrt(np.mean((changed_nm - plain.curve.torque_nm)[fast] ** 2)))
    known = float(np.sqrt(np.mean(more.terms.beside[more.terms.beside.size - fast.sum() :] ** 2)))
    before = float(np.sqrt(np.mean(plain.terms.beside[fast] ** 2)))
    assert moved > 0.03
    assert 0.5 * moved < known < 2.0 * moved
    assert before < 0.5 * known


@pytest.mark.slow
@pytest.mark.parametrize("index", [3, 4])
def test_a_repeated_cycle_that_runs_slower_feigns_no_drift(plants, index):
    """At 5 deg the fast cycle before leaves the repeated one 3 % slower, which is 0.6 % less viscous friction."""
    recording = plants.record(plants.arm[index], plants.procedure(5))
    assert abs(estimate(recording).drift.change) < 0.0025
    falling = replace(plants.arm[index], drift=-0.12)  # in 16 s, so 1.5 % between the two runs
    assert estimate(plants.record(falling, plants.procedure(5))).drift.change == pytest.approx(-0.015, abs=0.0035)


def test_a_torque_that_beats_with_the_speed_is_in_the_interval_where_it_is_declared(plants):
    """A servo's current, read once per goal, was off by the same at the same speed in every pass: no scatter tells."""
    joint = plants.arm[1]
    recording = plants.record(joint, replace(plants.procedure(20), cycles=2))
    speed = np.abs(recording.velocity_rad_s)
    beat = 0.08 * joint.steady(speed) * np.sin(2 * np.pi * speed / (0.15 * recording.procedure.velocity_rad_s))
    recording = replace(recording, torque_nm=recording.torque_nm + np.sign(recording.velocity_rad_s) * beat)
    halves, errors = [], []
    for beats in (False, True):
        found = estimate(replace(recording, skew=replace(recording.skew, torque_beats=beats)), "least-squares")
        knots = np.array(found.curve.velocity_rad_s)
        errors.append(np.abs(np.array(found.curve.torque_nm) - joint.steady(knots)))
        halves.append(found.half_width_nm)
    (missed, covered), (error, same) = halves, errors
    assert np.array_equal(error, same)
    assert not np.all(error <= missed)
    assert np.all(error <= covered)


def test_coulomb_interval_is_that_of_a_line_through_two_uncertain_pairs():
    curve = FrictionCurve.through(np.array([0.2, 0.4, 0.6]), np.array([5.0, 5.2, 5.4]))
    draws = np.random.default_rng(0).normal(size=(100_000, 2)) * [0.1, 0.05]
    level = (5.0 + draws[:, 0]) * 2 - (5.2 + draws[:, 1])
    assert coulomb_half_width_nm(curve, np.array([0.1, 0.05, 0.05])) == pytest.approx(np.std(level), rel=0.02)
