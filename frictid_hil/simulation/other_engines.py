"""Other engines that read MuJoCo's models or a USD stage, where they are installed; all on the processor.

The first use of an engine compiles it, which takes a minute or two; after that it is kept.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.model_replay import Stepper


class _InWarp:
    def __init__(self, model: Any, data: Any) -> None:
        warp, self._engine = importlib.import_module("warp"), importlib.import_module("mujoco_warp")
        warp.config.quiet = True
        self._device = warp.ScopedDevice("cpu")
        with self._device:
            self._model, self._data = self._engine.put_model(model), self._engine.put_data(model, data)

    def step(self, control: Array) -> Array:
        with self._device:
            self._data.ctrl.assign(control.astype(np.float32)[None])
            self._engine.step(self._model, self._data)
            return np.asarray(self._data.actuator_force.numpy()[0], dtype=np.float64)

    def position(self) -> Array:
        return np.asarray(self._data.qpos.numpy()[0], dtype=np.float64)


class _InMjx:
    def __init__(self, model: Any, data: Any) -> None:
        mjx = importlib.import_module("mujoco.mjx")
        self._model = mjx.put_model(model)
        self._data, self._step = mjx.put_data(model, data), importlib.import_module("jax").jit(mjx.step)

    def step(self, control: Array) -> Array:
        self._data = self._step(self._model, self._data.replace(ctrl=control))
        return np.asarray(self._data.actuator_force, dtype=np.float64)

    def position(self) -> Array:
        return np.asarray(self._data.qpos, dtype=np.float64)


def installed() -> dict[str, Callable[[Any, Any], Stepper]]:
    """Engines that can step a compiled model here, by name and version."""
    known = (("mujoco_warp", "mujoco-warp", _InWarp), ("mujoco.mjx", "mujoco-mjx", _InMjx))
    return {_named(package): engine for module, package, engine in known if _there(module)}


def newton() -> str | None:
    """Newton's name and version where its importer is installed."""
    return _named("newton") if _there("newton") and _there("pxr") and _there("newton_usd_schemas") else None


def _there(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def _named(package: str) -> str:
    return f"{package} {metadata.version(package)}"


def in_newton(
    stage: Path, joints: Sequence[str], step_s: float, time_s: Array, start_rad: Array, command_rad: Array
) -> Array:
    """Torque of the drives of a stage's joints along commands, in Newton's MuJoCo solver, (n, k).

    Every joint of the stage has a position drive; ``joints`` are names of k prims. The solver's step is ``step_s`` at
    most; time has the shape (n,), the start (k,), commands (n, k). Raises what Newton raises of a stage.
    """
    engine = importlib.import_module("newton")
    importlib.import_module("warp").config.quiet = True
    builder = engine.ModelBuilder()
    engine.solvers.SolverMuJoCo.register_custom_attributes(builder)
    builder.add_usd(str(stage))
    model = builder.finalize(device="cpu")
    solver = engine.solvers.SolverMuJoCo(model, use_mujoco_cpu=True, disable_contacts=True, integrator="euler")
    numbers = [[label.rpartition("/")[2] for label in model.joint_label].index(name) for name in joints]
    dofs, places = model.joint_qd_start.numpy()[numbers], model.joint_q_start.numpy()[numbers]
    gain, rate = model.joint_target_ke.numpy()[dofs], model.joint_target_kd.numpy()[dofs]
    limit = model.joint_effort_limit.numpy()[dofs]
    state, following, control = model.state(), model.state(), model.control()
    beginning = state.joint_q.numpy()
    beginning[places] = start_rad
    state.joint_q.assign(beginning)
    torque, target = np.zeros_like(command_rad), control.joint_target_q.numpy()
    for row, row_s in enumerate(np.diff(time_s)):
        target[places] = command_rad[row]
        control.joint_target_q.assign(target)
        steps = max(1, round(row_s / step_s))
        for _ in range(steps):
            q, v = state.joint_q.numpy()[places], state.joint_qd.numpy()[dofs]
            torque[row + 1] += np.clip(gain * (command_rad[row] - q) - rate * v, -limit, limit) / steps
            state.clear_forces()
            solver.step(state, following, control, None, row_s / steps)
            state, following = following, state
    return torque
