"""A recording's set-points streamed to the simulated joint: measured beside simulated position and torque."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from frictid_hil.config.robot import Robot
from frictid_hil.files import write_whole
from frictid_hil.friction.metrics import plain_rms
from frictid_hil.friction.trajectory import Array
from frictid_hil.recording.samples import Samples

_CONTROL_PERIOD_S = 0.001


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedReplay:
    """One joint, measured (``samples``) and simulated without noise on the same rows, shape (n,).

    ``note`` is what a reader should know of the set-points.
    """

    samples: Samples
    position_rad: Array
    velocity_rad_s: Array
    torque_nm: Array
    note: str = ""

    @property
    def position_rms_rad(self) -> float:
        """Root of the mean square of measured minus simulated."""
        return plain_rms(self.samples.position_rad - self.position_rad)

    @property
    def torque_rms_nm(self) -> float | None:
        """The same of the torque; None for a recording without."""
        measured = self.samples.torque_nm
        return None if measured is None else plain_rms(measured - self.torque_nm)

    def write_csv(self, path: Path) -> Path:
        """Measured and simulated columns, for any tool."""
        columns = {"time_s": self.samples.time_s, **self.samples.columns()}
        columns |= {
            "simulated_position_rad": self.position_rad,
            "simulated_velocity_rad_s": self.velocity_rad_s,
            "simulated_torque_nm": self.torque_nm,
        }
        rows = np.column_stack(list(columns.values())).tolist()
        lines = [",".join(columns), *(",".join(f"{value:.9g}" for value in row) for row in rows)]
        write_whole(path, "\n".join(lines) + "\n")
        return path


def simulate(robot: Robot, samples: Samples) -> SimulatedReplay:
    """Stream a recording's set-points to the joint that the robot file describes under ``simulated``.

    The joint starts at rest, powered, where the recording starts; set-point k is in force from t_k on, and rows follow
    the timing of a live run (position at t_k, mean torque of what led to it).

    Raises:
        ConfigError: the ``simulated`` mapping is wrong, with its place.
    """
    from frictid_hil.simulation.joint import JointModel  # loads numba; a replay without simulation does not need it
    from frictid_hil.simulation.servo_loop import ServoLoop

    with robot.document.locating():
        model = JointModel.of(robot.file.joints[samples.joint], samples.joint)
    quiet = replace(model, drive=replace(model.drive, torque_noise_per_mille=0.0))
    command = samples.position_command_rad
    note = "" if command is not None else "no set-points in the recording: the measured positions are followed"
    targets = (samples.position_rad if command is None else command).tolist()
    loop = ServoLoop(quiet, period_s=_CONTROL_PERIOD_S, position_rad=float(samples.position_rad[0]))
    loop.power(True)
    loop.brake(False)
    steps_s = (np.diff(samples.time_ns) * 1e-9).tolist()
    position, velocity, torque = [loop.measured_position_rad], [0.0], [0.0]
    for step_s, target_rad in zip(steps_s, targets, strict=False):
        loop.advance(step_s, position_rad=target_rad)
        position.append(loop.measured_position_rad)
        velocity.append(loop.velocity_rad_s)
        torque.append(loop.torque_nm)
    if len(torque) > 1:
        torque[0] = torque[1]
    return SimulatedReplay(samples, np.array(position), np.array(velocity), np.array(torque), note)
