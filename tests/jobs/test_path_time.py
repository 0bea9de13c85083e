import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frictid_hil.friction import trajectory
from frictid_hil.friction.trajectory import Procedure
from frictid_hil.jobs.identification.cycles import PathTime, path_time
from frictid_hil.jobs.identification.joint_profile import identify_joint
from frictid_hil.recording.samples import Mark, Samples

P = Procedure(math.radians(20.0), math.radians(115.0), 10)
STEP_NS = 1_000_000
INERTIA = 1.3


def run() -> Samples:
    """A joint that follows its command exactly; motor angle ripple and noise aside, torque is what the model says."""
    lead = 300
    time_ns = np.arange(lead + math.ceil(P.duration_s * 1e3) + lead, dtype=np.int64) * STEP_NS
    at = time_ns * 1e-9 - lead * 1e-3
    q, v, a = (f(P, at) for f in (trajectory.position, trajectory.velocity, trajectory.acceleration))
    noise = np.random.default_rng(4).normal(scale=0.05, size=at.size)
    torque = INERTIA * a + (8.0 + 3.0 * np.abs(v)) * np.tanh(v / 0.01) + 20.0 * np.cos(q) + noise
    details = {"amplitude_rad": P.amplitude_rad, "velocity_rad_s": P.velocity_rad_s, "cycles": P.cycles, "ratio": 0.8}
    start, end = lead * STEP_NS, int(time_ns[-lead])
    marks = (Mark("hold", 0, start), Mark("cycles", start, end, details))
    meta = {"timing": {"position_delay_s": 0.0, "torque_delay_s": 0.0}}
    return Samples("0", time_ns, q, v, torque, q, marks=marks, meta=meta)


def stopped(samples: Samples, stops: dict[int, int]) -> Samples:
    """The same run, the clock having gone on by so many cycles before those samples while nothing was sent."""
    extra = np.zeros(len(samples), dtype=np.int64)
    for row, cycles in stops.items():
        extra[row] = cycles * STEP_NS
    shift = np.cumsum(extra)

    def later(time_ns: int) -> int:
        return time_ns + int(shift[np.searchsorted(samples.time_ns, time_ns)])

    marks = tuple(replace(mark, start_ns=later(mark.start_ns), end_ns=later(mark.end_ns)) for mark in samples.marks)
    return replace(samples, time_ns=samples.time_ns + shift, marks=marks)


STOPS = {40: 5, 2100: 27, 5203: 1, 9000: 12, 13_900: 2, 14_377: 25}


@pytest.mark.slow
@pytest.mark.parametrize("method", ["aligned", "least-squares"])
def test_missed_set_points_leave_curve_and_inertia_alone(method: str) -> None:
    whole, broken = (identify_joint(samples, None, method=method) for samples in (run(), stopped(run(), STOPS)))
    assert broken.torque_nm == pytest.approx(whole.torque_nm, rel=2e-3)
    assert broken.inertia_kg_m2.value == pytest.approx(INERTIA, rel=0.01)
    assert str(broken.quality["notes"][0]).startswith(
        "the path stood still 6 times for missed set-points, 27.0 ms at most"
    )


@pytest.mark.slow
def test_lost_reports_are_no_stops() -> None:
    samples = run()
    kept = np.ones(len(samples), dtype=np.bool_)
    kept[np.random.default_rng(1).integers(0, len(samples), 150)] = False
    lossy = samples.select(kept)
    assert path_time(lossy, P, samples.marks[1].start_ns) is None
    whole, profile = (identify_joint(one, None, method="aligned") for one in (samples, lossy))
    assert profile.torque_nm == pytest.approx(whole.torque_nm, rel=2e-3)


def test_where_stops_and_lost_reports_mix_the_inertia_is_still_right() -> None:
    """As on a computer short of time: neither time is the path's, and a jump in it is no acceleration."""
    samples = stopped(run(), STOPS)
    kept = np.ones(len(samples), dtype=np.bool_)
    kept[np.random.default_rng(1).integers(0, len(samples), 120)] = False
    mixed = identify_joint(samples.select(kept), None, method="aligned")
    assert mixed.inertia_kg_m2.value == pytest.approx(INERTIA, rel=0.01)


def noted(samples: Samples) -> Samples:
    """The run with those stops, as the loop that made them notes them."""
    shifts = np.concatenate([[0], np.cumsum(list(STOPS.values()))])[:-1]
    stops = [[(row + int(by)) * STEP_NS, STOPS[row] * STEP_NS] for row, by in zip(STOPS, shifts, strict=True)]
    hold, cycles = stopped(samples, STOPS).marks
    told = [stop for stop in stops if stop[0] < hold.end_ns], [stop for stop in stops if stop[0] >= hold.end_ns]
    marks = tuple(
        replace(mark, details={**mark.details, "stops_ns": of}) for mark, of in zip((hold, cycles), told, strict=True)
    )
    return replace(stopped(samples, STOPS), marks=marks)


def test_what_the_loop_noted_counts_whatever_reports_were_lost_and_however_late_the_others_came() -> None:
    whole, samples = run(), noted(run())
    rng = np.random.default_rng(2)
    kept = rng.random(len(samples)) > 0.1
    late = samples.time_ns + rng.integers(0, STEP_NS, len(samples))
    path = path_time(replace(samples, time_ns=late).select(kept), P, samples.marks[1].start_ns)
    assert path is not None and path.after_ns.size == len(STOPS)
    assert np.array_equal(np.diff(path.of(samples.time_ns)), np.diff(whole.time_ns))


def test_a_loop_that_noted_no_stop_made_none() -> None:
    samples = stopped(run(), {2100: 27})
    marks = tuple(replace(mark, details={**mark.details, "stops_ns": []}) for mark in samples.marks)
    assert path_time(replace(samples, marks=marks), P, samples.marks[1].start_ns) is None


def test_without_commanded_positions_nothing_tells() -> None:
    samples = stopped(run(), STOPS)
    silent = Samples(samples.joint, samples.time_ns, samples.position_rad, torque_nm=samples.torque_nm)
    assert path_time(silent, P, samples.marks[1].start_ns) is None


@settings(deadline=None)
@given(st.dictionaries(st.integers(1, 200), st.integers(1, 40), min_size=1), st.integers(0, 200))
def test_path_time_is_the_run_without_its_stops(stops: dict[int, int], start_row: int) -> None:
    path_ns = np.arange(201, dtype=np.int64) * STEP_NS
    extra = np.zeros(201, dtype=np.int64)
    for row, cycles in stops.items():
        extra[row] = cycles * STEP_NS
    clock_ns = path_ns + np.cumsum(extra)
    rows = np.array(sorted(stops))
    start_ns = int(clock_ns[start_row])
    path = PathTime(clock_ns[rows - 1], extra[rows], start_ns)
    assert path.of(np.array([start_ns])) == [start_ns]
    assert np.array_equal(np.diff(path.of(clock_ns)), np.diff(path_ns))
    fine = path.of(np.arange(0, int(clock_ns[-1]), 250_000))
    assert np.all(np.diff(fine) >= 0)
