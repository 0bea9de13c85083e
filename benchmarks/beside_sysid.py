"""Side by side with ``mujoco.sysid`` on the same logs: friction level and viscosity of six joints, 12 numbers.

Run: pip install 'mujoco[sysid]'; python benchmarks/beside_sysid.py [--seconds 10] [--iterations 20]

The machine has more dry friction on the lift and more viscosity on the first wrist. ``mujoco.sysid`` is given the right
twelve numbers to fit and bounds around them; the diagnosis is given the model and the logs. Both answers are run in
MuJoCo along the log that neither was fitted to.
"""

from __future__ import annotations

import argparse
import importlib
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from arm_in_mujoco import JOINTS, STEP_S, Machine, write_case

from frictid_hil.jobs.gap.closed_loop import gap_of
from frictid_hil.jobs.gap.from_model import ArmSet, ModelLogs, Motion, sets_from_model
from frictid_hil.jobs.gap.write_model import exports, natives, nearer_only
from frictid_hil.jobs.gap_diagnose import diagnosed
from frictid_hil.simulation.model_edit import compiled_with
from frictid_hil.simulation.robot_model import relax

mujoco: Any = importlib.import_module("mujoco")
sysid: Any = importlib.import_module("mujoco.sysid")
LATEST_S = 0.005
"""Largest delay of positions and of torques that ``mujoco.sysid`` may find beside the twelve numbers."""
MACHINE = Machine(friction={"lift": 1.4}, viscous={"wrist_1": 1.8})


def spec_of(path: Path) -> Any:
    """The user's file with a sensor of position and of torque on every joint."""
    spec = mujoco.MjSpec.from_file(str(path))
    for name in JOINTS:
        kinds = (("q", mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtObj.mjOBJ_JOINT),
                 ("tau", mujoco.mjtSensor.mjSENS_ACTUATORFRC, mujoco.mjtObj.mjOBJ_ACTUATOR))  # fmt: skip
        for what, kind, on in kinds:
            spec.add_sensor(name=f"{what}_{name}", type=kind, objtype=on, objname=name)
    return spec


def parameters(spec: Any) -> Any:
    """Level and viscosity of each joint, from 0.3 to 3 times what the file says."""
    told = sysid.ParameterDict()
    for name in JOINTS:
        joint = spec.joint(name)
        usual = {"springyield": float(joint.springyield), "damping": float(np.atleast_1d(joint.damping)[0])}
        for what, value in usual.items():
            told.add(sysid.Parameter(f"{what} {name}", value, 0.3 * value, 3.0 * value, modifier=_set(name, what)))
    return told


def _set(name: str, what: str) -> Any:
    def modify(spec: Any, parameter: Any) -> None:
        value = float(parameter.value[0])
        joint = spec.joint(name)
        setattr(joint, what, [value, *np.atleast_1d(joint.damping)[1:]] if what == "damping" else value)

    return modify


def measured(spec: Any, motion: Motion) -> tuple[Any, Any, Any]:
    """(initial state, control, sensors) of a recording, as near to what MuJoCo steps as the log allows.

    A command is held until the next row, and a torque is the mean since the row before, so it is brought to its row.
    """
    model = spec.compile()
    samples = motion.samples
    command = np.stack([np.array(samples[name].position_command_rad) for name in JOINTS], axis=1)
    columns = []
    for name in JOINTS:
        torque = np.array(samples[name].torque_nm)
        torque[:-1] = 0.5 * (torque[:-1] + torque[1:])
        columns += [samples[name].position_rad, torque]
    time_s = motion.time_s - motion.time_s[0]
    ticks = round(STEP_S / model.opt.timestep)
    fine_s = model.opt.timestep * np.arange(ticks * len(time_s))
    data = mujoco.MjData(model)
    data.qpos[:] = motion.position_rad[0]
    relax(model, data)  # springs that yield begin as they were carried there
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    start = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, start, kind)
    sensors = sysid.TimeSeries.from_names(time_s, np.stack(columns, axis=1), model)
    return start, sysid.TimeSeries(fine_s, np.repeat(command, ticks, axis=0)), sensors


def fitted_by_sysid(path: Path, motions: list[Motion], iterations: int) -> tuple[Any, Any]:
    """(their compiled model, their parameters)."""
    spec = spec_of(path)
    starts, controls, sensors = (list(c) for c in zip(*(measured(spec, m) for m in motions), strict=True))
    sequences = sysid.ModelSequences("arm", spec, [m.name for m in motions], starts, controls, sensors)
    told = parameters(spec)
    transform = sysid.SignalTransform()
    for what in ("q", "tau"):
        told.add(sysid.Parameter(f"delay {what}", 0.0, -LATEST_S, LATEST_S))
        transform.delay(f"{what}_*", told[f"delay {what}"])
    residual = sysid.build_residual_fn(models_sequences=[sequences], modify_residual=transform.apply)
    found, _ = sysid.optimize(told, residual, max_iters=iterations, verbose=False)
    best = mujoco.MjSpec.from_file(str(path))
    for parameter in found.parameters.values():
        parameter.apply_modifier(best)  # a delay changes no model
    return best.compile(), found


def told(name: str, arm: ArmSet, model: Any, seconds: float) -> None:
    torque, position = gap_of(arm, {}, [m for m in arm.motions if m.validation], model)
    figures = "  ".join(f"{j} {t:.3f}" for j, t in zip(JOINTS, torque, strict=True))
    print(
        f"{name:22s} {seconds:6.1f} s  torque N m: {figures}  position mrad: {1e3 * np.max(position):.3f}", flush=True
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--iterations", type=int, default=20)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        logs = write_case(folder, MACHINE, seed=5, seconds=arguments.seconds)
        begin = time.perf_counter()
        arm = sets_from_model(ModelLogs(folder / "arm.xml", logs, columns=str(folder / "columns.yaml")))
        told("the file as it was", arm, arm.robot.compiled, 0.0)
        found = diagnosed(arm, "processes:1")
        made, _ = nearer_only(arm, exports(arm, found))
        told("frictid-hil", arm, compiled_with(arm.robot, natives(made)),
             time.perf_counter() - begin)  # fmt: skip
        print("  named:", {n: [c.effect for c in d.causes] for n, d in found.items() if d.verdict != "none"})
        begin = time.perf_counter()
        fitted = [motion for motion in arm.motions if not motion.validation]
        model, theirs = fitted_by_sysid(folder / "arm.xml", fitted, arguments.iterations)
        told("mujoco.sysid", arm, model, time.perf_counter() - begin)
        moved = {n: float(p.value[0] / p.nominal[0]) for n, p in theirs.parameters.items() if p.nominal[0]}
        print("  true over file, by sysid:", {n: round(v, 3) for n, v in moved.items()})


if __name__ == "__main__":
    main()
