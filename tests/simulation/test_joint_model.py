from __future__ import annotations

import copy
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sim_joints import CONTROLLER, COULOMB, VISCOUS, bare, excitation

from frictid_hil.errors import InvalidFields
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.replay import closed_loop
from frictid_hil.simulation.steady import steady_friction_nm, true_curve_nm

SMALLEST = {"inertia_kg_m2": 0.5, "friction": {"coulomb_nm": 4.0}}
FULL = {
    **bare().to_mapping(),
    "effects": {"stribeck": {"share": 0.2}, "torque_delay": {"delay_s": 0.001}},
}


def read(mapping) -> JointModel:
    return JointModel.from_mapping(mapping, gear_ratio=100.0, rated_torque_nm=20.0, max_torque_nm=60.0)


def problems(mapping) -> dict[tuple, str]:
    with pytest.raises(InvalidFields) as caught:
        read(mapping)
    return {problem.path: problem.message for problem in caught.value.problems}


def test_the_smallest_mapping_gets_sensible_defaults() -> None:
    model = read(SMALLEST)
    assert model.drive.torque_limit_nm == 60.0 and model.drive.rated_torque_nm == 20.0
    assert model.presliding_stiffness_nm_per_rad == pytest.approx(8000.0)
    assert model.encoder.counts_per_revolution == 131072 and model.payload is None and model.hand is None
    assert model.servo.kp_nm_per_rad > 0


@pytest.mark.parametrize("mapping", [SMALLEST, FULL])
def test_mapping_and_joint_round_trip(mapping) -> None:
    model = read(mapping)
    written = model.to_mapping()
    assert read(written) == model and read(written).to_mapping() == written


def test_a_measured_curve_can_be_the_friction() -> None:
    v, f = [0.2, 0.5, 1.0, 2.0], [4.2, 4.6, 5.0, 5.4]
    model = read({"inertia_kg_m2": 0.5, "friction": {"velocity_rad_s": v, "torque_nm": f}})
    curve = FrictionCurve.through(np.array(v), np.array(f))
    speed = np.array([0.0, 0.1, 0.2, 0.7, 2.0, 3.0])
    np.testing.assert_allclose(true_curve_nm(model, speed), curve.magnitude(speed), rtol=1e-8)
    assert read(model.to_mapping()) == model


def test_errors_of_level_and_of_viscosity_add_up() -> None:
    speed = np.array([-0.8, 0.3, 0.8])
    effects = {"friction_level_error": {"error_share": 0.5}, "viscous_error": {"error_share": -0.4}}
    expected = np.sign(speed) * 1.5 * COULOMB + 1.1 * VISCOUS * speed
    assert steady_friction_nm(bare().with_effects(effects), speed) == pytest.approx(expected)


@pytest.mark.parametrize("share", [0.3, 1.0])
@pytest.mark.parametrize("error", [-0.4, 0.5])
def test_what_builds_up_slowly_is_a_share_of_the_level_with_its_error(share: float, error: float) -> None:
    """A level that is lower than believed had no effect where all of it builds up slowly."""
    soft = {"share": share, "distance_rad": 0.004, "loop_exponent": 1.0, "loop_beta": 1.0}
    model = bare().with_effects({"presliding_hysteresis": soft, "friction_level_error": {"error_share": error}})
    expected = (1.0 + error) * (COULOMB + VISCOUS * 0.5)
    assert steady_friction_nm(model, np.array([0.5])) == pytest.approx(np.array([expected]))


def test_steady_friction_of_the_plain_joint_is_its_formula() -> None:
    v = np.array([[-1.0, 0.0], [0.5, 2.0]])
    np.testing.assert_allclose(steady_friction_nm(bare(), v), COULOMB * np.sign(v) + VISCOUS * v)


def test_effects_can_be_exchanged() -> None:
    model = bare().with_effects({"stribeck": {"share": 0.3}})
    assert model.effects["stribeck"]["share"] == 0.3
    assert set(model.effects["stribeck"]) == {p.name for p in all_effects()["stribeck"].parameters}
    assert model.with_effects({}) == bare()
    with pytest.raises(InvalidFields, match=r"effects\.magic: is no known effect; known are backlash"):
        model.with_effects({"magic": {}})


def test_every_mistake_is_found_at_once_with_its_path() -> None:
    wrong = copy.deepcopy(FULL)
    wrong["inertia_kg_m2"] = -1
    wrong["motor_inertia_share"] = "half"
    wrong["colour"] = "red"
    wrong["encoder"]["side"] = "left"
    wrong["drive"]["torque_noise_per_mille"] = math.nan
    wrong["payload"] = {"inertia_kg_m2": 1.0}
    wrong["servo"]["torque_limit_nm"] = 61.0
    wrong["effects"] = {"stribeck": {"share": 99, "speed": 1}, "magic": {}, "torque_bias": 3}
    found = problems(wrong)
    assert "at least 1e-06" in found["inertia_kg_m2",] or "from 1e-06" in found["inertia_kg_m2",]
    assert "expected a number, found 'half'" in found["motor_inertia_share",]
    assert "unknown" in found["colour",] and "inertia_kg_m2" in found["colour",]
    assert "motor, link" in found["encoder", "side"]
    assert "nan" in found["drive", "torque_noise_per_mille"]
    assert found["payload", "gravity_cos_nm"] == "is required"
    assert "61" in found["servo", "torque_limit_nm"]
    assert "from -0.5 to 2" in found["effects", "stribeck", "share"]
    assert "stribeck_velocity_rad_s" in found["effects", "stribeck", "speed"]
    assert "no known effect" in found["effects", "magic"]
    assert "expected a mapping" in found["effects", "torque_bias"]
    assert len(found) == 11


@pytest.mark.parametrize(
    ("friction", "path", "message"),
    [
        (None, ("friction",), "is required"),
        ({}, ("friction", "coulomb_nm"), "is required"),
        ({"coulomb_nm": True}, ("friction", "coulomb_nm"), "expected a number"),
        ({"velocity_rad_s": [1.0], "torque_nm": [1.0]}, ("friction", "velocity_rad_s"), "at least 2"),
        ({"velocity_rad_s": [1, 1], "torque_nm": [1, 2]}, ("friction", "velocity_rad_s"), "same mean velocity"),
        ({"velocity_rad_s": [], "torque_nm": [1, 2]}, ("friction", "velocity_rad_s"), "list of numbers"),
        ({"velocity_rad_s": "fast", "torque_nm": [1, 2]}, ("friction", "velocity_rad_s"), "list of numbers"),
        ({"coulomb_nm": 1, "velocity": 2}, ("friction", "velocity"), "unknown"),
    ],
)
def test_friction_that_makes_no_curve_is_explained(friction, path, message) -> None:
    found = problems({"inertia_kg_m2": 0.5, "friction": friction})
    assert message in found[path]


_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from([*FULL, *FULL["servo"], "x"]), inner),
    max_leaves=6,
)


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(st.dictionaries(st.sampled_from([*FULL, "x"]), _VALUES))
def test_whatever_a_file_says_is_a_joint_or_a_list_of_problems(changes) -> None:
    try:
        model = read({**FULL, **changes})
    except InvalidFields as error:
        assert error.problems
    else:
        assert read(model.to_mapping()) == model


@st.composite
def joints(draw) -> JointModel:
    """A joint whose every number lies anywhere within its bounds, with some effects."""
    names = draw(st.lists(st.sampled_from(sorted(all_effects())), max_size=6, unique=True))
    effects = {
        name: {p.name: draw(st.floats(p.lower, p.upper)) for p in all_effects()[name].parameters} for name in names
    }
    return bare(
        inertia_kg_m2=draw(st.floats(0.01, 10.0)),
        motor_inertia_share=draw(st.floats(0.02, 0.95)),
        friction={"coulomb_nm": draw(st.floats(0.0, 20.0)), "viscous_nm_s_per_rad": draw(st.floats(0.0, 10.0))},
        presliding_stiffness_nm_per_rad=draw(st.floats(10.0, 1e8)),
        encoder={"side": draw(st.sampled_from(["motor", "link"])), "counts_per_revolution": 65536},
        effects=effects,
    )


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(joints())
def test_no_joint_within_bounds_makes_nan(model: JointModel) -> None:
    time, command = excitation()
    rows = closed_loop(model, CONTROLLER, time[::4], command[::4])
    for column in (rows.position_rad, rows.velocity_rad_s, rows.torque_nm):
        assert np.isfinite(column).all()
    assert np.abs(rows.torque_nm).max() <= 60.0 + 1e-9
    assert np.isfinite(true_curve_nm(model, np.linspace(0, 3, 20))).all()
