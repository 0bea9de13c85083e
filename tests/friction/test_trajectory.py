import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from frictid_hil.friction import trajectory
from frictid_hil.friction.trajectory import Procedure

DEG = math.pi / 180


def procedure(amplitude_deg=20.0, velocity_deg_s=115.0, cycles=10):
    return Procedure(amplitude_deg * DEG, velocity_deg_s * DEG, cycles)


def test_amplitude_is_peak_to_peak_and_the_run_takes_sixteen_seconds():
    p = procedure()
    time = np.linspace(0, p.duration_s, 200_001)
    path = trajectory.position(p, time)
    assert path.min() == 0.0
    assert path.max() == pytest.approx(20 * DEG, rel=1e-8)
    assert p.duration_s == pytest.approx(16.003, abs=5e-4)


@pytest.mark.parametrize(("amplitude", "duration"), [(5, 4.0), (10, 8.0), (50, 40.0)])
def test_duration_is_proportional_to_the_travel(amplitude, duration):
    assert procedure(amplitude).duration_s == pytest.approx(duration, abs=0.05)


def test_each_cycle_reaches_its_own_peak_speed_both_ways():
    p = procedure()
    time = np.linspace(0, p.duration_s, 400_001)
    speed = trajectory.velocity(p, time)
    for n, peak in enumerate(p.peak_velocities_rad_s):
        inside = p.cycle_of(time) == n
        assert speed[inside].max() == pytest.approx(peak, rel=1e-6)
        assert speed[inside].min() == pytest.approx(-peak, rel=1e-6)


def test_cycles_are_half_open_and_the_outside_is_marked():
    p = procedure()
    starts = p.cycle_starts_s
    assert list(p.cycle_of(starts)) == [*range(10), 10]
    assert p.cycle_of(np.array([-1e-9]))[0] == -1
    assert p.cycle_of(np.nextafter(starts[1:], 0.0)).tolist() == list(range(10))


def test_velocity_is_continuous_at_the_joins_and_acceleration_jumps_as_predicted():
    p = procedure()
    eps = 1e-9
    for n, join in enumerate(p.cycle_starts_s[1:-1], start=1):
        before, after = trajectory.velocity(p, np.array([join - eps, join + eps]))
        assert abs(after - before) < 1e-6
        low, high = trajectory.acceleration(p, np.array([join - eps, join + eps]))
        jump = 2 * p.velocity_rad_s**2 * (2 * n + 1) / (p.amplitude_rad * p.cycles**2)
        assert high - low == pytest.approx(jump, rel=1e-5)


@given(
    amplitude=st.floats(1, 90),
    velocity=st.floats(1, 400),
    cycles=st.integers(2, 20),
    share=st.floats(0.01, 0.99),
)
def test_velocity_and_acceleration_are_the_derivatives(amplitude, velocity, cycles, share):
    p = procedure(amplitude, velocity, cycles)
    n = int(share * cycles)
    middle = p.cycle_starts_s[n] + (p.cycle_starts_s[n + 1] - p.cycle_starts_s[n]) * np.linspace(0.05, 0.95, 20)
    h = 1e-5 / p.angular_frequencies_rad_s[-1]
    numeric = (trajectory.position(p, middle + h) - trajectory.position(p, middle - h)) / (2 * h)
    assert np.allclose(numeric, trajectory.velocity(p, middle), atol=1e-4 * p.velocity_rad_s)
    numeric = (trajectory.velocity(p, middle + h) - trajectory.velocity(p, middle - h)) / (2 * h)
    assert np.allclose(numeric, trajectory.acceleration(p, middle), atol=1e-4 * trajectory.peak_acceleration(p))


def test_sample_times_cover_the_run_although_their_number_is_no_integer():
    p = procedure()
    time = trajectory.sample_times(p, 0.001)
    assert p.duration_s / 0.001 != int(p.duration_s / 0.001)
    assert p.duration_s - 0.001 <= time[-1] < p.duration_s


@pytest.mark.parametrize(
    "wrong",
    [
        {"amplitude_rad": 0.0, "velocity_rad_s": 1.0},
        {"amplitude_rad": math.nan, "velocity_rad_s": 1.0},
        {"amplitude_rad": 1.0, "velocity_rad_s": -1.0},
        {"amplitude_rad": 1.0, "velocity_rad_s": 1.0, "cycles": 1},
        {"amplitude_rad": 1.0, "velocity_rad_s": 1.0, "ratio": 1.0},
    ],
)
def test_a_procedure_that_cannot_work_is_refused(wrong):
    with pytest.raises(ValueError):
        Procedure(**wrong)


@pytest.mark.parametrize(
    ("shares", "cycles"), [((0.5, 1.0), 3), ((0.5, 0.4, 1.0), 3), ((0.5, 0.9), 2), ((0.0, 1.0), 2)]
)
def test_shares_that_make_no_programme_are_rejected(shares: tuple[float, ...], cycles: int) -> None:
    with pytest.raises(ValueError, match=r"speeds|rise to 1"):
        Procedure(20 * DEG, 115 * DEG, cycles, shares=shares)


def test_equal_shares_are_the_papers_procedure() -> None:
    paper, named = Procedure(0.3, 2.0, 4), Procedure(0.3, 2.0, 4, shares=(0.25, 0.5, 0.75, 1.0))
    time_s = np.linspace(-0.1, paper.duration_s + 0.1, 500)
    assert named.duration_s == pytest.approx(paper.duration_s)
    np.testing.assert_allclose(trajectory.position(named, time_s), trajectory.position(paper, time_s))


TICK_S = 0.004


def test_the_papers_cycles_on_a_4_ms_clock_are_the_published_tick_counts() -> None:
    rounded = trajectory.in_whole_ticks(procedure(), TICK_S)
    ticks = np.diff(rounded.cycle_starts_s) / TICK_S
    np.testing.assert_allclose(ticks, [1364, 684, 456, 340, 272, 228, 196, 172, 152, 136], atol=1e-9)
    change = rounded.peak_velocities_rad_s / procedure().peak_velocities_rad_s - 1
    assert 0.0070 < np.abs(change).max() <= 0.0074
    # The peaks fall on ticks: a sample there has the very speed that is recorded.
    quarter_s = rounded.cycle_starts_s[:-1] + np.diff(rounded.cycle_starts_s) / 4
    np.testing.assert_allclose(quarter_s / TICK_S, np.rint(quarter_s / TICK_S), atol=1e-6)
    np.testing.assert_allclose(trajectory.velocity(rounded, quarter_s), rounded.peak_velocities_rad_s)


@given(st.floats(4, 90), st.floats(20, 200), st.integers(2, 10), st.sampled_from([0.001, 0.004]))
def test_rounding_never_exceeds_the_joints_speed(amplitude: float, velocity: float, cycles: int, tick_s: float) -> None:
    asked = procedure(amplitude, velocity, cycles)
    try:
        rounded = trajectory.in_whole_ticks(asked, tick_s, asked.velocity_rad_s)
    except ValueError:
        return
    assert rounded.velocity_rad_s <= asked.velocity_rad_s * (1 + 1e-12)
    ticks = np.diff(rounded.cycle_starts_s) / tick_s
    np.testing.assert_allclose(ticks, np.rint(ticks), atol=1e-6)
    assert np.all(np.diff(ticks) < -0.5)


def test_cycles_too_short_to_be_told_apart_are_refused() -> None:
    with pytest.raises(ValueError, match="equally many ticks"):
        trajectory.in_whole_ticks(procedure(0.5), TICK_S)


def test_peak_acceleration_is_what_saturation_is_predicted_from():
    """2 V^2 / A at the reversals of the last cycle: halving the travel doubles the torque of inertia."""
    p = procedure()
    time = np.linspace(0, p.duration_s, 400_001)[:-1]
    assert np.abs(trajectory.acceleration(p, time)).max() == pytest.approx(trajectory.peak_acceleration(p), rel=1e-6)
    assert trajectory.peak_acceleration(procedure(10)) == pytest.approx(2 * trajectory.peak_acceleration(p))
