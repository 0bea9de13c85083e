import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frictid_hil.errors import IdentificationError
from frictid_hil.friction import trajectory
from frictid_hil.friction.identify import function_a
from frictid_hil.friction.trajectory import Array, Procedure

P = Procedure(np.radians(20), np.radians(115))


def friction(v):
    return np.sign(v) * (12.0 + 4.0 * np.abs(v))


def perfect(procedure=P, *, step=1e-3, inertia=0.0, gravity=0.0, late=0.0) -> tuple[Array, Array, Array]:
    """A joint that tracks exactly; ``late`` seconds of torque delay."""
    time = trajectory.sample_times(procedure, step)
    v = trajectory.velocity(procedure, time)
    then = time - late
    torque = friction(trajectory.velocity(procedure, then)) + inertia * trajectory.acceleration(procedure, then)
    return time, v, torque + gravity * np.cos(0.3 + trajectory.position(procedure, then))


def by_the_book(time, velocity, torque, p):
    """(7) read aloud."""
    rows = []
    for n in range(1, p.cycles + 1):
        here = (time >= p.cycle_starts_s[n - 1]) & (time < p.cycle_starts_s[n])
        threshold = p.ratio * (n * p.velocity_rad_s / p.cycles)
        plus, minus = here & (velocity >= threshold), here & (velocity <= -threshold)
        f_plus, f_minus = torque[plus].mean(), torque[minus].mean()
        rows.append((velocity[plus].mean(), (f_plus - f_minus) / 2, -velocity[minus].mean(), f_plus, f_minus,
                     plus.sum(), minus.sum()))  # fmt: skip
    return [np.array(column) for column in zip(*rows, strict=True)]


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 10_000),
    ratio=st.sampled_from([0.0, 0.5, 0.8, 0.95]),
    cycles=st.integers(2, 12),
    jitter=st.floats(0, 0.4),
    lead=st.integers(0, 500),
)
def test_is_algorithm_7_on_any_samples(seed, ratio, cycles, jitter, lead):
    p = Procedure(0.3, 2.0, cycles, ratio)
    rng = np.random.default_rng(seed)
    time = np.arange(-lead, p.duration_s / 1e-3 + 300) * 1e-3
    time = time + jitter * 1e-3 * rng.uniform(-1, 1, time.size)
    v = 0.0137 * np.round((trajectory.velocity(p, time) + 0.05 * rng.normal(size=time.size)) / 0.0137)
    f = friction(v) + rng.normal(size=time.size)
    pairs = function_a(time, v, f, p)
    got = (pairs.velocity_rad_s, pairs.torque_nm, pairs.velocity_minus_rad_s, pairs.torque_plus_nm,
           pairs.torque_minus_nm, pairs.samples_plus, pairs.samples_minus)  # fmt: skip
    for ours, book in zip(got, by_the_book(time, v, f, p), strict=True):
        assert np.allclose(ours, book, rtol=1e-11, atol=1e-11)


def test_inertia_and_gravity_cancel():
    # A fine step: one sample more on one side of a window is an error of its own.
    bare = function_a(*perfect(step=5e-5), P)
    loaded = function_a(*perfect(step=5e-5, inertia=2.0, gravity=40.0), P)
    assert np.allclose(bare.torque_nm, loaded.torque_nm, rtol=1e-3)
    assert np.ptp(loaded.torque_plus_nm + loaded.torque_minus_nm - 2 * 40 * np.cos(0.3)) < 10


def test_mean_velocity_is_0_932_of_the_peak_at_ratio_0_8():
    pairs = function_a(*perfect(), P)
    assert np.allclose(pairs.velocity_rad_s / P.peak_velocities_rad_s, 0.932, atol=3e-3)
    low, high = np.degrees(pairs.curve().measured_range_rad_s)
    assert low == pytest.approx(10.7, abs=0.1)
    assert high == pytest.approx(107, abs=0.5)


def test_mean_velocity_counts_forward_motion_only_and_reports_the_other():
    time, v, f = perfect()
    v = np.where(v < 0, 1.1 * v, v)
    pairs = function_a(time, v, f, P)
    straight = function_a(*perfect(), P)
    assert np.array_equal(pairs.velocity_rad_s, straight.velocity_rad_s)
    assert np.all(pairs.velocity_minus_rad_s > 1.04 * pairs.velocity_rad_s)


def test_time_skew_errs_as_predicted():
    """dF_n = -0.93 I v_n w_n^2 tau: the rise of the error at small travel."""
    inertia, tau = 2.0, 0.002
    exact = function_a(*perfect(inertia=inertia), P).torque_nm
    late = function_a(*perfect(inertia=inertia, late=tau), P).torque_nm
    predicted = -0.93 * inertia * P.peak_velocities_rad_s * P.angular_frequencies_rad_s**2 * tau
    # A late torque reads the rising flank: late = exact(t - tau).
    assert np.allclose((late - exact)[4:], -predicted[4:], rtol=0.05)


def test_windows_are_half_open_in_recorded_time():
    p = Procedure(0.3, 2.0, 2, 0.0)
    join = p.cycle_starts_s[1]
    time, v, f = perfect(p)
    time = time + (join - time[np.argmin(np.abs(time - join))])  # one sample exactly at T_2
    keep = time >= 0
    time, v, f = time[keep], v[keep], f[keep]
    at = int(np.flatnonzero(time == join)[0])
    v[at], f[at] = 0.5, 1e6
    pairs = function_a(time, v, f, p)
    assert pairs.torque_plus_nm[0] < 100 < pairs.torque_plus_nm[1]


def test_time_may_be_irregular_and_begin_before_cycle_1():
    time, v, f = perfect(step=2.5e-4)
    rng = np.random.default_rng(3)
    keep = np.sort(rng.choice(time.size, time.size // 3, replace=False))
    before = np.array([-0.2, -0.1])
    pairs = function_a(
        np.concatenate([before, time[keep]]),
        np.concatenate([[9.0, 9.0], v[keep]]),
        np.concatenate([[1e9, 1e9], f[keep]]),
        P,
    )
    full = function_a(time, v, f, P)
    assert np.allclose(pairs.torque_nm, full.torque_nm, rtol=2e-3)


@pytest.mark.parametrize(("sign", "direction"), [(1, "forward"), (-1, "backward")])
def test_an_empty_window_is_an_error_that_names_cycle_and_direction(sign, direction):
    time, v, f = perfect()
    seventh = P.cycle_of(time) == 6
    v = np.where(seventh & (np.sign(v) == sign), 0.5 * v, v)
    with pytest.raises(IdentificationError, match=f"cycle 7 of 10 has no sample in its {direction} window") as error:
        function_a(time, v, f, P, where="joint 4")
    assert error.value.where == "joint 4"
    assert "saturation" in error.value.cause


def test_a_recording_that_ends_early_names_the_missing_cycle():
    time, v, f = perfect()
    early = time < P.cycle_starts_s[8]
    with pytest.raises(IdentificationError, match="cycle 9 of 10 has no sample at all"):
        function_a(time[early], v[early], f[early], P)


@pytest.mark.parametrize("column", [1, 2])
def test_a_value_that_is_not_finite_never_vanishes(column):
    data = perfect()
    data[column][5000] = np.nan
    with pytest.raises(IdentificationError, match="not finite"):
        function_a(*data, P)


def test_unequal_lengths_are_refused():
    time, v, f = perfect()
    with pytest.raises(IdentificationError, match="equal 1-D shapes"):
        function_a(time, v[:-1], f, P)


def test_recordings_that_are_sampled_unlike_leave_little_behind():
    """On the wall clock no two recordings have the same number of samples: each one's thresholds were kept."""
    recordings = [perfect(step=1e-3 * (1 + 0.01 * n)) for n in range(20)]
    tracemalloc.start()
    for recording in recordings:
        function_a(*recording, P)
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert kept < 5 * recordings[0][0].nbytes
