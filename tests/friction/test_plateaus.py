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
    pairs = plateaus(*trapezoids(noise=1.0))
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
    pairs = plateaus(time, position, force, command_rad=command if with_command else None)
    assert np.allclose(pairs.velocity_rad_s, [0.0421, 0.0826, 0.1247], atol=2e-4)
    curve = pairs.curve()
    slope, level = np.polyfit(curve.velocity_rad_s, curve.torque_nm, 1)
    assert level == pytest.approx(20.3935, rel=0.10)
    assert curve.coulomb_nm == pytest.approx(20.3935, rel=0.10)
    assert slope == pytest.approx(203.5034, rel=0.10)
    assert np.mean(pairs.torque_plus_nm + pairs.torque_minus_nm) / 2 == pytest.approx(-3.16, abs=0.5)
