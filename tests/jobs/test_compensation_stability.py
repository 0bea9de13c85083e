"""A joint pushed out of the travel on which its gravity was identified: R falls there, and it comes to rest."""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from frictid_hil.config.robot import load_robot
from frictid_hil.friction.compensation import OUR_RATIO, RATIO_MARGIN, CompensationSettings
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.plan.control import ControlLaw, Gravity
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.servo_loop import ServoLoop
from frictid_hil.simulation.steady import true_curve_nm

SETUP = load_robot("hp3j").to_setup().joint("1")
MODEL = JointModel.from_mapping(
    SETUP.simulated,
    gear_ratio=SETUP.gear_ratio,
    rated_torque_nm=SETUP.rated_torque_nm,
    max_torque_nm=SETUP.max_torque_nm,
)
CENTRE_RAD = SETUP.start_position_rad + math.radians(10.0)
WRONG_NM = 1.3
"""Of the bias, and of the top of the cosine the other way: within the calibrated travel nobody sees it."""


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """``benchmarks/compensation_stability.py``."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    return importlib.import_module("compensation_stability")


def law(wrong_nm: float, unsure_nm: float) -> ControlLaw:
    """Compensation with R + 0.02 and gravity that is wrong by ``wrong_nm (1 - cos(q - centre))``."""
    speeds = 0.932 * np.arange(1, 11) * math.radians(11.5)
    curve = FrictionCurve.through(speeds, true_curve_nm(MODEL, speeds))
    gravity = Gravity(
        MODEL.gravity_cos_nm - wrong_nm * math.cos(CENTRE_RAD),
        MODEL.gravity_sin_nm - wrong_nm * math.sin(CENTRE_RAD),
        wrong_nm + 0.05 * curve.coulomb_nm,  # half of what the two directions differ by
        CENTRE_RAD,
        math.radians(10.0) / math.sqrt(2.0),
        unsure_nm,
    )
    stiffness = 0.8 * MODEL.presliding_stiffness_nm_per_rad
    friction = CompensationSettings.of(curve, "mop", stiffness_nm_per_rad=stiffness, ratio=OUR_RATIO + RATIO_MARGIN)
    return ControlLaw("mop", gravity, None, friction, None, False, SETUP.max_torque_nm, 400.0 * curve.coulomb_nm)


def speed_deg_s(benchmark: ModuleType, wrong_nm: float, unsure_nm: float, delay_cycles: int) -> float:
    """In the last second, pushed the way that wrong gravity pulls."""
    way = math.copysign(1.0, wrong_nm)
    return float(benchmark.alone(law(wrong_nm, unsure_nm), SETUP, delay_cycles, way, ServoLoop))


@pytest.mark.parametrize("wrong_nm", [WRONG_NM, -WRONG_NM])
@pytest.mark.parametrize("delay_cycles", [2, 5])
def test_it_stands_with_gravity_wrong_by_its_whole_interval(
    benchmark: ModuleType, wrong_nm: float, delay_cycles: int
) -> None:
    assert speed_deg_s(benchmark, wrong_nm, WRONG_NM, delay_cycles) < 0.01


def test_it_would_drift_on_if_r_stayed(benchmark: ModuleType) -> None:
    assert speed_deg_s(benchmark, -WRONG_NM, 0.0, 2) > 1.0
