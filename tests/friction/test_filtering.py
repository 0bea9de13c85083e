import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frictid_hil.friction.filtering import Gaussian, uniform


@settings(deadline=None)
@given(width=st.floats(1.0, 8.0), advance=st.floats(-4.0, 4.0), frequency=st.floats(0.5, 40.0))
def test_any_fraction_of_a_sample_is_advanced_exactly_and_without_phase(width, advance, frequency):
    step = 1e-3
    time = np.arange(600) * step
    w = 2 * np.pi * frequency
    kernel = Gaussian(step, width * step)
    inner = slice(100, -100)
    loss = np.exp(-((w * width * step) ** 2) / 2)
    there = time + advance * step
    assert np.allclose(
        kernel.smooth(np.sin(w * time), advance * step)[inner], loss * np.sin(w * there)[inner], atol=1e-6
    )
    assert np.allclose(
        kernel.rate(np.sin(w * time), advance * step)[inner] / w, loss * np.cos(w * there)[inner], atol=1e-5
    )


def test_parabolas_keep_their_derivatives():
    time = np.arange(500) * 2e-3
    kernel = Gaussian(2e-3, 5e-3)
    inner = slice(40, -40)
    assert np.allclose(kernel.rate(1.5 * time**2 + 7)[inner], 3 * time[inner])
    assert np.allclose(kernel.curvature(1.5 * time**2 + 7)[inner], 3.0)


def test_ramps_survive_at_the_ends():
    time = np.arange(300) * 1e-3
    kernel = Gaussian(1e-3, 4e-3)
    assert np.allclose(kernel.smooth(2 * time - 1, 3e-4), 2 * (time + 3e-4) - 1)
    assert np.allclose(kernel.rate(2 * time - 1), 2.0)


def test_a_kernel_below_one_sample_is_refused():
    with pytest.raises(ValueError, match="below one step"):
        Gaussian(1e-3, 0.5e-3)


def test_irregular_time_is_brought_to_the_median_step():
    rng = np.random.default_rng(2)
    time = np.arange(2000) * 1e-3 + rng.uniform(-2e-4, 2e-4, 2000)
    grid, (wave,) = uniform(time, np.sin(20 * time))
    assert np.ptp(np.diff(grid)) < 1e-12
    assert np.allclose(wave[5:-5], np.sin(20 * grid)[5:-5], atol=1e-6)
    same, (as_is,) = uniform(grid, wave)
    assert same is grid and as_is is wave
