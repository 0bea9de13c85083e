"""How punctual this computer is: figures from lateness, and the rate that follows from them."""

import gc
import multiprocessing

import numpy as np
import pytest

from frictid_hil.runner.realtime import Latency, judged, measure_latency


@pytest.mark.parametrize(
    ("late_ms", "highest_hz"),
    [([0.05] * 2000, 1000), ([0.05] * 1990 + [0.9] * 10, 500), ([0.05] * 1990 + [6.0] * 10, 50), ([4.9] * 2000, 100)],
)
def test_the_rate_is_one_at_which_nearly_all_cycles_begin_within_half_a_period(late_ms, highest_hz):
    found = judged(np.array(late_ms) * 1e-3, 2.0, [])
    assert found.highest_hz == highest_hz
    assert found.worst_s == pytest.approx(max(late_ms) * 1e-3)


def test_a_single_stall_is_reported_and_does_not_decide():
    found = judged(np.array([5e-5] * 5000 + [0.04]), 5.0, [])
    assert found.highest_hz == 1000 and found.worst_s == pytest.approx(0.04)


def test_measured_in_a_process_of_its_own_it_leaves_this_one_alone():
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        found = pool.apply(measure_latency, (0.2,))
    assert isinstance(found, Latency) and 0.0 <= found.p50_s <= found.p99_s <= found.p999_s <= found.worst_s
    assert gc.isenabled()
