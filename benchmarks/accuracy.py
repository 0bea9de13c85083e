"""Accuracy of the main job against withheld truth: the shipped robot, changed copies, and plants written differently.

    python benchmarks/accuracy.py [--quick] [--robots hp3j,hp3j-flexible-30,mujoco] [--amplitudes 20,50]

Each robot is calibrated whole, through bus, driver and scheduler; the truth is the simulated joints' own steady sliding
curve. The copies have every friction parameter changed by up to 30 % (seeded), or a flexible link. The MuJoCo joint is
another simulator altogether: its own contact solver and integrator, a position loop written here.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump
from frictid_hil.friction import trajectory
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.estimate import estimate
from frictid_hil.friction.metrics import curve_distance
from frictid_hil.friction.recording import CycleRecording, Skew
from frictid_hil.friction.trajectory import Array, Procedure
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.compare import true_curve
from frictid_hil.jobs.report import whole_profile
from frictid_hil.jobs.watch import Silent

DEG = math.pi / 180


def shipped() -> dict[str, Any]:
    return dict(load_robot("hp3j.yaml").document.data)


def scaled(values: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """Every friction parameter of every joint, changed by up to 30 % either way."""
    rng = np.random.default_rng(seed)

    def changed(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: changed(item) for key, item in value.items()}
        return value * rng.uniform(0.7, 1.3) if isinstance(value, float) else value

    robot = {**values, "name": f"hp3j-seed-{seed}", "joints": {}}
    for name, joint in values["joints"].items():
        simulated = dict(joint["simulated"])
        simulated["friction"] = changed(simulated["friction"])
        effects = dict(simulated["effects"])
        for effect in ("stribeck", "viscous_nonlinearity", "direction_asymmetry"):
            effects[effect] = changed(effects[effect])
        simulated["effects"] = effects
        stiffness = float(simulated["presliding_stiffness_nm_per_rad"])
        simulated["presliding_stiffness_nm_per_rad"] = stiffness * rng.uniform(0.7, 1.3)
        robot["joints"][name] = {**joint, "simulated": simulated}
    return robot


def flexible(values: Mapping[str, Any], resonance_hz: float) -> dict[str, Any]:
    """Every link on a spring: a two-mass joint."""
    robot = {**values, "name": f"hp3j-flexible-{resonance_hz:g}", "joints": {}}
    for name, joint in values["joints"].items():
        simulated = dict(joint["simulated"])
        link = simulated["inertia_kg_m2"] * (1.0 - simulated["motor_inertia_share"])
        stiffness = link * (2 * math.pi * resonance_hz) ** 2
        elastic = {"compliance_rad_per_nm": 1.0 / stiffness, "relaxation_s": 3e-4}
        simulated["effects"] = {**simulated["effects"], "joint_elasticity": elastic}
        robot["joints"][name] = {**joint, "simulated": simulated}
    return robot


def errors_of(robot: Mapping[str, Any], amplitude_deg: float, folder: Path) -> dict[str, tuple[float, float, float]]:
    """Per joint: Function A over [0, V], aligned over [0, V], aligned over the measured range; percent of the mean."""
    path = folder / f"{robot['name']}.yaml"
    path.write_text(dump(robot))
    out = folder / f"{robot['name']}-{amplitude_deg:g}"
    bus = f"virtual:{robot['name']}-{amplitude_deg:g}"
    options = CalibrateOptions(str(path), bus=bus, amplitude_rad=amplitude_deg * DEG, out=out)
    result = calibrate(options, Silent()).to_json()
    loaded, profile = load_robot(path), whole_profile(Path(result["run"]))
    found = {}
    for name, joint in profile.joints.items():
        assert joint.procedure is not None and joint.published is not None
        velocity = joint.procedure.velocity_rad_s
        truth = true_curve(loaded, name, velocity)
        published = FrictionCurve.through(np.array(joint.published.velocity_rad_s), np.array(joint.published.torque_nm))
        function_a = curve_distance(published, truth, velocity)
        aligned = curve_distance(joint.curve(), truth, velocity)
        found[name] = (function_a.e_percent, aligned.e_percent, aligned.e_percent_measured_range)
    return found


class MujocoJoint:
    """A joint simulated by MuJoCo: dry friction, damping, gravity; 10 kHz, logged at 1 kHz; a position loop of its own.

    Args:
        seed: of the noise on the reported torque.
    """

    DRY_NM, VISCOUS_NM_S_PER_RAD = 6.0, 3.0

    def __init__(self, seed: int = 1) -> None:
        import mujoco

        inertia, weight = 0.8, 12.0
        self._step = mujoco.mj_step
        self._weight_nm = weight
        self._model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><option timestep="0.0001" integrator="implicitfast" gravity="0 0 -9.81"/>
            <worldbody><body><joint name="j" axis="0 -1 0" armature="{inertia * 0.5}" solreffriction="0.0005 1"
            damping="{self.VISCOUS_NM_S_PER_RAD}" frictionloss="{self.DRY_NM}"/>
            <inertial pos="0.4 0 0" mass="{weight / 9.81 / 0.4}" diaginertia="0.05 0.05 0.05"/>
            </body></worldbody></mujoco>"""
        )
        self._data = mujoco.MjData(self._model)
        self._rng = np.random.default_rng(seed)

    def driven(self, command: Array) -> tuple[Array, Array]:
        """Position and torque, a row per millisecond; the torque of a row acted during the step before it."""
        data, rate = self._data, np.gradient(command, 1e-3)
        quantum = 2 * math.pi / 131072 / 100
        rows = np.empty((command.size, 2))
        data.qpos[0] = command[0]
        torque = integral = self._weight_nm
        for k in range(command.size):
            measured = round(float(data.qpos[0]) / quantum) * quantum
            rows[k] = measured, torque + self._rng.normal(0.0, 0.2)
            error = command[k] - measured
            integral += 160e3 * 1e-3 * error
            torque = 8000.0 * error + 130.0 * (rate[k] - float(data.qvel[0])) + integral
            data.qfrc_applied[0] = torque
            for _ in range(10):
                self._step(self._model, data)
        return rows[:, 0], rows[:, 1]


def mujoco_errors(amplitude_deg: float) -> tuple[float, float, float]:
    """The same figures for a joint simulated by MuJoCo."""
    procedure = Procedure(amplitude_deg * DEG, 115 * DEG)
    times = np.arange(-0.5, procedure.duration_s + 0.5, 1e-3)
    command = trajectory.position(procedure, times)
    position, torque = MujocoJoint().driven(command)
    # The torque of row k acted during the step before it; half a step of zero-order hold.
    recording = CycleRecording(
        time_s=times,
        position_rad=position,
        torque_nm=torque,
        procedure=procedure,
        velocity_rad_s=np.gradient(position, 1e-3),
        command_rad=command,
        skew=Skew(torque_delay_s=0.0005),
    )
    speeds = np.linspace(0.0, procedure.velocity_rad_s, 2001)[1:]
    truth = FrictionCurve.through(speeds, MujocoJoint.DRY_NM + MujocoJoint.VISCOUS_NM_S_PER_RAD * speeds)
    published = curve_distance(estimate(recording, "function-a").curve, truth, procedure.velocity_rad_s)
    aligned = curve_distance(estimate(recording, "aligned").curve, truth, procedure.velocity_rad_s)
    return published.e_percent, aligned.e_percent, aligned.e_percent_measured_range


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--quick", action="store_true", help="one changed copy instead of three")
    arguments.add_argument("--robots", default="", help="only these, by name")
    arguments.add_argument("--amplitudes", default="20,50", help="only these, deg")
    options = arguments.parse_args()
    quick = options.quick
    base = shipped()
    robots = [(base, 20.0), (base, 50.0)]
    for seed in (1,) if quick else (1, 2, 3):
        robots += [(scaled(base, seed), 20.0), (scaled(base, seed), 50.0)]
    robots.append((flexible(base, 30.0), 20.0))
    wanted, amplitudes = options.robots.split(","), [float(value) for value in options.amplitudes.split(",")]
    robots = [pair for pair in robots if pair[1] in amplitudes and (wanted == [""] or pair[0]["name"] in wanted)]
    print("error to truth, percent of the curve's mean: Function A [0, V] / aligned [0, V] / aligned [V_1, V_N]\n")
    print(f"| {'robot':<22} | A | " + " | ".join(f"joint {j}" for j in base["joints"]) + " |")
    print("|---|---|" + "---|" * len(base["joints"]))
    with tempfile.TemporaryDirectory() as temporary:
        for robot, amplitude in robots:
            found = errors_of(robot, amplitude, Path(temporary))
            cells = " | ".join("{:.2f} / {:.2f} / {:.2f}".format(*found[j]) for j in base["joints"] if j in found)
            print(f"| {robot['name']:<22} | {amplitude:g} | {cells} |", flush=True)
    for amplitude in amplitudes if wanted == [""] or "mujoco" in wanted else ():
        print(f"\nMuJoCo joint, A = {amplitude:g} deg: " + " / ".join(f"{e:.2f}" for e in mujoco_errors(amplitude)))


if __name__ == "__main__":
    main()
