"""Friction compensated by a downloaded table on the controller's tick, against the same law from the host at 250 Hz.

Once literally, over CAN with the product's own verbs (all joints: ``benchmarks/serial_compensation.py``), and joint by
joint against the law itself.

A simulated person swings the joint at 0.5 Hz, 20 deg to either side, in both cases; what counts is the torque that the
person needs. Both laws see the joint once per 4 ms and hold their torque until the next tick.
"""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from frictid_hil.config.robot import load_robot
from frictid_hil.friction.compensation import Compensation, CompensationSettings
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.plan.plan import Hold
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.servo_loop import ServoLoop
from frictid_hil.simulation.steady import true_curve_nm

pytestmark = pytest.mark.slow

SETUP = load_robot("hp3j-serial").to_setup()
SECONDS, SKIPPED_S, TICK_S = 8.0, 2.0, 0.004
RATIO, SHARE_OF_PRESLIDING = 0.9, 0.9


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """``benchmarks/serial_compensation.py``."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    return importlib.import_module("serial_compensation")


def model_of(joint: str) -> JointModel:
    return JointModel.of(SETUP.joint(joint), joint)


def curve_of(model: JointModel) -> FrictionCurve:
    speed = 0.932 * np.arange(1, 11) * math.radians(11.5)
    return FrictionCurve.through(speed, true_curve_nm(model, speed))


def by_table(benchmark: ModuleType, joint: str, ratio: float) -> float:
    model = model_of(joint)
    at = SETUP.joint(joint).locked_position_rad
    felt = benchmark.felt_nm(
        joint,
        (Hold(at, 0.1), Hold(at, SECONDS, name="guided"), Hold(at, 0.1)),
        curve_of(model),
        delay_ms=0.0,
        ratio=ratio,
        stiffness_nm_per_rad=SHARE_OF_PRESLIDING * model.presliding_stiffness_nm_per_rad,
        gravity_cos_nm=model.gravity_cos_nm,
        gravity_sin_nm=model.gravity_sin_nm,
    )
    assert len(felt) == pytest.approx(SECONDS / TICK_S, abs=2)
    return float(benchmark.rms_nm(felt, SKIPPED_S))


def by_host(benchmark: ModuleType, joint: str, ratio: float) -> float:
    """The law of the host on torque mode, one exchange per tick, applied from the same tick on."""
    model, entry = model_of(joint), SETUP.joint(joint)
    at = entry.locked_position_rad
    loop = ServoLoop(model, period_s=0.001, seed=3, position_rad=at)
    loop.power(True)
    loop.brake(False)
    loop.advance(0.1, position_rad=at)
    loop.set_mode(10)
    loop.hold_hand(model.hand, centre_rad=at, amplitude_rad=0.349, frequency_hz=0.5)
    stiffness = SHARE_OF_PRESLIDING * model.presliding_stiffness_nm_per_rad
    settings = CompensationSettings.of(curve_of(model), "mop", stiffness_nm_per_rad=stiffness, ratio=ratio)
    friction = Compensation(settings, TICK_S)
    felt: list[float] = []
    before = loop.measured_position_rad
    for _ in range(round(SECONDS / TICK_S)):
        here = loop.measured_position_rad
        gravity = model.gravity_cos_nm * math.cos(here) + model.gravity_sin_nm * math.sin(here)
        torque = gravity + friction.step(here - before, loop.velocity_rad_s)
        before = here
        loop.advance(TICK_S, torque_nm=torque)
        felt.append(loop.external_torque_nm)
    return float(benchmark.rms_nm(felt, SKIPPED_S))


@pytest.mark.parametrize("joint", ["0", "1", "4"])
def test_the_table_does_what_the_host_does_within_three_points(benchmark: ModuleType, joint: str) -> None:
    reductions = {}
    for name, swing in (("table", by_table), ("host", by_host)):
        reductions[name] = 100 * (1 - swing(benchmark, joint, RATIO) / swing(benchmark, joint, 0.0))
    print(f"joint {joint}: " + ", ".join(f"{name} {points:.1f} %" for name, points in reductions.items()))
    assert reductions["host"] > 30
    assert reductions["table"] == pytest.approx(reductions["host"], abs=3.0)


def test_the_table_does_what_a_can_run_with_the_same_delay_does_within_three_points(
    benchmark: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    profile = benchmark.profile_over_can(["4"], tmp_path)
    can, (late,) = benchmark.reductions("4", profile, tmp_path, (4.0,))
    assert can["rate_hz"] == 250.0
    assert late > 80
    assert late == pytest.approx(can["modes"]["mop"]["reduction_percent"], abs=3.0)
