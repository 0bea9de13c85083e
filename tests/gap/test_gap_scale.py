"""One joint in other units: what is found of a motor or of an axis in metres is what is found of a joint in radians."""

from __future__ import annotations

from dataclasses import replace

import gap_sets
import numpy as np
import pytest

from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.experiment_set import ExperimentSet, Nominal

MOTOR = pytest.param(30.0, 1e-3, id="a motor")
FAST = pytest.param(200.0, 1e-4, id="a motor at 3000 revolutions a minute")
AXIS = pytest.param(0.03, 100.0, id="an axis in metres")


def in_units(motion: float, torque: float) -> Nominal:
    """The joint of the tests on a level, every way ``motion`` and every torque ``torque`` times as large."""
    n = gap_sets.NOMINAL
    stiffer = torque / motion
    assert n.controller is not None and n.curve is not None and n.presliding_stiffness_nm_per_rad is not None
    assert n.inertia_kg_m2 is not None and n.encoder_resolution_rad is not None
    assert n.rated_torque_nm is not None and n.torque_quantum_nm is not None
    c = n.controller
    gains = {name: stiffer * getattr(c, name) for name in ("kp_nm_per_rad", "ki_nm_per_rad_s", "kd_nm_s_per_rad")}
    return replace(
        n,
        inertia_kg_m2=stiffer * n.inertia_kg_m2,
        gravity_cos_nm=0.0,
        payload=None,
        gear_ratio=1.0,
        curve=FrictionCurve.through(motion * np.array(n.curve.velocity_rad_s), torque * np.array(n.curve.torque_nm)),
        presliding_stiffness_nm_per_rad=stiffer * n.presliding_stiffness_nm_per_rad,
        encoder_resolution_rad=motion * n.encoder_resolution_rad,
        rated_torque_nm=torque * n.rated_torque_nm,
        torque_quantum_nm=torque * n.torque_quantum_nm,
        controller=replace(c, **gains, torque_limit_nm=torque * c.torque_limit_nm),
    )


def recorded(motion: float, torque: float, effects: dict[str, dict[str, float]]) -> ExperimentSet:
    plain = gap_sets.commands()
    scaled = {name: (motion * command, False, validation) for name, (command, _, validation) in plain.items()}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gap_sets, "commands", lambda: scaled)
        return gap_sets.make(effects, in_units(motion, torque), noise_nm=torque * gap_sets.NOISE_NM)


@pytest.mark.parametrize(("motion", "torque"), [MOTOR, AXIS])
@pytest.mark.parametrize(
    ("effect", "number", "value", "power"),  # the unit of the number: motion and torque to these powers
    [
        ("stribeck", "stribeck_velocity_rad_s", 0.06, (1, 0)),
        pytest.param("joint_elasticity", "compliance_rad_per_nm", 2e-4, (1, -1), marks=pytest.mark.slow),
        pytest.param("presliding_hysteresis", "distance_rad", 0.01, (1, 0), marks=pytest.mark.slow),
        pytest.param("stiction_breakaway", "travel_rad", 0.002, (1, 0), marks=pytest.mark.slow),
        pytest.param("viscous_nonlinearity", "knee_rad_s", 0.4, (1, 0), marks=pytest.mark.slow),
        pytest.param("backlash", "gap_rad", 0.004, (1, 0), marks=pytest.mark.slow),
    ],
)
def test_a_cause_is_found_in_any_unit(
    motion: float, torque: float, effect: str, number: str, value: float, power: tuple[int, int]
) -> None:
    others = {
        "stribeck": {"share": 0.15, "exponent": 1.4},
        "joint_elasticity": {"relaxation_s": 1e-3},
        "presliding_hysteresis": {"share": 0.3},
        "stiction_breakaway": {"share": 0.2, "dwell_time_s": 0.5},
        "viscous_nonlinearity": {"share": 0.3, "bend": -1.0},
        "backlash": {"contact_stiffness_nm_per_rad": 2e4 * torque / motion, "contact_relaxation_s": 5e-4},
    }
    size = value * motion ** power[0] * torque ** power[1]
    found = diagnose(recorded(motion, torque, {effect: {number: size, **others[effect]}}))
    assert found.verdict == "explained" and found.causes[0].effect == effect
    assert 0.5 * size < found.causes[0].parameters[number].value < 2.0 * size


@pytest.mark.parametrize(("motion", "torque"), [pytest.param(1.0, 1.0, id="a joint"), MOTOR, FAST, AXIS])
def test_a_healthy_joint_needs_no_stated_stiffness_in_any_unit(motion: float, torque: float) -> None:
    """The travel over which friction builds up is read from the recordings, finely enough that it makes no gap."""
    healthy = recorded(motion, torque, {})
    unstated = replace(healthy.nominal, presliding_stiffness_nm_per_rad=None, controller=None)
    assert diagnose(replace(healthy, nominal=unstated)).verdict == "none"
