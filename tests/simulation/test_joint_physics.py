"""The plant against closed forms and against an integration written differently."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from sim_joints import CONTROLLER, COULOMB, GRAVITY, INERTIA, STIFFNESS, VISCOUS, bare, excitation, simulate

from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.joint import HandImpedance
from frictid_hil.simulation.replay import Controller, closed_loop, open_loop
from frictid_hil.simulation.servo_loop import ServoLoop
from frictid_hil.simulation.steady import steady_friction_nm, true_curve_nm

LEVEL = {"gravity_cos_nm": 0.0}


def drive(model, torque, duration, step=1e-3, start=0.0, **options):
    time = np.arange(round(duration / step) + 1) * step
    return time, open_loop(model, time, np.vectorize(torque)(time - step / 2), start_rad=start, **options)


def test_constant_torque_ends_at_the_speed_where_friction_balances_it() -> None:
    model = bare(**LEVEL)
    _, rows = drive(model, lambda t: 7.0, 6.0)
    assert rows.velocity_rad_s[-1] == pytest.approx((7.0 - COULOMB) / VISCOUS, rel=1e-4)


def test_acceleration_without_friction_is_torque_over_inertia_exactly() -> None:
    model = bare(friction={"coulomb_nm": 0.0}, **LEVEL)
    time, rows = drive(model, lambda t: 2.0, 1.0)
    np.testing.assert_allclose(rows.position_rad, 2.0 / INERTIA * time**2 / 2, rtol=1e-9, atol=1e-12)


def test_torque_below_the_coulomb_level_only_winds_the_presliding_spring() -> None:
    model = bare(**LEVEL)
    _, rows = drive(model, lambda t: min(2.0, 20 * t), 2.0)
    # The spring itself has no damping: it swings a little around its rest.
    assert rows.position_rad[-500:].mean() == pytest.approx(2.0 / STIFFNESS, rel=0.02)
    assert rows.position_rad.max() < 1.2 * 2.0 / STIFFNESS


def test_presliding_loops_close_and_lose_no_energy_below_break_away() -> None:
    model = bare(**LEVEL)
    _, rows = drive(model, lambda t: 3.0 * math.sin(2 * math.pi * t), 4.0)
    work = np.trapezoid(rows.torque_nm[2000:3001], rows.position_rad[2000:3001])
    assert abs(work) < 1e-5 and np.abs(rows.position_rad).max() < 1.1 * 3.0 / STIFFNESS


def test_a_full_sliding_cycle_loses_coulomb_and_viscous_work() -> None:
    model = bare(**LEVEL)
    time = np.arange(5000) / 1000
    command = 0.2 * np.sin(2 * np.pi * time)
    rows = closed_loop(model, Controller(5e3, 1e4, 80.0, 1000.0), time, command)
    q, tau = rows.position_rad[3000:4001], (rows.torque_nm[3000:4001] + rows.torque_nm[3001:4002]) / 2
    amplitude = np.ptp(q) / 2
    lost = 4 * amplitude * COULOMB - 2 * COULOMB**2 / STIFFNESS * 2 + VISCOUS * np.pi * 2 * np.pi * amplitude**2
    assert np.trapezoid(tau, q) == pytest.approx(lost, rel=5e-3)


def test_a_swinging_link_without_friction_keeps_its_energy() -> None:
    model = bare(friction={"coulomb_nm": 0.0})
    time, rows = drive(model, lambda t: 0.0, 10.0, start=-1.0)
    energy = INERTIA / 2 * np.gradient(rows.position_rad, time) ** 2 + GRAVITY * np.sin(rows.position_rad)
    assert np.ptp(energy[5:-5]) < 2e-3 * GRAVITY


def reference(torque, start, end, *, compliance=0.0, relaxation=0.0, motor_share=0.3):
    """The same joint by scipy's Runge-Kutta on (q, v, spring torque[, link q, link v])."""

    def rate(t, x):
        motor_q, motor_v, spring = x[:3]
        slipping = abs(spring) >= COULOMB and spring * motor_v > 0
        friction = float(np.clip(spring, -COULOMB, COULOMB)) + VISCOUS * motor_v
        if compliance == 0.0:
            acceleration = (torque(t) - GRAVITY * math.cos(motor_q) - friction) / INERTIA
            return [motor_v, acceleration, 0.0 if slipping else STIFFNESS * motor_v]
        link_q, link_v = x[3:]
        transmitted = (motor_q - link_q) / compliance + relaxation / compliance * (motor_v - link_v)
        acceleration = (torque(t) - transmitted - friction) / (motor_share * INERTIA)
        link = (transmitted - GRAVITY * math.cos(link_q)) / ((1 - motor_share) * INERTIA)
        return [motor_v, acceleration, 0.0 if slipping else STIFFNESS * motor_v, link_v, link]

    first = (
        [start, 0.0, 0.0]
        if compliance == 0.0
        else [start, 0.0, 0.0, start - compliance * GRAVITY * math.cos(start), 0.0]
    )
    times = np.linspace(0.0, end, 201)
    return times, solve_ivp(rate, (0.0, end), first, t_eval=times, rtol=1e-8, atol=1e-10, max_step=2e-4).y


@pytest.mark.slow
@pytest.mark.parametrize("compliance", [0.0, 2e-4])
def test_motion_agrees_with_a_runge_kutta_integration(compliance: float) -> None:
    def torque(t: float) -> float:
        return GRAVITY + 8.0 * math.sin(2 * math.pi * 1.5 * t)

    end = 1.5
    effects = {"joint_elasticity": {"compliance_rad_per_nm": compliance, "relaxation_s": 4e-4}} if compliance else {}
    times, expected = reference(torque, 0.1, end, compliance=compliance, relaxation=4e-4)
    time, rows = drive(bare(effects=effects), torque, end, step=2e-4, start=0.1)
    got = np.interp(times, time, rows.position_rad)
    travel = np.ptp(expected[0])
    assert travel > 0.1
    assert np.abs(got - expected[0]).max() < 2e-3 * travel


def test_halving_the_sub_step_changes_little(monkeypatch: pytest.MonkeyPatch) -> None:
    coarse = simulate(bare())
    monkeypatch.setattr("frictid_hil.simulation.replay.SUBSTEP_S", 2e-5)
    fine = simulate(bare())
    assert np.sqrt(np.mean((coarse.torque_nm - fine.torque_nm) ** 2)) < 0.01
    assert np.abs(coarse.position_rad - fine.position_rad).max() < 2e-5


@pytest.mark.parametrize("stiffness", [1e3, 5e4, 1e7, 1e9])
def test_any_presliding_stiffness_is_stable(stiffness: float) -> None:
    rows = simulate(bare(inertia_kg_m2=0.05, presliding_stiffness_nm_per_rad=stiffness))
    assert np.abs(rows.torque_nm).max() < 60.0 and np.abs(np.diff(rows.position_rad)).max() < 0.01


# -- every effect against its own formula -----------------------------------------------------------------------------


def test_stribeck_raises_slow_sliding_by_its_share() -> None:
    model = bare(effects={"stribeck": {"share": 0.2, "stribeck_velocity_rad_s": 0.05, "exponent": 2.0}})
    v = np.array([0.0001, 0.05, 0.5])
    raised = (steady_friction_nm(model, v) - steady_friction_nm(bare(), v)) / COULOMB
    np.testing.assert_allclose(raised, [0.2, 0.2 / math.e, 0.0], atol=1e-5)


@pytest.mark.parametrize("share", [0.5, -0.1])
def test_a_bend_of_one_is_plain_viscosity(share: float) -> None:
    model = bare(effects={"viscous_nonlinearity": {"share": share, "knee_rad_s": 0.4, "bend": 1.0}})
    v = np.linspace(-2, 2, 9)
    added = steady_friction_nm(model, v) - steady_friction_nm(bare(), v)
    np.testing.assert_allclose(added, share * COULOMB / 0.4 * v, atol=1e-12)
    logarithm = bare(effects={"viscous_nonlinearity": {"share": 0.5, "knee_rad_s": 0.4, "bend": 0.0}})
    nearly = bare(effects={"viscous_nonlinearity": {"share": 0.5, "knee_rad_s": 0.4, "bend": 1e-5}})
    np.testing.assert_allclose(steady_friction_nm(logarithm, v), steady_friction_nm(nearly, v), rtol=1e-3)


def test_bends_are_tried_at_the_speeds_that_a_joint_comes_to() -> None:
    """A motor is no slow joint; and what is over before a joint is out of its reversals is a level, not a bend."""
    form = all_effects()["viscous_nonlinearity"].inverse
    assert form is not None

    def tried(top: float) -> list[dict[str, float]]:
        speed = top * np.sin(np.linspace(0.0, 20.0, 2000))
        view: Any = SimpleNamespace(velocity_rad_s=speed, rate_nm=0.1 * speed)
        return [dict(shape) for shape in form.grid_for([view])]

    for slow, fast in zip(tried(1.0), tried(60.0), strict=True):
        assert fast == pytest.approx({**slow, "knee_rad_s": 60.0 * slow["knee_rad_s"]})
        effect = {"viscous_nonlinearity": {"share": 1.0, **slow}}
        added = steady_friction_nm(bare(effects=effect), np.array([0.1, 1.0])) - steady_friction_nm(
            bare(), np.array([0.1, 1.0])
        )
        assert slow["bend"] >= 0.0 or added[0] < 0.5 * added[1]


def test_asymmetry_is_even_and_leaves_the_odd_curve_alone() -> None:
    model = bare(effects={"direction_asymmetry": {"coulomb_share": 0.1, "viscous_share": 0.2}})
    v = np.array([0.2, 1.0])
    forward, backward = steady_friction_nm(model, v), steady_friction_nm(model, -v)
    np.testing.assert_allclose((forward + backward) / 2, 0.1 * COULOMB + 0.2 * VISCOUS * v)
    np.testing.assert_allclose(true_curve_nm(model, v), true_curve_nm(bare(), v))


def test_asymmetry_with_an_onset_is_there_in_motion_only() -> None:
    """A joint that is pushed across its level: the even part holds it at rest, or is gone there."""
    rest, speed = [], []
    for onset in (0.0, 0.02):
        asymmetry = {"coulomb_share": 0.2, "onset_rad_s": onset}
        model = bare(effects={"direction_asymmetry": asymmetry}, friction={"coulomb_nm": COULOMB}, **LEVEL)
        _, rows = drive(model, lambda t: 0.95 * COULOMB * min(t, 1.0), 3.0)
        rest.append(rows.position_rad[-500:].mean())
        v = np.array([0.5, -0.5])
        speed.append(steady_friction_nm(model, v))
    # Wound up to a slip of s, the spring and the part that stays make 0.95 = s + 0.2 s; without it s is 0.95.
    np.testing.assert_allclose(rest, [0.95 / 1.2 * COULOMB / STIFFNESS, 0.95 * COULOMB / STIFFNESS], rtol=0.03)
    np.testing.assert_allclose(speed, [[1.2 * COULOMB, -0.8 * COULOMB]] * 2)


def test_onsets_that_are_tried_are_ones_that_a_file_may_say() -> None:
    effect = all_effects()["direction_asymmetry"]
    assert effect.inverse is not None
    onset = next(p for p in effect.parameters if p.name == "onset_rad_s")
    for top_rad_s in (0.0, 1.0, 500.0):  # at rest, a joint, a motor on a stand
        views: list[Any] = [SimpleNamespace(velocity_rad_s=np.array([0.0, -top_rad_s]))]
        shapes = effect.inverse.grid_for(views)
        tried = [shape["onset_rad_s"] for shape in shapes]
        assert tried[0] == 0.0 and tried == sorted(set(tried)) and tried[-1] <= onset.upper


def test_load_raises_friction_where_gravity_is_large() -> None:
    model = bare(effects={"load_dependent_friction": {"linear_share": 0.2, "quadratic_per_nm": 0.01}})
    v = np.array([0.5])
    added = steady_friction_nm(model, v, position_rad=0.0) - steady_friction_nm(model, v, position_rad=math.pi / 2)
    assert added[0] == pytest.approx(0.2 * GRAVITY + 0.01 * GRAVITY**2)


def test_a_law_without_an_integral_sags_by_what_it_has_to_hold() -> None:
    model, time = bare(), np.arange(1000) / 500
    rows = closed_loop(model, Controller(5e3, 0.0, 80.0, 1000.0), time, np.zeros_like(time))
    sag_rad = -GRAVITY / 5e3
    assert rows.position_rad == pytest.approx(np.full(time.size, sag_rad), rel=1e-3)
    assert rows.torque_nm == pytest.approx(np.full(time.size, -5e3 * sag_rad), rel=1e-3)


def test_a_velocity_of_the_moment_is_half_a_tick_younger_than_a_difference() -> None:
    time = np.arange(2000) / 500
    command = 0.2 * (1 - np.cos(3 * time))
    gains = (5e3, 1e4, 80.0, 500.0)
    old, now = (closed_loop(bare(), Controller(*gains, velocity=velocity), time, command) for velocity in (None, "now"))
    half_s = 0.5 / 500
    # The loop that sees an old velocity runs ahead by what its gain makes of that: the acceleration, half a tick long.
    ahead = 80.0 / 5e3 * half_s * np.gradient(old.velocity_rad_s, 1 / 500)
    moving = slice(500, 1900)
    assert np.corrcoef((old.position_rad - now.position_rad)[moving], ahead[moving])[0, 1] > 0.8


def test_ripple_is_a_line_at_its_own_order() -> None:
    ripple = {"amplitude_nm": 0.8, "cycles_per_motor_revolution": 2.0, "phase_rad": 0.3}
    model = bare(effects={"torque_ripple": ripple}, **LEVEL)
    time = np.arange(4000) / 500
    rows = closed_loop(model, Controller(5e3, 1e4, 80.0, 1000.0), time, 0.05 * time)
    q, tau = rows.position_rad[1500:], rows.torque_nm[1500:]
    columns = [np.cos(2 * 100 * q), np.sin(2 * 100 * q), np.ones_like(q)]
    cos, sin, _ = np.linalg.lstsq(np.column_stack(columns), tau, rcond=None)[0]
    assert math.hypot(cos, sin) == pytest.approx(0.8, rel=0.05) and math.atan2(-sin, cos) == pytest.approx(0.3, abs=0.1)


def test_hysteresis_delays_the_build_up_of_friction_after_a_reversal() -> None:
    slow = {"share": 0.5, "distance_rad": 0.02, "loop_exponent": 1.0, "loop_beta": 1.0}
    model = bare(effects={"presliding_hysteresis": slow}, **LEVEL)
    time = np.arange(4000) / 500
    command = np.interp(time, [0, 4, 8], [0, 0.2, 0])
    rows = closed_loop(model, CONTROLLER, time, command)
    travelled = rows.position_rad.max() - rows.position_rad
    after = (time > 4.1) & (travelled > 0.004)
    # Dahl: -1 + 2 exp(-x / distance) of the slow half, full reversal of the stiff half.
    expected = COULOMB * (0.5 * (2 * np.exp(-travelled / 0.02) - 1) - 0.5) - VISCOUS * 0.05
    assert np.abs(rows.torque_nm - expected)[after].max() < 0.1


def test_break_away_grows_with_the_dwell() -> None:
    sticky = {"share": 0.5, "dwell_time_s": 0.5, "travel_rad": 2e-3}
    model = bare(effects={"stiction_breakaway": sticky}, **LEVEL)
    time = np.arange(5000) / 500
    dwell_short, dwell_long = 0.2, 3.0
    corners = np.cumsum([0, 1, dwell_short, 1, dwell_long, 1])
    command = np.interp(time, corners, [0, 0.1, 0.1, 0.2, 0.2, 0.3])
    sticking = closed_loop(model, CONTROLLER, time, command).torque_nm
    sliding = closed_loop(bare(**LEVEL), CONTROLLER, time, command).torque_nm

    def rise(after: float) -> float:
        start = (time > after) & (time < after + 0.3)
        return sticking[start].max() - sliding[start].max()

    short, long = rise(corners[2]), rise(corners[4])
    assert long > 1.5 * short > 0
    # The first milliradians already wipe out a part before the peak is reached.
    assert 0.5 < long / (0.5 * COULOMB) <= 1.0


def test_backlash_leaves_the_motor_alone_within_the_gap() -> None:
    model = bare(effects={"backlash": {"gap_rad": 0.01}}, gravity_cos_nm=5.0)
    settled = simulate(model)
    assert settled.position_rad[0] == pytest.approx(0.2, abs=1e-6)
    time = np.arange(1000) / 500
    # Gravity keeps the flanks together; turning gravity over needs the whole gap.
    flat = closed_loop(
        bare(effects={"backlash": {"gap_rad": 0.01}}, **LEVEL), CONTROLLER, time, 0.004 * np.sin(2 * np.pi * time)
    )
    motor_only = INERTIA * 0.3 * 0.004 * (2 * np.pi) ** 2 + VISCOUS * 0.004 * 2 * np.pi + COULOMB
    assert np.abs(flat.torque_nm).max() < 1.05 * motor_only


def test_elasticity_resonates_where_its_stiffness_says() -> None:
    compliance = 1 / (0.7 * INERTIA * (2 * math.pi * 28.0) ** 2)
    effects = {"joint_elasticity": {"compliance_rad_per_nm": compliance, "relaxation_s": 1e-4}}
    model = bare(
        encoder={"side": "link", "counts_per_revolution": 0},
        effects=effects,
        friction={"coulomb_nm": 50.0},
        presliding_stiffness_nm_per_rad=1e9,
        **LEVEL,
    )
    # The motor is stuck: a knock by hand sets the link swinging alone.
    loop = ServoLoop(model, period_s=0.001)
    loop.brake(False)
    loop.hold_hand(HandImpedance(1000.0, 0.0), centre_rad=0.01)
    loop.advance(0.005)
    loop.hold_hand(None)
    swing = []
    for _ in range(1000):
        loop.advance(0.001)
        swing.append(loop.position_rad)
    spectrum = np.abs(np.fft.rfft(np.array(swing) - np.mean(swing)))
    assert np.argmax(spectrum) == pytest.approx(28.0, abs=1.0)


@pytest.mark.parametrize("delay_s", [0.002, 0.0033])
def test_delay_moves_the_torque_by_itself(delay_s: float) -> None:
    time, command = excitation(1000.0)
    controller = Controller(500.0, 2000.0, 25.0, rate_hz=1000.0, velocity_filter_s=0.003)
    model = bare(effects={"torque_delay": {"delay_s": delay_s}})
    rows = closed_loop(model, controller, time, command)
    demand = _demand(controller, time, command, rows)
    whole, part = divmod(delay_s * 1000.0, 1.0)
    whole = int(whole)
    expected = (1 - part) * np.roll(demand, whole) + part * np.roll(demand, whole + 1)
    np.testing.assert_allclose(rows.torque_nm[50:], expected[50:], atol=1e-6)


def _demand(controller, time, command, rows):
    """The demand that acts before each row, recomputed from the rows."""
    period = 1 / controller.rate_hz
    slope = np.gradient(np.concatenate([command[:1], command, command[-1:]]), period)[1:-1]
    share = 1 - math.exp(-period / controller.velocity_filter_s)
    integral, filtered, demand = rows.torque_nm[0], 0.0, np.full(time.size, rows.torque_nm[0])
    for k in range(time.size - 1):
        velocity = (rows.position_rad[k] - rows.position_rad[k - 1]) / period if k else 0.0
        filtered += share * (velocity - filtered)
        error = command[k] - rows.position_rad[k]
        demand[k + 1] = controller.kp_nm_per_rad * error + integral + controller.kd_nm_s_per_rad * (slope[k] - filtered)
        integral += controller.ki_nm_per_rad_s * error * period
    return demand


def test_current_follows_its_demand_as_a_first_order_lag() -> None:
    time, command = excitation()
    model = bare(effects={"electrical_lag": {"time_constant_s": 0.004}})
    rows = closed_loop(model, CONTROLLER, time, command)
    demand = _demand(CONTROLLER, time, command, rows)
    decay = math.exp(-0.002 / 0.004)
    current, mean = rows.torque_nm[0], np.empty(time.size)
    for k, target in enumerate(demand):
        mean[k] = target + (current - target) * 0.004 / 0.002 * (1 - decay)
        current = target + (current - target) * decay
    np.testing.assert_allclose(rows.torque_nm[1:], mean[1:], atol=1e-6)


def test_torque_constant_bias_and_gravity_scale_the_holding_torque() -> None:
    def held(**effects: object) -> float:
        return float(simulate(bare(effects=effects)).torque_nm[0])

    gravity = GRAVITY * math.cos(0.2)
    assert held() == pytest.approx(gravity)
    assert held(torque_constant_error={"error_share": 0.25}) == pytest.approx(gravity / 1.25)
    assert held(torque_bias={"bias_nm": 0.7}) == pytest.approx(gravity + 0.7)
    assert held(gravity_error={"error_share": -0.1}) == pytest.approx(0.9 * gravity)
    assert held(encoder_offset={"offset_rad": 0.3}) == pytest.approx(GRAVITY * math.cos(-0.1))


def test_inertia_error_is_the_links_alone() -> None:
    model = bare(friction={"coulomb_nm": 0.0}, effects={"inertia_error": {"error_share": 0.5}}, **LEVEL)
    _, rows = drive(model, lambda t: 2.0, 0.5)
    assert rows.position_rad[-1] == pytest.approx(2.0 / (INERTIA * (0.3 + 0.7 * 1.5)) * 0.125, rel=1e-9)


def test_saturation_clips_what_is_applied() -> None:
    rows = simulate(bare(effects={"torque_saturation": {"limit_share": 0.2}}))
    assert np.abs(rows.torque_nm).max() == pytest.approx(12.0)


def test_velocity_lag_is_seen_in_the_report_only() -> None:
    lagged, plain = simulate(bare(effects={"velocity_lag": {"time_constant_s": 0.01}})), simulate(bare())
    np.testing.assert_array_equal(lagged.position_rad, plain.position_rad)
    share = 1 - math.exp(-0.002 / 0.01)
    expected = np.zeros(plain.velocity_rad_s.size)
    for k in range(1, expected.size):
        expected[k] = expected[k - 1] + share * (plain.velocity_rad_s[k] - expected[k - 1])
    np.testing.assert_allclose(lagged.velocity_rad_s, expected, atol=1e-9)


def test_a_controller_may_act_on_the_late_velocity() -> None:
    """The same loop whose velocity is late by its own filter, or by the effect in front of none."""
    own = replace(CONTROLLER, velocity_filter_s=0.0)
    late = simulate(bare(effects={"velocity_lag": {"time_constant_s": 0.008, "loop_share": 1.0}}), controller=own)
    filtered = simulate(bare(), controller=replace(own, velocity_filter_s=0.008))
    plain = simulate(bare(), controller=own)
    np.testing.assert_allclose(late.torque_nm, filtered.torque_nm, atol=1e-9)
    assert np.max(np.abs(filtered.torque_nm - plain.torque_nm)) > 0.1
    half = simulate(bare(effects={"velocity_lag": {"time_constant_s": 0.008, "loop_share": 0.5}}), controller=own)
    between = np.max(np.abs(half.torque_nm - plain.torque_nm)) / np.max(np.abs(filtered.torque_nm - plain.torque_nm))
    assert 0.3 < between < 0.8


def test_positions_come_in_the_coarser_steps() -> None:
    rows = simulate(bare(effects={"encoder_quantisation": {"step_rad": 2e-4}}))
    np.testing.assert_allclose(rows.position_rad / 2e-4, np.round(rows.position_rad / 2e-4), atol=1e-6)


def test_warmth_lowers_friction_and_carries_over_to_the_next_recording() -> None:
    warm = {"coulomb_share": 0.3, "viscous_share": 0.3, "time_constant_s": 10.0, "power_w": 2.0}
    model = bare(effects={"temperature_drift": warm})
    time, command = excitation()
    first = closed_loop(model, CONTROLLER, time, command)
    heat = first.state["temperature_drift"][0]
    assert 0.1 < heat < 3.0
    second = closed_loop(model, CONTROLLER, time, command, state=first.state)
    cold = closed_loop(model, CONTROLLER, time, command)
    np.testing.assert_array_equal(cold.torque_nm, first.torque_nm)
    early = (time > 0.3) & (time < 0.9)
    drop = first.torque_nm[early].mean() - second.torque_nm[early].mean()
    assert drop == pytest.approx(0.3 * heat * (COULOMB + VISCOUS * 0.6), rel=0.25)
    assert true_curve_nm(model, np.array([1.0]))[0] == pytest.approx(COULOMB + VISCOUS)
