"""Position against reported velocity, by the samples' own times; nothing here looks at the wall clock."""

import itertools
import math
import random
from dataclasses import replace

import numpy as np
import pytest

from frictid_hil.errors import SafetyAbort
from frictid_hil.protocol.driver import Feedback
from frictid_hil.runner.sensor_watch import SensorWatch
from frictid_hil.runner.unit_proof import Travelled

MS = 1_000_000
DEG = math.pi / 180


def reports(cycles, late_ms=lambda n: 0.0, went=1.0, said=1.0, speed=90.0, moves_on=False):
    """A joint that follows a set-point for one period, and then stands (or moves on) until the next one comes."""
    t_ns, position = 0, 0.0
    for n in range(cycles):
        rate = speed * DEG * math.sin(math.pi * n / cycles)
        late_ns = round(late_ms(n) * MS)
        position += rate * 1e-9 * (MS + late_ns * moves_on) * went
        t_ns += MS + late_ns
        yield Feedback(t_ns=t_ns, position_rad=position, velocity_rad_s=rate * said, torque_nm=float(n))


def verdict(samples):
    watch = SensorWatch(0.001)
    return next(filter(None, (watch.verdict(report, 200 * DEG, asked_rad=0.0) for report in samples)), "")


def stalls(seed):
    chance = random.Random(seed)
    return lambda n: chance.choice((0.0,) * 12 + (0.3, 2.0, 9.0, 30.0, 49.0))


@pytest.mark.parametrize("moves_on", [False, True])
@pytest.mark.parametrize("seed", range(20))
def test_a_computer_that_stalls_is_no_wrong_encoder(seed, moves_on):
    assert verdict(reports(1000, stalls(seed), moves_on=moves_on)) == ""


def test_a_computer_that_is_late_in_every_cycle_is_no_wrong_encoder_either():
    assert verdict(reports(1000, lambda n: 2.0)) == ""


def burst(silent, speed=110.0, cycles=1000, every=150):
    """Drives whose answers do not come for some cycles, then all at once: the first row shows the oldest of them."""
    rates = [speed * DEG * math.sin(math.pi * n / cycles) for n in range(cycles)]
    positions = np.cumsum(rates) * 0.001
    for n in range(cycles):
        since = n % every
        if since < silent:
            continue
        of = n - silent if since == silent and n > silent else n
        yield Feedback(t_ns=n * MS, position_rad=positions[of], velocity_rad_s=rates[of], torque_nm=float(n))


@pytest.mark.parametrize("silent", [2, 9, 20, 30, 60])
def test_answers_that_come_late_and_all_at_once_are_no_jump(silent):
    assert verdict(burst(silent)) == ""


def test_a_jump_without_a_silence_before_it_is_told():
    samples = list(reports(1000))
    samples[500:] = [replace(one, position_rad=one.position_rad + 0.9 * DEG) for one in samples[500:]]
    assert "position jumped by 0.9" in verdict(samples)


@pytest.mark.parametrize("lie", [{"went": 0.0}, {"said": 0.0}, {"said": 2.0}, {"said": -1.0}, {"went": 0.5}])
@pytest.mark.parametrize("late_ms", [lambda n: 0.0, lambda n: 9.0 * (n % 40 == 0)], ids=["on time", "some late"])
def test_two_ways_that_differ_are_told(lie, late_ms):
    assert "its reported velocity says" in verdict(reports(1000, late_ms, **lie))


def test_a_velocity_that_points_the_other_way_is_told_however_late_the_samples_are():
    assert "its reported velocity says" in verdict(reports(1000, lambda n: 5.0, said=-1.0))


def test_a_report_that_comes_twice_says_nothing_new():
    samples = list(reports(1000))
    again = [each for sample in samples for each in (sample, sample)]
    assert verdict(again) == "" != verdict(reports(1000, said=2.0))
    # An adapter that shows the last figures once more under a new time, now and then.
    stale = [Feedback(b.t_ns, a.position_rad, a.velocity_rad_s, b.torque_nm) if n % 3 == 0 else b
             for n, (a, b) in enumerate(itertools.pairwise(samples))]  # fmt: skip
    assert verdict(stale) == ""


def test_after_a_tenth_of_a_second_without_a_sample_the_comparison_begins_anew():
    samples = list(reports(1000))
    assert verdict(samples[:300] + samples[450:]) == "", "the joint was elsewhere when it was seen again"


@pytest.mark.parametrize("seed", range(5))
def test_the_first_motion_of_half_a_degree_is_not_judged_by_a_stall(seed):
    def judged(said):
        travelled = Travelled(0.001)
        for report in reports(300, stalls(seed), said=said, speed=3.0):
            travelled.add(report, 1.0)
        travelled.judge("3")

    judged(1.0)
    with pytest.raises(Exception, match="position says"):
        judged(-1.0)


@pytest.mark.parametrize("silent", [60, 100, 140])
def test_a_motion_that_nobody_saw_proves_no_unit_and_refutes_none(silent):
    def judged(said, every=500):
        travelled = Travelled(0.001)
        for report in burst(silent, speed=3.0, every=every):
            travelled.add(replace(report, velocity_rad_s=report.velocity_rad_s * said), 1.0)
        travelled.judge("3")

    judged(1.0)
    for wrong in (-1.0, 0.5, 2.0):
        with pytest.raises(SafetyAbort, match="position says"):
            judged(wrong)
    with pytest.raises(SafetyAbort, match="while no report came"):
        judged(1.0, every=silent + 20)


def test_a_drive_that_reports_in_every_third_cycle_is_not_silent():
    travelled = Travelled(0.02)
    for n in range(50):
        travelled.add(Feedback(t_ns=3 * n * 20 * MS, position_rad=0.0006 * n, velocity_rad_s=0.01), 1.0)
    assert travelled.unseen_rad == 0.0
    travelled.judge("3")


def repeated(cycles, torque_nm=lambda n: 1.0, went=lambda n: n):
    """Somebody repeats a report of a joint that stood, while the set-point goes on by 0.05 deg in every cycle."""
    watch = SensorWatch(0.001)
    for n in range(cycles):
        report = Feedback(t_ns=n * MS, position_rad=0.1, velocity_rad_s=0.0, torque_nm=torque_nm(n))
        if wrong := watch.verdict(report, 200 * DEG, asked_rad=0.1 + 0.05 * DEG * went(n)):
            return wrong
    return ""


def test_the_same_report_again_and_again_is_noticed_once_the_set_point_moves():
    assert "the same position, velocity and torque for 0.1 s" in repeated(103)
    assert repeated(99) == ""


def test_a_joint_that_stands_or_sticks_repeats_nothing_that_matters():
    assert repeated(1000, went=lambda n: 0) == ""
    assert repeated(1000, torque_nm=lambda n: 0.01 * (n // 20)) == "", "its loop pulls harder and harder"
    assert repeated(1000, torque_nm=lambda n: math.nan) == "", "nobody reports a torque"


def swinging(torque_nm):
    """A joint that swings at 1 Hz, by 5.7 deg to either side."""
    for n in range(1500):
        phase = 2e-3 * math.pi * n
        velocity = 0.2 * math.pi * math.cos(phase)
        yield Feedback(n * MS, 0.1 * math.sin(phase), velocity, torque_nm=torque_nm(n, velocity))


@pytest.mark.parametrize("stuck_nm", [0.0, 3.7])
def test_a_torque_that_stands_whichever_way_the_joint_moves_is_told(stuck_nm):
    told = verdict(swinging(lambda n, velocity: stuck_nm if n > 300 else math.copysign(5.0, velocity)))
    assert "torque stands at exactly" in told
    assert verdict(swinging(lambda n, velocity: math.copysign(5.0, velocity))) == ""
    assert verdict(swinging(lambda n, velocity: math.nan)) == "", "nobody reports a torque"


@pytest.mark.parametrize(
    ("speeds_deg_s", "told"),
    [
        ([30, 30, 0, 0, 0], True),  # an encoder that stands, or a stop that was hit
        ([30, 30, 0, 0, 1], False),
        ([30, 20, 10, 0, 0], False),  # braked
        ([10, 10, 0, 0, 0], False),  # friction may do that to a light joint
        ([30, 30, 30, 30, 30], False),
    ],
)
@pytest.mark.parametrize("held", [False, True])
def test_a_joint_under_torque_that_stands_at_once_is_told(speeds_deg_s, told, held):
    """An encoder stood in motion; the joint was driven on until its position loop snapped at 424 deg/s."""
    watch, position_rad, said = SensorWatch(0.002), 0.0, []
    for n, speed in enumerate([speeds_deg_s[0]] * 30 + speeds_deg_s):
        velocity_rad_s = math.radians(speed)
        position_rad += velocity_rad_s * 0.002
        report = Feedback(
            position_rad=position_rad, velocity_rad_s=velocity_rad_s, torque_nm=0.1 * n, t_ns=n * 2_000_000
        )
        said.append(watch.verdict(report, 5.0, asked_rad=position_rad if held else math.nan))
    # A position loop has a following error to tell it by.
    assert any("stood within one report" in one for one in said) is (told and not held)


def standing(torques_nm, position_rad=lambda n: 0.1):
    """A joint under torque control, asked for by its watch every 5 ms; it withstands 1.5 N m from end to end."""
    watch = SensorWatch(0.005)
    for n, torque_nm in enumerate(torques_nm):
        report = Feedback(t_ns=(n + 1) * 5 * MS, position_rad=position_rad(n), velocity_rad_s=0.0, torque_nm=torque_nm)
        if wrong := watch.withstood(report, torque_nm, 1.5):
            return wrong
    return ""


def test_a_joint_that_stands_whatever_torque_it_is_given_has_an_encoder_that_stands():
    """A servo's position froze at a turning point; its joint went 650 deg, and snapped back at 1577 deg/s."""
    rising = [3.0 + 0.01 * n for n in range(200)]  # gravity takes the 3 N m
    assert "stands at 5.7" in standing(rising)
    assert standing(rising[:151]) == ""
    assert standing(rising, lambda n: 0.1 + 0.001 * (n > 100)) == "", "it gave way by one encoder step"
