import numpy as np
import pytest
import scipy.io

from frictid_hil.errors import IdentificationError
from frictid_hil.friction.plateaus import plateaus


def trapezoids(speeds=(0.04, 0.08, 0.12), both=True, noise=0.0):
    step = 1e-3
    pieces = []
    for speed in speeds:
        ramp = np.linspace(0, 1, 100)
        there = speed * np.concatenate([ramp, np.ones(700), ramp[::-1], np.zeros(200)])
        pieces += [there, -there if both else np.zeros_like(there)]
    v = np.concatenate(pieces)
    time = np.arange(v.size) * step
    q = np.cumsum(v) * step
    a = np.gradient(v, step)
    rng = np.random.default_rng(0)
    torque = 95 * a + 200 * v + 20 * np.sign(v) - 3 + noise * rng.normal(size=v.size)
    return time, q, torque


def test_finds_every_speed_both_ways_and_the_line_through_them():
    pairs = plateaus(*trapezoids(noise=1.0)).pairs
    assert np.allclose(pairs.velocity_rad_s, [0.04, 0.08, 0.12], rtol=1e-3)
    assert np.allclose(pairs.torque_nm, 20 + 200 * np.array([0.04, 0.08, 0.12]), atol=0.3)
    assert np.allclose((pairs.torque_plus_nm + pairs.torque_minus_nm) / 2, -3, atol=0.3)
    assert np.all(pairs.samples_plus > 400)


def test_a_speed_held_one_way_only_is_named():
    with pytest.raises(IdentificationError, match=r"0\.04 is held, but never backward"):
        plateaus(*trapezoids(both=False))


def test_a_single_speed_makes_no_curve():
    with pytest.raises(IdentificationError, match="only one speed"):
        plateaus(*trapezoids(speeds=(0.1,)))


def test_a_sine_has_no_plateau():
    time = np.arange(8000) * 1e-3
    with pytest.raises(IdentificationError, match="no stretch of constant speed"):
        plateaus(time, np.sin(3 * time), np.cos(3 * time))


@pytest.mark.real_data
@pytest.mark.parametrize("with_command", [True, False])
def test_emps_line_is_within_ten_percent_of_the_published_one(real_data, with_command):
    data = scipy.io.loadmat(real_data / "emps" / "DATA_EMPS.mat")
    time, position, command, volts = (data[name].ravel() for name in ("t", "qm", "qg", "vir"))
    force = data["gtau"].item() * volts
    found = plateaus(time, position, force, command_rad=command if with_command else None)
    pairs, curve = found.pairs, found.curve
    assert np.allclose(pairs.velocity_rad_s, [0.0421, 0.0826, 0.1247], atol=2e-4)
    slope, level = np.polyfit(curve.velocity_rad_s, curve.torque_nm, 1)
    assert level == pytest.approx(20.3935, rel=0.10)
    assert curve.coulomb_nm == pytest.approx(20.3935, rel=0.10)
    assert slope == pytest.approx(203.5034, rel=0.10)
    assert np.mean(pairs.torque_plus_nm + pairs.torque_minus_nm) / 2 == pytest.approx(-3.16, abs=0.5)
    assert np.all((found.half_width_nm > 0.1) & (found.half_width_nm < 0.06 * np.array(curve.torque_nm)))


@pytest.mark.real_data
def test_emps_run_again_with_a_disturbance_lies_in_the_joint_interval(real_data):
    """Two recordings of one axis, the second pushed by pulses: they differ by less than both intervals allow."""
    found = []
    for name in ("DATA_EMPS.mat", "DATA_EMPS_PULSES.mat"):
        data = scipy.io.loadmat(real_data / "emps" / name)
        time, position, command, volts = (data[key].ravel() for key in ("t", "qm", "qg", "vir"))
        found.append(plateaus(time, position, data["gtau"].item() * volts, command_rad=command))
    one, two = found
    apart = np.abs(np.array(one.curve.torque_nm) - two.curve.magnitude(np.array(one.curve.velocity_rad_s)))
    assert np.all(apart <= np.hypot(one.half_width_nm, two.half_width_nm))


def test_nine_of_ten_intervals_hold_the_truth_where_friction_depends_on_place_and_time():
    """20 axes whose friction varies along the travel by 3 %, drifts by 2 % and is noisy."""
    inside, widths, errors = [], [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        v = np.gradient(trapezoids(speeds=(0.03, 0.06, 0.09) * 2)[1], 1e-3)
        time, q = np.arange(v.size) * 1e-3, np.cumsum(v) * 1e-3
        wave = 1 + 0.03 * np.sqrt(2) * np.sin(2 * np.pi * q / rng.uniform(0.01, 0.1) + rng.uniform(0, 6.3))
        drift = 1 + 0.02 * (time / time[-1] - 0.5)
        torque = 95 * np.gradient(v, 1e-3) + (20 * np.sign(v) + 100 * v) * wave * drift + rng.normal(0, 1, v.size)
        found = plateaus(time, q, torque)
        error = np.array(found.curve.torque_nm) - (20 + 100 * np.array(found.curve.velocity_rad_s))
        inside.extend(np.abs(error) <= found.half_width_nm)
        errors.extend(error)
        widths.extend(found.half_width_nm)
    assert np.mean(inside) >= 0.9
    assert np.sqrt(np.mean(np.square(widths))) <= 5 * np.sqrt(np.mean(np.square(errors)))
