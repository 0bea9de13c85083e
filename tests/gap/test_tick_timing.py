"""When a controller's velocity is of, and which tick's torque a row holds: told from the torques."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import gap_sets
import numpy as np
import pytest

from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.tick_timing import NOW, OWN, as_it_ticks

LOGS = ("sines_small", "chirp", "moves_payload")


def _recorded(velocity: str | None, *, own: bool) -> ExperimentSet:
    """A healthy joint's set whose file says nothing of either."""
    assert gap_sets.NOMINAL.controller is not None
    loop = replace(gap_sets.NOMINAL.controller, velocity=velocity)
    made = gap_sets.make(nominal=replace(gap_sets.NOMINAL, controller=loop), only=LOGS)
    logs = made.experiments
    if own:
        logs = tuple(replace(e, torque_nm=np.roll(e.torque_nm, -1)) for e in logs if e.torque_nm is not None)
    return replace(made, nominal=gap_sets.NOMINAL, experiments=logs)


@pytest.mark.parametrize(
    ("velocity", "own", "words"),
    [(None, False, None), ("now", False, NOW), (None, True, OWN), ("now", True, f"{NOW}; {OWN}")],
)
def test_the_torques_tell_what_no_file_says(velocity: str | None, own: bool, words: str | None) -> None:
    told, why = as_it_ticks(_recorded(velocity, own=own))
    assert why == words
    assert told.nominal.controller is not None and told.nominal.controller.velocity == velocity


def test_a_stated_velocity_stays() -> None:
    made = _recorded("now", own=False)
    assert made.nominal.controller is not None
    stated = replace(made.nominal, controller=replace(made.nominal.controller, velocity="difference"))
    assert as_it_ticks(replace(made, nominal=stated))[1] is None


def test_a_late_drive_is_no_other_timing() -> None:
    late = gap_sets.make({"torque_delay": {"delay_s": 0.004}}, only=LOGS)
    assert as_it_ticks(late)[1] is None


def _pendulum(folder: Path, believed_nm: float) -> ExperimentSet:
    """A set of a plant of its own: a PID with the joint's own velocity on a pendulum with a bristle, Euler's method.

    Position, velocity and torque of a row are of the same moment, and noise is in the log alone.
    """
    step_s, rows, random = 0.002, 6000, np.random.default_rng(4)
    t = step_s * np.arange(rows)
    begin = np.clip(t - 0.5, 0.0, 1.0) ** 2 * (3.0 - 2.0 * np.clip(t - 0.5, 0.0, 1.0))
    commands = {
        "sines": 0.5 * np.sin(1.3 * t) + 0.25 * np.sin(3.3 * t),
        "chirp": 0.25 * np.sin(0.6 * t + 0.45 * t**2),
        "moves": 0.45 * np.sin(0.8 * t) + 0.3 * np.sin(2.6 * t),
    }
    listed = []
    for name, motion in commands.items():
        command = begin * motion
        rate, q, v, bristle, integral = np.gradient(command, step_s), 0.0, 0.0, 0.0, 6.0
        table = np.empty((rows, 4))
        for k in range(rows):
            integral += step_s * 1500.0 * (command[k] - q)
            torque = 400.0 * (command[k] - q) + integral + 25.0 * (rate[k] - v)
            table[k] = t[k], q, torque, command[k]
            for _ in range(10):
                bristle = (bristle + 2e-4 * v) / (1.0 + 2e-4 * 2500.0 / 1.2 * abs(v))
                v += 2e-4 * (torque - 2500.0 * bristle - 0.6 * v - 6.0 * math.cos(q)) / 0.25
                q += 2e-4 * v
        table[:, 1] += 2e-5 * random.standard_normal(rows)
        table[:, 2] += 0.03 * random.standard_normal(rows)
        header = "time_s,position_rad,torque_nm,position_command_rad"
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header=header, comments="")
        role = "validation" if name == "moves" else "identification"
        listed.append(f"- {{name: {name}, file: {name}.csv, role: {role}}}")
    (folder / "nominal.yaml").write_text(
        f"joint: {{inertia_kg_m2: 0.25, gravity_torque_nm: {believed_nm}, friction: {{coulomb_nm: 1.2, "
        "viscous_nm_s_per_rad: 0.6, presliding_stiffness_nm_per_rad: 2500, presliding_yields: gradually}}\n"
        "controller: {type: pid, rate_hz: 500, kp: 400.0, ki: 1500.0, kd: 25.0}\n"
        "experiments:\n" + "\n".join(listed) + "\n"
    )
    return ExperimentSet.load(folder)


@pytest.mark.slow
def test_a_simulator_written_elsewhere_is_none_where_it_is_right(tmp_path: Path) -> None:
    assert diagnose(_pendulum(tmp_path, 6.0)).verdict == "none"


@pytest.mark.slow
def test_a_simulator_written_elsewhere_is_told_its_gravity(tmp_path: Path) -> None:
    found = diagnose(_pendulum(tmp_path, 5.1))
    assert (found.verdict, found.causes[0].effect) == ("explained", "gravity_error")
    share = found.causes[0].parameters["error_share"]
    assert share.low is not None and share.high is not None and share.low <= 6.0 / 5.1 - 1.0 <= share.high
