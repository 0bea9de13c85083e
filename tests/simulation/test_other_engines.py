"""A model goes over from MuJoCo to another engine in the middle of a motion; one that fails costs no export."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from frictid_hil.simulation.model_replay import replayed  # noqa: E402
from frictid_hil.simulation.robot_model import RobotModel  # noqa: E402

MODEL = """<mujoco><option timestep="0.002"/><worldbody><body><inertial pos="0.3 0 0" mass="1" diaginertia=".1 .1 .1"/>
  <joint name="lift" axis="0 1 0" damping="1"/></body></worldbody>
  <actuator><position joint="lift" kp="300" kv="20"/></actuator></mujoco>"""


class Halved:
    """MuJoCo once more, whose actuators tell half of what they give."""

    def __init__(self, model: Any, data: Any) -> None:
        self._model, self._data = model, data

    def step(self, control: np.ndarray) -> np.ndarray:
        self._data.ctrl[:] = control
        mujoco.mj_step(self._model, self._data)
        return 0.5 * self._data.actuator_force

    def position(self) -> np.ndarray:
        return np.asarray(self._data.qpos)


def test_another_engine_takes_over_where_it_is_told(tmp_path: Path) -> None:
    (tmp_path / "one.xml").write_text(MODEL)
    model = RobotModel.load(tmp_path / "one.xml").compiled
    time = 0.004 * np.arange(200)
    command = 0.4 * np.sin(6.0 * time)[:, None]
    usual = replayed(model, ["lift"], {}, time, command, command)
    other = replayed(model, ["lift"], {}, time, command, command, engine=Halved, begin=100)
    assert np.array_equal(other.position_rad, usual.position_rad)
    assert np.array_equal(other.torque_nm[:101], usual.torque_nm[:101])
    assert np.allclose(other.torque_nm[101:], 0.5 * usual.torque_nm[101:])
