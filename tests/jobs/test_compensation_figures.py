"""Figures of a compensation from synthetic runs: what they say, and that a late clock does not change it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.jobs.compensation.figures import figures, friction_dominates, tracking_floor_rad
from frictid_hil.jobs.compensation.plan import triangle
from frictid_hil.plan.control import PositionGains
from frictid_hil.report.compensation import ModeRun

INERTIA, STEP = 0.5, 1e-3
OMEGA, REACH = math.pi, math.radians(20)


def guided(friction_nm: float, time_s: np.ndarray | None = None, late_s: np.ndarray | float = 0.0) -> ModeRun:
    """A joint swung by hand; the drive hears each SYNC ``late_s`` after the time on its row."""
    time_s = np.arange(2.0, 6.0, STEP) if time_s is None else time_s
    true_s = time_s + late_s
    position, velocity = REACH * np.sin(OMEGA * true_s), OMEGA * REACH * np.cos(OMEGA * true_s)
    torque = -INERTIA * OMEGA**2 * position + friction_nm * np.tanh(velocity / 0.05)
    return ModeRun("mop", time_s, position, velocity, position, torque, torque)


def removed(run: ModeRun) -> float:
    value = figures({"mop": run}, "hand", INERTIA)["mop"].torque_rms_inertia_removed_nm
    assert value is not None
    return value


def test_what_is_left_without_inertia_is_friction() -> None:
    assert removed(guided(0.0)) < 1e-3
    assert removed(guided(2.0)) == pytest.approx(2.0, rel=0.05)


def test_missed_cycles_do_not_change_the_figures() -> None:
    time_s = np.arange(2.0, 6.0, STEP)
    rng = np.random.default_rng(1)
    kept = np.ones(time_s.size, dtype=bool)
    for at in rng.integers(50, time_s.size - 50, 60):
        kept[at : at + rng.integers(1, 6)] = False
    assert removed(guided(0.2, time_s[kept])) == pytest.approx(removed(guided(0.2)), rel=0.01)


def test_drives_that_hear_sync_late_do_not_change_the_figures() -> None:
    rng = np.random.default_rng(2)
    late_s = np.where(rng.random(4000) < 0.01, rng.uniform(0.0, 2e-3, 4000), rng.uniform(0.0, 5e-5, 4000))
    assert removed(guided(0.2, late_s=late_s)) == pytest.approx(removed(guided(0.2)), rel=0.02)


def test_a_velocity_that_is_declared_late_is_put_right() -> None:
    run = guided(0.0)
    delayed = replace(run, velocity_rad_s=OMEGA * REACH * np.cos(OMEGA * (run.time_s - 0.02)))
    assert removed(replace(delayed, velocity_delay_s=0.02)) < 1e-3 < removed(delayed)


@pytest.mark.parametrize("omega_rad_s", [8.0, 15.0])
def test_the_floor_of_a_frictionless_joint_is_the_closed_form(omega_rad_s: float) -> None:
    """A step of 2 v in the velocity reference: rms error 2 v / sqrt(2 zeta omega^3 T), T one reversal apart."""
    speed = math.radians(10.0)
    gains = PositionGains(INERTIA * omega_rad_s**2, 1.4 * INERTIA * omega_rad_s)
    path = triangle(0.0, math.radians(20.0), speed, 2)
    period_s = path.duration_s / 2
    curve = FrictionCurve((0.2, 2.0), (5.0, 7.0))
    found = tracking_floor_rad(path, gains, INERTIA, curve, first_s=period_s, follows_reference=False)
    assert found == pytest.approx(2 * speed / math.sqrt(1.4 * omega_rad_s**3 * period_s), rel=0.02)
    with_friction = tracking_floor_rad(path, gains, INERTIA, curve, first_s=period_s, follows_reference=True)
    assert 0.2 * found < with_friction < found


def test_the_ceiling_of_tracking_stands_beside_the_reduction() -> None:
    run = guided(0.0)
    nc, mop = (replace(run, mode=mode, reference_rad=run.position_rad + e) for mode, e in (("nc", 0.04), ("mop", 0.02)))
    found = figures({"nc": nc, "mop": mop}, "track", INERTIA, {"mop": 0.01})
    assert found["mop"].reduction_percent == pytest.approx(50.0)
    assert found["mop"].ceiling_percent == pytest.approx(75.0)
    assert found["nc"].ceiling_percent is None


@pytest.mark.parametrize(("floor_rad", "dominates"), [(0.0059, True), (0.0061, False)])
def test_friction_dominates_where_giving_it_back_exactly_would_leave_little(floor_rad: float, dominates: bool) -> None:
    run = guided(0.0)
    nc, mop = (
        replace(run, mode=mode, reference_rad=run.position_rad + e)
        for mode, e in (("nc", 0.04), ("mop-reference", 0.02))
    )
    found = figures({"nc": nc, "mop-reference": mop}, "track", INERTIA, {"mop-reference": floor_rad})
    assert friction_dominates(found) is dominates
    assert friction_dominates(figures({"nc": nc}, "track", INERTIA)) is None


def test_the_error_before_and_after_has_an_interval_from_cycle_to_cycle() -> None:
    rng = np.random.default_rng(3)
    time_s = np.arange(8 * 1000) * STEP
    path = REACH * np.sin(2.0 * math.pi * time_s)

    def followed(error_rad: float) -> ModeRun:
        size = np.repeat(error_rad * rng.normal(1.0, 0.05, 8), 1000)
        still = np.zeros(time_s.size)
        position = path - size * np.cos(2.0 * math.pi * time_s)
        return ModeRun("", time_s, position, np.gradient(path, STEP), path, still, None, cycles=8)

    found = figures({"nc": followed(0.02), "mop": followed(0.004)}, "track", None)
    low, high = found["mop"].reduction_interval_95_percent or (0.0, 0.0)
    assert low < 80.0 < high < low + 5.0
    low, high = found["nc"].interval_95 or (0.0, 0.0)
    assert low < 0.02 * math.sqrt(0.5) < high and found["nc"].reduction_interval_95_percent is None
    assert found["mop"].velocity_error_rms_rad_s == pytest.approx(0.0, abs=1e-2)
    alone = figures({"nc": replace(followed(0.02), cycles=1)}, "track", None)
    assert alone["nc"].interval_95 is None, "one cycle tells nothing of the next"
