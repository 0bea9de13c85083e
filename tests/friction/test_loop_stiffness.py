"""A servo's own loop as a spring, and what turning points say of presliding that no encoder shows."""

from __future__ import annotations

import numpy as np
import pytest

from frictid_hil.friction.presliding import least_stiffness, loop_stiffness
from frictid_hil.friction.recording import CycleRecording
from frictid_hil.friction.rigid_body import Measured, RigidBody
from frictid_hil.friction.trajectory import Procedure, position

COUNT_RAD = 2 * np.pi / 4096
STEP_S = 0.005
PROCEDURE = Procedure(0.87, 2.0, 6, 0.8)


def servo(integral: float = 0.0) -> tuple[np.ndarray, ...]:
    """Time, command, position and torque of a joint with 0.3 N m of friction under a spring of 18 N m/rad."""
    time = np.arange(0.0, PROCEDURE.duration_s, STEP_S)
    rng = np.random.default_rng(3)
    path = position(PROCEDURE, time)
    speed = np.gradient(path, STEP_S)
    torque = 0.3 * np.tanh(speed / 0.02) + 0.05 * speed + 0.012 * np.gradient(speed, STEP_S)
    command = path + (torque + 0.5 * speed) / 18.0 - integral * np.cumsum(torque) * STEP_S
    torque = torque + 0.007 * rng.normal(size=time.size)
    return time, np.round(command / COUNT_RAD) * COUNT_RAD, np.round(path / COUNT_RAD) * COUNT_RAD, torque


@pytest.mark.parametrize("scale", [1.0, 1.3])
def test_the_spring_is_found_in_the_units_of_the_torque(scale: float) -> None:
    time, command, path, torque = servo()
    assert loop_stiffness(time, command, path, scale * torque) == pytest.approx(scale * 18.0, rel=0.03)


def test_a_loop_that_is_no_spring_has_no_stiffness() -> None:
    time, command, path, torque = servo(integral=0.5)
    assert loop_stiffness(time, command, path, torque) is None
    assert loop_stiffness(time, np.full_like(command, np.nan), path, torque) is None


@pytest.mark.parametrize("presliding_rad", [0.0005, 0.004, 0.012])
def test_turning_points_never_say_stiffer_than_it_is(presliding_rad: float) -> None:
    time = np.arange(0.0, PROCEDURE.duration_s, STEP_S)
    path = position(PROCEDURE, time)
    stiffness, force = 0.3 / presliding_rad, np.zeros(time.size)
    for k in range(1, time.size):
        force[k] = np.clip(force[k - 1] + stiffness * (path[k] - path[k - 1]), -0.3, 0.3)
    seen = np.round(path / COUNT_RAD) * COUNT_RAD
    known = Measured(0.0, 0.0)
    body = RigidBody(known, known, known, known)
    noisy = force + 0.007 * np.random.default_rng(1).normal(size=time.size)
    least = least_stiffness(CycleRecording(time, seen, noisy, PROCEDURE), body, 0.3)
    assert least is not None and 0.3 / (0.3 / stiffness + 12 * COUNT_RAD) < least <= stiffness
