"""What a rigid-body column holds: the joint's inertia, its gravity, and neither where the motion does not tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.experiment_set import Experiment, ExperimentSet, Nominal
from frictid_hil.gap.residuals import recordings
from frictid_hil.gap.rigid_column import held_by_column
from frictid_hil.simulation.inverse import View

INERTIA, GRAVITY = 0.4, 4.0
STEP_S = 0.002


def log(
    position_rad: Array, *, inertia: float = INERTIA, gravity: float = GRAVITY, every: int = 1, payload: bool = False
) -> Experiment:
    """A motion with the column of a joint; ``every`` keeps one row in so many."""
    acceleration = np.zeros_like(position_rad)
    acceleration[1:-1] = np.diff(position_rad, 2) / STEP_S**2
    column = inertia * acceleration + gravity * np.cos(position_rad)
    time_s = STEP_S * np.arange(position_rad.size)
    rows = slice(None, None, every)
    return Experiment(
        "log", False, payload, 0, time_s[rows], position_rad[rows],
        torque_nm=column[rows], rigid_body_torque_nm=column[rows],
    )  # fmt: skip


def held(*logs: Experiment, nominal: Nominal | None = None) -> list[View] | None:
    nominal = nominal or Nominal()
    made = recordings(ExperimentSet("column", nominal, logs))
    views = [r.view for r in made if r.view is not None]
    return held_by_column(nominal, views, made)


def motion(*hertz: float, radians: float = 0.4) -> Array:
    time_s = STEP_S * np.arange(6000)
    swings = [radians * np.sin(2.0 * np.pi * h * time_s + h) for h in hertz]
    return np.asarray(np.sum(swings, axis=0))


@pytest.mark.parametrize(("inertia", "gravity"), [(INERTIA, GRAVITY), (2.0, 0.0), (0.0, 5.0)])
def test_a_column_is_an_inertia_and_a_gravity(inertia: float, gravity: float) -> None:
    views = held(log(motion(0.3, 1.1), inertia=inertia, gravity=gravity))
    assert views is not None
    (view,) = views
    assert view.link_inertia_kg_m2 == pytest.approx(inertia, rel=0.01)
    inner = slice(50, -50)
    assert view.gravity_nm[inner] == pytest.approx(gravity * np.cos(view.position_rad[inner]), abs=0.01 * GRAVITY)


@pytest.mark.parametrize("hertz", [6.0, 10.0, 18.0])
def test_its_maker_may_have_filtered_the_acceleration(hertz: float) -> None:
    time_s = STEP_S * np.arange(6000)
    # Slow and wide, and fast and small, so that both parts are of a size.
    plain = log(motion(0.2, 0.7) + 0.002 * np.sin(30.0 * time_s) + 0.0005 * np.sin(70.0 * time_s), gravity=0.0)
    assert plain.rigid_body_torque_nm is not None
    filtered = signal.sosfiltfilt(signal.butter(2, hertz, fs=1.0 / STEP_S, output="sos"), plain.rigid_body_torque_nm)
    views = held(replace(plain, rigid_body_torque_nm=filtered + GRAVITY * np.cos(plain.position_rad)))
    assert views is not None
    (view,) = views
    inner = slice(300, -300)
    inertial = view.link_inertia_kg_m2 * view.acceleration_rad_s2
    assert np.std((inertial - filtered)[inner]) < 0.05 * np.std(filtered)
    assert view.gravity_nm[inner] == pytest.approx(GRAVITY * np.cos(view.position_rad[inner]), abs=0.05 * GRAVITY)


def test_one_slow_sine_tells_neither() -> None:
    assert held(log(motion(0.6, radians=0.2))) is None


def test_logs_of_different_loads_tell_neither() -> None:
    both = log(motion(0.3, 1.1)), log(motion(0.3, 1.1), inertia=0.8, gravity=7.0, payload=True)
    assert held(*both) is None and held(both[0]) is not None


def test_a_stated_inertia_stands() -> None:
    assert held(log(motion(0.3, 1.1)), nominal=Nominal(inertia_kg_m2=1.0)) is None
    bare = replace(log(motion(0.3, 1.1)), rigid_body_torque_nm=None)
    assert held(bare, log(motion(0.3, 1.1))) is None


def test_each_log_has_its_own_rate() -> None:
    fast, slow, slowest = (log(motion(0.3, 1.1), every=every) for every in (1, 5, 20))
    for logs in ((fast, slow), (slow, fast), (slowest, slowest)):
        views = held(*logs)
        assert views is not None
        for view in views:
            inner = slice(view.position_rad.size // 10, -view.position_rad.size // 10)
            true = GRAVITY * np.cos(view.position_rad[inner])
            assert view.gravity_nm[inner] == pytest.approx(true, abs=0.02 * GRAVITY)


def test_a_joint_that_turns_on_and_on_has_the_gravity_of_its_own_angle() -> None:
    time_s = STEP_S * np.arange(6000)
    turning = log(2.0 * time_s + 0.5 * np.sin(5.0 * time_s))
    assert turning.rigid_body_torque_nm is not None
    coupled = replace(turning, rigid_body_torque_nm=turning.rigid_body_torque_nm + 0.5 * np.sin(31.0 * time_s))
    views = held(coupled)
    assert views is not None
    assert views[0].gravity_nm == pytest.approx(GRAVITY * np.cos(views[0].position_rad), abs=0.05 * GRAVITY)
