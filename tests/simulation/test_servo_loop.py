from __future__ import annotations

import math

import numpy as np
import pytest
from sim_joints import COULOMB, GRAVITY, INERTIA, STIFFNESS, VISCOUS, bare

from frictid_hil.errors import UsageError
from frictid_hil.simulation.servo_loop import ServoLoop

NOISY = {"torque_noise_per_mille": 5, "torque_quantum_per_mille": 1, "velocity_filter_s": 0.001}
FREE = {"gravity_cos_nm": 0.0}


def released(model, **options) -> ServoLoop:
    loop = ServoLoop(model, **options)
    loop.brake(False)
    loop.power(True)
    return loop


def ride(loop: ServoLoop, seconds: float = 1.0) -> np.ndarray:
    rows = []
    for k in range(round(seconds * 1000)):
        loop.advance(0.001, position_rad=0.2 * (1 - math.cos(2 * math.pi * k / 1000)))
        rows.append((loop.position_counts, loop.velocity_rad_s, loop.torque_nm, loop.position_rad))
    return np.array(rows)


def test_the_same_seed_gives_the_same_readings_and_another_seed_other_noise_only() -> None:
    model = bare(drive=NOISY, encoder={"counts_per_revolution": 131072})
    first, again, other = (ride(released(model, seed=seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first[:, [0, 1, 3]], other[:, [0, 1, 3]])
    assert np.std(first[:, 2] - other[:, 2]) == pytest.approx(math.sqrt(2) * 0.005 * 20.0, rel=0.1)


def test_position_mode_tracks_and_reports_its_following_error() -> None:
    loop = released(bare())
    ride(loop, 1.25)
    target = 0.2 * (1 - math.cos(2 * math.pi * 1.249))
    assert loop.following_error_rad == pytest.approx(target - loop.measured_position_rad)
    assert abs(loop.following_error_rad) < 0.005


def test_targets_are_approached_linearly_over_a_longer_cycle() -> None:
    coarse, fine = released(bare()), released(bare())
    for k in range(1, 26):
        coarse.advance(0.004, position_rad=0.002 * k)
        for j in range(1, 5):
            fine.advance(0.001, position_rad=0.002 * (k - 1) + 0.0005 * j)
    assert coarse.position_rad == pytest.approx(fine.position_rad, abs=1e-9)
    assert coarse.torque_nm != 0.0


def test_velocity_mode_reaches_its_target() -> None:
    loop = released(bare(**FREE))
    loop.set_mode(9)
    loop.advance(1.0, velocity_rad_s=0.5)
    loop.advance(1.0, velocity_rad_s=0.5)
    assert loop.velocity_rad_s == pytest.approx(0.5, rel=1e-3)
    assert loop.torque_nm == pytest.approx(COULOMB + 0.5 * VISCOUS, rel=1e-2)


def test_torque_mode_applies_target_and_offset() -> None:
    loop = released(bare(**FREE))
    loop.set_mode(10)
    loop.advance(8.0, torque_nm=5.0, torque_offset_nm=1.0)
    assert loop.torque_nm == pytest.approx(6.0)
    assert loop.true_velocity_rad_s == pytest.approx((6.0 - COULOMB) / VISCOUS, rel=1e-2)


def test_changing_the_mode_continues_with_the_same_torque() -> None:
    loop = released(bare())
    ride(loop, 0.3)
    loop.set_mode(10)
    loop.advance(0.001, torque_nm=GRAVITY)
    before = loop.torque_nm
    loop.set_mode(8)
    loop.advance(0.001)
    assert loop.torque_nm == pytest.approx(before, abs=80 * 2 * abs(loop.velocity_rad_s) + 1.0)
    with pytest.raises(UsageError, match="no such mode: 3"):
        loop.set_mode(3)


def test_power_on_holds_the_joint_where_it_stands() -> None:
    loop = ServoLoop(bare(), position_rad=0.4)
    loop.advance(0.1)
    assert loop.torque_nm == 0.0 and loop.position_rad == 0.4
    loop.power(True)
    loop.brake(False)
    loop.advance(0.5)
    assert loop.position_rad == pytest.approx(0.4, abs=1e-6)
    assert loop.torque_nm == pytest.approx(GRAVITY * math.cos(0.4), rel=1e-3)


def test_without_power_an_open_brake_lets_the_link_fall_and_a_closed_one_stops_it() -> None:
    loop = released(bare(friction={"coulomb_nm": 0.5}))
    loop.power(False)
    loop.advance(0.2)
    assert loop.true_velocity_rad_s < -1.0
    loop.brake(True)
    loop.advance(0.001)
    fallen = loop.position_rad
    loop.advance(0.5)
    assert loop.position_rad == fallen and loop.true_velocity_rad_s == 0.0


def test_the_torque_limit_can_be_lowered_only() -> None:
    loop = released(bare(**FREE))
    loop.set_mode(10)
    loop.limits(torque_nm=3.0)
    loop.advance(0.01, torque_nm=50.0)
    assert loop.torque_nm == pytest.approx(3.0) and loop.saturated
    loop.limits(torque_nm=1e6)
    loop.advance(0.001, torque_nm=1e5)
    assert loop.torque_nm == pytest.approx(60.0)
    loop.advance(0.001, torque_nm=1.0)
    assert not loop.saturated


def test_a_hand_moves_the_link_and_is_felt() -> None:
    model = bare(**FREE)
    loop = released(model)
    loop.set_mode(10)
    loop.hold_hand(model.hand, centre_rad=0.0, amplitude_rad=0.35, frequency_hz=0.5)
    rows = []
    for _ in range(4000):
        loop.advance(0.001)
        rows.append((loop.position_rad, loop.external_torque_nm, loop.true_velocity_rad_s))
    q, torque, v = np.array(rows)[2000:].T
    assert 0.25 < np.ptp(q) / 2 < 0.4
    friction = COULOMB * np.sign(v) + VISCOUS * v
    balance = torque - friction - INERTIA * np.gradient(v, 1e-3)
    moving = np.abs(v) > 0.2
    assert np.abs(balance[moving]).mean() < 0.1
    loop.hold_hand(None)
    loop.advance(0.001)
    assert loop.external_torque_nm == 0.0


def test_a_payload_adds_gravity() -> None:
    loop = released(bare())
    loop.mount_payload(True)
    loop.advance(2.0)
    loop.advance(1.0)
    assert loop.torque_nm == pytest.approx(GRAVITY + 3.0, abs=0.1 * COULOMB)
    loop.mount_payload(False)
    loop.advance(2.0)
    loop.advance(1.0)
    assert loop.torque_nm == pytest.approx(GRAVITY, abs=0.1 * COULOMB)


def test_counts_are_those_of_the_motor_encoder() -> None:
    loop = released(bare(encoder={"side": "motor", "counts_per_revolution": 131072}))
    ride(loop, 0.3)
    assert loop.position_counts == pytest.approx(loop.position_rad * 100 / (2 * math.pi) * 131072, abs=0.51)
    assert loop.measured_position_rad == pytest.approx(loop.position_counts * 2 * math.pi / 131072 / 100)


def test_a_joint_held_still_stays_within_its_presliding_range() -> None:
    loop = released(bare(drive=NOISY, encoder={"counts_per_revolution": 131072}))
    ride(loop, 0.3)
    still = []
    for _ in range(2000):
        loop.advance(0.001)
        still.append(loop.position_rad)
    assert np.ptp(still[1000:]) < 0.05 * COULOMB / STIFFNESS


def test_time_stands_still_for_a_zero_duration_and_a_bad_period_is_refused() -> None:
    loop = released(bare())
    ride(loop, 0.1)
    before = loop.position_rad
    loop.advance(0.0, position_rad=5.0)
    assert loop.position_rad == before
    for period in (0.0, -1.0, math.nan):
        with pytest.raises(UsageError, match="control period"):
            loop.period_s = period
