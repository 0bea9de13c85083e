"""A joint exported to MuJoCo moves there as in the simulation it was exported from."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from frictid_hil.errors import UsageError
from frictid_hil.jobs.gap.export_mujoco import export_mujoco
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.mjcf import MujocoJoint, described
from frictid_hil.simulation.replay import Controller, closed_loop
from frictid_hil.simulation.robot_model import relax

mujoco = pytest.importorskip("mujoco")

STEP_S = 0.002
LOOP = Controller(500.0, 320.0, 18.0, 1.0 / STEP_S, 0.003, 36.0)
BARE = JointModel.from_mapping(
    {
        "inertia_kg_m2": 0.4,
        "motor_inertia_share": 0.25,
        "gravity_cos_nm": 4.0,
        "gravity_sin_nm": -1.0,
        "friction": {"velocity_rad_s": [0.2, 0.8, 1.8], "torque_nm": [3.2, 3.7, 4.5]},
        "presliding_stiffness_nm_per_rad": 20000.0,
        "encoder": {"counts_per_revolution": 131072},
    },
    gear_ratio=100.0,
    rated_torque_nm=12.0,
    max_torque_nm=36.0,
)
SIZES = {
    "backlash": {"gap_rad": 2e-3},
    "direction_asymmetry": {"coulomb_share": 0.2, "viscous_share": 0.2},
    "directional_efficiency": {"driving_share": 0.3, "backdriving_share": 0.1},
    "electrical_lag": {"time_constant_s": 4e-3},
    "encoder_offset": {"offset_rad": 0.06},
    "encoder_quantisation": {"step_rad": 1e-4},
    "friction_level_error": {"error_share": 0.2},
    "gravity_error": {"error_share": 0.2},
    "inertia_error": {"error_share": 0.4},
    "joint_elasticity": {"compliance_rad_per_nm": 6e-4, "relaxation_s": 1e-3},
    "load_dependent_friction": {"linear_share": 0.2},
    "presliding_hysteresis": {"share": 0.3, "distance_rad": 0.01},
    "stiction_breakaway": {"share": 0.5, "dwell_time_s": 0.3},
    "stribeck": {"share": 0.3, "stribeck_velocity_rad_s": 0.06},
    "temperature_drift": {"coulomb_share": 0.3, "viscous_share": 0.3, "power_w": 1.0, "time_constant_s": 5.0},
    "torque_bias": {"bias_nm": 0.6},
    "torque_constant_error": {"error_share": 0.1},
    "torque_delay": {"delay_s": 3e-3},
    "torque_ripple": {"amplitude_nm": 0.4, "phase_rad": 0.7},
    "torque_saturation": {"limit_share": 0.2},
    "transmission_error": {"amplitude_rad": 1e-4, "phase_rad": 0.7},
    "velocity_lag": {"time_constant_s": 6e-3},
    "viscous_error": {"error_share": 0.3},
    "viscous_nonlinearity": {"share": 0.3, "knee_rad_s": 0.3, "bend": 2.0},
}
LOOSE = {"encoder_quantisation": 0.03}
"""Steps through a derivative make small differences large; all others agree within 0.3 %."""


@pytest.fixture(autouse=True)
def _no_callback_stays() -> Iterator[None]:
    yield
    mujoco.set_mjcb_control(None)


def command() -> np.ndarray:
    time_s = np.arange(0.0, 1.6, STEP_S)
    return -0.4 + 0.2 * (1.0 - np.cos(2.0 * math.pi * 0.8 * np.maximum(time_s - 0.2, 0.0)))


def in_mujoco(joint: JointModel, target: np.ndarray, *, callback: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """(position, torque) under the same digital controller as ``closed_loop``'s."""
    model = mujoco.MjModel.from_xml_string(described(joint, "joint").xml)
    data = mujoco.MjData(model)
    own = MujocoJoint(joint)
    integral = own.install(mujoco, model, data, position_rad=float(target[0]))
    if not callback:
        # The model's own friction and actuator again; the joint's place stays.
        mujoco.set_mjcb_control(None)
        model = mujoco.MjModel.from_xml_string(described(joint, "joint").xml)
        data.qfrc_applied[:] = 0.0
        relax(model, data)
    rate, share = np.gradient(target, STEP_S), 1.0 - math.exp(-STEP_S / LOOP.velocity_filter_s)
    last, velocity = own.reading_rad(data), 0.0
    positions, torques = [], [integral]
    for wanted, speed in zip(target, rate, strict=True):
        reading = own.reading_rad(data)
        velocity += share * ((reading - last) / STEP_S - velocity)
        last = reading
        demand = LOOP.kp_nm_per_rad * (wanted - reading) + integral + LOOP.kd_nm_s_per_rad * (speed - velocity)
        if abs(demand) > LOOP.torque_limit_nm:
            demand = math.copysign(LOOP.torque_limit_nm, demand)
        else:
            integral += LOOP.ki_nm_per_rad_s * (wanted - reading) * STEP_S
        data.ctrl[0] = demand
        steps = round(STEP_S / model.opt.timestep)
        given = 0.0
        for _ in range(steps):
            mujoco.mj_step(model, data)
            given += own.torque_nm if callback else demand
        positions.append(reading)
        torques.append(given / steps)
    return np.array(positions), np.array(torques[:-1])


def off_by(ours: np.ndarray, theirs: np.ndarray) -> float:
    return float(np.sqrt(np.mean((ours - theirs) ** 2) / np.mean(ours**2)))


def test_sizes_are_given_for_every_effect() -> None:
    assert set(SIZES) == set(all_effects()) - {"controller_gain_error"}  # of the loop, not of the joint
    told = described(BARE.with_effects({"controller_gain_error": {"kp_error_share": 0.1}}), "joint").lost
    assert any("change its gains" in line for line in told)


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["", *sorted(SIZES)])
def test_the_exported_joint_moves_as_in_our_own_simulator(effect: str) -> None:
    joint = BARE.with_effects({effect: SIZES[effect]} if effect else {})
    target = command()
    time_s = STEP_S * np.arange(target.size)
    ours = closed_loop(joint, LOOP, time_s, target)
    position, torque = in_mujoco(joint, target)
    assert off_by(ours.torque_nm, torque) < LOOSE.get(effect, 0.003)
    assert np.max(np.abs(ours.position_rad - position)) < 2e-4
    if effect == "encoder_quantisation":
        steps = position / SIZES[effect]["step_rad"]
        assert np.max(np.abs(steps - np.round(steps))) < 1e-6
    elif effect not in ("", "velocity_lag"):
        # The effect is seen at all: the bare joint is further off.
        bare = closed_loop(BARE, LOOP, time_s, target)
        assert off_by(ours.torque_nm, bare.torque_nm) > 1.5 * off_by(ours.torque_nm, torque)


@pytest.mark.parametrize(
    "effect",
    [
        "gravity_error",
        "inertia_error",
        "torque_bias",
        "torque_constant_error",
        "joint_elasticity",
        "stribeck",
        "friction_level_error",
        "viscous_nonlinearity",
        "torque_ripple",
        "presliding_hysteresis",
        "direction_asymmetry",
    ],
)
def test_what_mjcf_has_parameters_for_needs_no_callback(effect: str) -> None:
    """Model alone, in its own elements."""
    target = command()
    time_s = STEP_S * np.arange(target.size)
    joint = BARE.with_effects({effect: SIZES[effect]})
    ours = closed_loop(joint, LOOP, time_s, target).torque_nm
    _, torque = in_mujoco(joint, target, callback=False)
    assert off_by(ours, torque) < 0.02
    exported = described(joint, "joint")
    assert effect in exported.native or "the model alone" in exported.callback[effect]
    assert exported.xml != described(BARE, "joint").xml


def test_every_effect_is_accounted_for_and_its_loss_told() -> None:
    exported = described(BARE.with_effects(SIZES), "joint")
    for effect in SIZES:
        assert (effect in exported.native) != (effect in exported.callback)
        told = any(line.startswith(effect) for line in exported.lost)
        alone = "the model alone" in exported.callback.get(effect, "")
        assert told or alone or effect in exported.native or effect in ("encoder_offset", "encoder_quantisation")


def test_the_files_load_and_run_as_they_say(tmp_path: Path) -> None:
    joint = BARE.with_effects({"direction_asymmetry": SIZES["direction_asymmetry"]})
    told = export_mujoco(tmp_path / "joint.xml", "joint", joint)
    assert "direction_asymmetry" in told["in_callback"] and told["lost"]
    spec = importlib.util.spec_from_file_location("exported_joint", told["callback_script"])
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    assert joint == script.JOINT
    model, data, own, holding_nm = script.simulation(0.3)
    assert holding_nm == pytest.approx(4.0 * math.cos(0.3) - math.sin(0.3), rel=1e-6)
    while data.time < 0.2:
        mujoco.mj_step(model, data)
    assert own.reading_rad(data) == pytest.approx(0.3, abs=1e-4), "friction and torque hold it"
    with pytest.raises(UsageError, match="callback"):
        export_mujoco(tmp_path / "joint.py", "joint", joint)
