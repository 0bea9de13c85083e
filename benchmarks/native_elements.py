"""How near MuJoCo's own elements come to each effect: torque of the edited model against our simulation.

Run: python benchmarks/native_elements.py [--joint small] [--effect stribeck] [--step 0.001]

Three joints (a servo, a wrist of 0.4 kg m2, a shoulder of 5 kg m2), three motions (sine, chirp, break-away), every
effect, every form of friction; RMS of the difference in percent of the torque's RMS.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.model_edit import compiled_with
from frictid_hil.simulation.native import FORMS, FRICTION, Use, native_elements
from frictid_hil.simulation.native_check import in_posture, torque_difference
from frictid_hil.simulation.robot_model import RobotModel

Array = NDArray[np.float64]

MODEL = """<mujoco model="one">
  <compiler angle="radian"/>
  <option timestep="{step}" integrator="{integrator}"/>
  <worldbody>
    <body>
      <inertial pos="{radius} 0 0" mass="{mass}" diaginertia="{own} {own} {own}"/>
      <joint name="joint" axis="0 -1 0" armature="{armature}" frictionloss="{dry}" damping="{viscous}"/>
    </body>
  </worldbody>
  <actuator>
    {actuator}
  </actuator>
</mujoco>
"""

# Inertia, the rotor's share, gravity, dry friction, curve over speed, presliding travel, fastest speed.
JOINTS: dict[str, dict[str, float]] = {
    "small": {"inertia": 0.05, "share": 0.5, "gravity": 1.0, "dry": 1.0, "bend": 0.45, "slow": 0.35, "turn": 1e-3},
    "wrist": {"inertia": 0.4, "share": 0.25, "gravity": 4.0, "dry": 3.0, "bend": 1.0, "slow": 0.5, "turn": 1.5e-4},
    "large": {"inertia": 5.0, "share": 0.2, "gravity": 60.0, "dry": 9.0, "bend": 6.0, "slow": 0.8, "turn": 3e-4},
}

SIZES: dict[str, dict[str, float]] = {
    "": {},
    "friction_level_error": {"error_share": 0.3},
    "viscous_error": {"error_share": 0.4},
    "stribeck": {"share": 0.3, "stribeck_velocity_rad_s": 0.08, "exponent": 1.0},
    "viscous_nonlinearity": {"share": 0.3, "knee_rad_s": 0.3, "bend": 2.0},
    "direction_asymmetry": {"coulomb_share": 0.2, "viscous_share": 0.0},
    "load_dependent_friction": {"linear_share": 0.1},
    "directional_efficiency": {"driving_share": 0.2, "backdriving_share": 0.1},
    "presliding_hysteresis": {"share": 0.3, "distance_rad": 0.005},
    "stiction_breakaway": {"share": 0.4, "dwell_time_s": 0.3},
    "temperature_drift": {"coulomb_share": 0.3, "viscous_share": 0.3, "power_w": 5.0, "time_constant_s": 60.0},
    "torque_bias": {"bias_nm": 0.4},
    "torque_ripple": {"amplitude_nm": 0.3, "phase_rad": 0.7, "cycles_per_motor_revolution": 2.0},
    "inertia_error": {"error_share": 0.4},
    "gravity_error": {"error_share": 0.2},
    "torque_constant_error": {"error_share": 0.1},
    "torque_saturation": {"limit_share": 0.3},
    "torque_delay": {"delay_s": 0.004},
    "encoder_offset": {"offset_rad": 0.05},
    "backlash": {"gap_rad": 2e-3},
    "joint_elasticity": {},
    "electrical_lag": {"time_constant_s": 4e-3},
}


def joint_named(name: str) -> JointModel:
    """The joint without effects."""
    j = JOINTS[name]
    speed = np.linspace(0.05, 2.5, 14)
    curve = j["dry"] + j["bend"] * np.arcsinh(speed / j["slow"])
    return JointModel.from_mapping(
        {
            "inertia_kg_m2": j["inertia"],
            "motor_inertia_share": j["share"],
            "gravity_cos_nm": j["gravity"],
            "friction": {"velocity_rad_s": speed.tolist(), "torque_nm": curve.tolist()},
            "presliding_stiffness_nm_per_rad": j["dry"] / j["turn"],
            "encoder": {"counts_per_revolution": 0},
            "drive": {"torque_quantum_per_mille": 0, "torque_noise_per_mille": 0, "velocity_filter_s": 0},
        },
        gear_ratio=20.0,
        rated_torque_nm=j["gravity"] + 3.0 * j["dry"],
        max_torque_nm=3.0 * (j["gravity"] + 3.0 * j["dry"]),
    )


def model_file(folder: Path, name: str, step_s: float, integrator: str = "Euler") -> Path:
    """The joint as its user has it."""
    j = JOINTS[name]
    radius = 0.5 * (1.0 - j["share"]) * j["inertia"] * 9.81 / j["gravity"]
    mass = j["gravity"] / (9.81 * radius)
    text = MODEL.format(
        step=step_s,
        integrator=integrator,
        radius=radius,
        mass=mass,
        own=(1.0 - j["share"]) * j["inertia"] - mass * radius**2,
        armature=j["share"] * j["inertia"],
        dry=j["dry"],
        viscous=j["bend"],
        actuator='<motor name="drive" joint="joint"/>',
    )
    path = folder / f"{name}.xml"
    path.write_text(text)
    return path


def sizes(name: str, effect: str) -> dict[str, dict[str, float]]:
    """The effect on a joint; links ring at the same frequencies whatever their size."""
    if not effect:
        return {}
    values = dict(SIZES[effect])
    link = JOINTS[name]["inertia"] * (1.0 - JOINTS[name]["share"])
    if effect == "joint_elasticity":
        values = {"compliance_rad_per_nm": 1.0 / (link * (2.0 * math.pi * 20.0) ** 2), "relaxation_s": 2e-3}
    if effect == "backlash":
        values |= {"contact_stiffness_nm_per_rad": link * (2.0 * math.pi * 35.0) ** 2, "contact_relaxation_s": 2e-3}
    return {effect: values}


def motions() -> dict[str, tuple[Array, Array]]:
    """Time and command by name: one sine, a chirp, creeping off after rests."""
    time = np.arange(0.0, 6.0, 1e-3)
    late = np.maximum(time - 0.5, 0.0)
    sine = 0.5 * (1.0 - np.cos(2.0 * math.pi * 0.5 * late))
    chirp = 0.12 * np.sin(2.0 * math.pi * (0.3 * late + 0.3 * late**2)) / (1.0 + 0.5 * late)
    speed = np.where((late % 1.5 > 0.5) & (late > 0.0), 0.02 * np.where(late > 3.0, -1.0, 1.0), 0.0)
    creep = np.cumsum(speed) * 1e-3
    return {"sine": (time, sine), "chirp": (time, chirp), "break-away": (time, creep)}


def measured(
    name: str, effect: str, step_s: float, integrator: str = "Euler"
) -> Iterator[tuple[str, str, float, Mapping[str, str]]]:
    """(form of friction, motion, difference, where the effects went)."""
    with tempfile.TemporaryDirectory() as folder:
        robot = RobotModel.load(model_file(Path(folder), name, step_s, integrator))
        model = joint_named(name).with_effects(sizes(name, effect))
        speeds = np.linspace(0.01, 1.6, 200)
        use = Use(speeds, JOINTS[name]["gravity"] * np.cos(np.linspace(0.0, 1.0, 50)), step_s)
        posture = robot.posture({})
        ours = in_posture(robot, "joint", model, posture)
        for form in FORMS if not effect or effect in FRICTION else FORMS[:1]:
            native = native_elements(robot.joint("joint"), model, use, form, friction=True)
            exported = compiled_with(robot, {"joint": native})
            for motion, (time, command) in motions().items():
                yield (
                    form,
                    motion,
                    torque_difference(robot, exported, "joint", ours, posture, time, command),
                    native.placed,
                )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--joint", choices=tuple(JOINTS), action="append")
    parser.add_argument("--effect", choices=tuple(SIZES), action="append")
    parser.add_argument("--step", type=float, default=0.001)
    parser.add_argument("--integrator", default="Euler")
    arguments = parser.parse_args()
    for effect in arguments.effect or SIZES:
        for name in arguments.joint or JOINTS:
            found: dict[str, list[str]] = {}
            for form, motion, off, _ in measured(name, effect, arguments.step, arguments.integrator):
                found.setdefault(form, []).append(f"{motion} {100.0 * off:.2f}")
            told = "; ".join(f"{form}: {', '.join(figures)}" for form, figures in found.items())
            print(f"{effect or 'friction alone'} | {name} | {told}", flush=True)


if __name__ == "__main__":
    main()
