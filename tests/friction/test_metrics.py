import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.metrics import curve_distance, curve_mean, rms


def curve_of(levels, top=2.0):
    v = np.linspace(0.2, top, len(levels))
    return FrictionCurve.through(v, np.array(levels))


@settings(deadline=None, max_examples=50)
@given(
    a=st.lists(st.floats(3.0, 3.5), min_size=3, max_size=9),
    b=st.lists(st.floats(3.0, 3.5), min_size=3, max_size=9),
)
def test_distance_is_the_integral_of_15(a, b):
    one, two = curve_of(a), curve_of(b, top=1.7)
    d = curve_distance(one, two, 2.1)
    for low, high, ours in ((0.0, 2.1, d.e_nm), (0.2, 2.0, d.e_measured_nm)):
        edges = np.linspace(low, high, 20_001)
        v = (edges[1:] + edges[:-1]) / 2
        assert ours == pytest.approx(np.sqrt(np.mean((one.magnitude(v) - two.magnitude(v)) ** 2)), rel=1e-3, abs=1e-6)


def test_percentages_refer_to_the_references_mean_on_each_range():
    reference = curve_of([4.0, 5.0, 6.0])
    shifted = curve_of([4.1, 5.1, 6.1])
    d = curve_distance(shifted, reference, 2.0)
    assert d.e_nm == pytest.approx(0.1)
    assert d.e_percent == pytest.approx(100 * 0.1 / curve_mean(reference, 0.0, 2.0))
    assert d.e_percent_measured_range == pytest.approx(100 * 0.1 / 5.0)


def test_a_curve_has_no_distance_to_itself():
    c = curve_of([4.0, 5.0, 6.0])
    assert curve_distance(c, c, 3.0).e_percent == 0.0


def test_rms_of_whole_sine_periods_on_irregular_time():
    time = np.sort(np.random.default_rng(0).uniform(0, 4.0, 40_000))
    assert rms(time, 3.0 * np.sin(np.pi * time)) == pytest.approx(3.0 / np.sqrt(2), rel=1e-3)
