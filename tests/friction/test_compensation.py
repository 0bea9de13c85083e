"""The compensation against the closed forms (18) to (24), and its limits."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from frictid_hil.errors import UsageError
from frictid_hil.friction.compensation import (
    Compensation,
    CompensationSettings,
    least_squares_viscosity,
    stiffness_with_margin,
)
from frictid_hil.friction.curve import FrictionCurve

CURVE = FrictionCurve((0.2, 0.8, 2.0), (5.5, 6.4, 7.6))
K, R, DT = 8000.0, 0.9, 1e-3


def settings(form: str = "mop", **changes: float | bool) -> CompensationSettings:
    values = {"stiffness_nm_per_rad": K, "ratio": R} | changes
    return CompensationSettings.of(CURVE, form, **values)  # type: ignore[arg-type]


@given(st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=50))
def test_the_spring_solves_the_inclusion_of_equation_18(velocities: list[float]) -> None:
    compensation = Compensation(settings("mo"), DT)
    f0, before = CURVE.coulomb_nm, 0.0
    for velocity in velocities:
        spring = compensation.step(velocity * DT, velocity) / R / K
        slip = velocity - (spring - before) / DT
        # (18): K e is F_0 sgn(slip), and anything in [-F_0, F_0] where nothing slips.
        if abs(slip) > 1e-9:
            assert K * spring == pytest.approx(f0 * np.sign(slip), rel=1e-12)
        assert abs(K * spring) <= f0 * (1 + 1e-12)
        before = spring


@given(st.floats(-3.0, 3.0))
def test_sliding_gives_back_the_share_r_of_the_curve(velocity: float) -> None:
    compensation = Compensation(settings(), DT)
    direction = 1.0 if velocity >= 0 else -1.0
    compensation.step(direction, velocity)  # far beyond presliding
    expected = R * direction * float(CURVE.magnitude(np.array(abs(velocity))))
    assert compensation.step(0.0, velocity) == pytest.approx(expected, rel=1e-12)


@given(st.floats(0.0, 3.0))
def test_the_rivals_are_equations_26_and_27(speed: float) -> None:
    slope = least_squares_viscosity(CURVE)
    for form, rate in (("mo", 0.0), ("mol", slope * speed)):
        compensation = Compensation(settings(form), DT)
        assert compensation.step(1.0, speed) == pytest.approx(R * (CURVE.coulomb_nm + rate), rel=1e-12)


def test_least_squares_viscosity_is_the_best_line_through_rest() -> None:
    speeds = np.linspace(0.0, 2.0, 400)
    rate = CURVE.magnitude(speeds) - CURVE.coulomb_nm

    def error(slope: float) -> float:
        return float(np.sum((rate - slope * speeds) ** 2))

    best = least_squares_viscosity(CURVE)
    assert error(best) < min(error(0.98 * best), error(1.02 * best))


def test_directions_may_differ() -> None:
    uneven = CompensationSettings.of(CURVE, "mop", stiffness_nm_per_rad=K, ratio=R, asymmetry_nm=(0.1, 0.2, 0.3))
    compensation = Compensation(uneven, DT)
    forward, backward = compensation.step(1.0, 0.8), compensation.step(-2.0, -0.8)
    assert forward == pytest.approx(R * (6.4 + 0.2))
    assert backward == pytest.approx(-R * (6.4 - 0.2))


def test_a_reference_velocity_decides_before_the_joint_moves() -> None:
    compensation = Compensation(settings(), DT)
    for _ in range(10):
        torque = compensation.step(0.0, 0.0, 0.8)
    assert torque == pytest.approx(R * 6.4)


def gradually(ratio: float = R) -> Compensation:
    return Compensation(CompensationSettings.of(CURVE, "mo", stiffness_nm_per_rad=K, ratio=ratio, gradual=True), DT)


@given(st.lists(st.floats(-0.01, 0.01), min_size=1, max_size=30))
def test_a_spring_that_yields_gradually_depends_on_the_path_alone(increments: list[float]) -> None:
    f0 = CURVE.coulomb_nm
    whole, parts = gradually(), gradually()
    for increment in increments:
        torque = whole.step(increment, 0.0)
        for _ in range(4):
            in_parts = parts.step(increment / 4, 0.0)
        assert torque == pytest.approx(in_parts, abs=1e-9)
        assert abs(torque) <= R * f0 * (1 + 1e-12)


def test_a_spring_that_yields_gradually_is_k_stiff_at_rest_and_twice_that_where_the_motion_turns() -> None:
    spring, small = gradually(), 1e-9
    assert spring.step(small, 0.0) / small == pytest.approx(R * K, rel=1e-5)
    sliding = spring.step(1.0, 0.0)
    assert sliding == pytest.approx(R * CURVE.coulomb_nm)
    assert (sliding - spring.step(-small, 0.0)) / small == pytest.approx(2 * R * K, rel=1e-4)


VELOCITIES = [1.5 * math.sin(0.003 * k) for k in range(20_000)]


@pytest.mark.parametrize("gradual", [False, True])
def test_steps_leave_nothing_behind(gradual: bool) -> None:
    step = Compensation(settings(gradual=gradual), DT).step
    for velocity in VELOCITIES:
        step(DT * velocity, velocity)
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        for velocity in VELOCITIES:
            step(DT * velocity, velocity)
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after - before < 200  # bytes; one float per step would be 480 000


def test_two_compensations_share_no_state() -> None:
    one, other = Compensation(settings(), DT), Compensation(settings(), DT)
    one.step(1.0, 0.5)
    assert other.step(0.0, 0.0) == 0.0


@pytest.mark.parametrize("ratio", [0.0, 1.0, 1.1, -0.5, float("nan")])
def test_a_ratio_that_lets_a_free_joint_run_away_is_refused(ratio: float) -> None:
    with pytest.raises(UsageError, match="between 0 and 1"):
        settings(ratio=ratio).refuse_unstable(None)


def test_a_spring_stiffer_than_presliding_is_refused() -> None:
    settings().refuse_unstable(1.01 * R * K)
    with pytest.raises(UsageError, match="presliding") as refusal:
        settings().refuse_unstable(0.99 * R * K)
    assert "hunt" in refusal.value.cause


@given(st.floats(1e3, 3e4), st.floats(0.5, 20.0), st.floats(0.5, 1.5), st.floats(0.5, 0.97))
def test_our_stiffness_holds_with_both_margins_on_a_joint_that_slides(
    presliding: float, coulomb: float, static_share: float, ratio: float
) -> None:
    stiffness = stiffness_with_margin(presliding, static_share * coulomb, coulomb, ratio)
    sliding = presliding * min(1.0, 1.0 / static_share)
    assert (ratio + 0.02) * 1.1 * stiffness == pytest.approx(sliding)
    settings(stiffness_nm_per_rad=stiffness, ratio=ratio).refuse_unstable(presliding)


def test_an_unknown_form_is_refused() -> None:
    with pytest.raises(UsageError, match="mo, mol, mop"):
        settings("lugre")
