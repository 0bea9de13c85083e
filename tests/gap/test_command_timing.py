"""A command that is held, or sent late, between two rows of a log is brought to the time when it came into force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from frictid_hil.gap.command_timing import in_force
from frictid_hil.gap.experiment_set import Controller, Experiment, ExperimentSet, Nominal
from frictid_hil.gap.residuals import between, held

STEP_S = 0.002
LOOP = Controller(1000.0, 9000.0, 0.0, 420.0, command_rate_weight=0.0)


def recorded(late_rows: float, rate_hz: float = 1000.0, shaken_rad: float = 0.0) -> ExperimentSet:
    """A joint that trails its command by 40 ms under a stiff loop; its torque is the mean over the row before.

    What shakes it tells gains from lateness: of a joint that does nothing but trail, they make the same.
    """
    time = STEP_S * np.arange(3000)
    command = 0.5 * np.sin(3.0 * time) + 0.1 * np.sin(11.0 * time)

    def follows(at: np.ndarray) -> np.ndarray:
        shakes = shaken_rad * (np.sin(23.0 * at) + np.cos(37.0 * at))
        return 0.5 * np.sin(3.0 * (at - 0.04)) + 0.1 * np.sin(11.0 * (at - 0.04)) + shakes

    position, between = follows(time), follows(time - 0.5 * STEP_S)
    speed = np.gradient(between, STEP_S)
    sent = np.interp(time - (0.5 + late_rows) * STEP_S, time, command)
    torque = 9000.0 * (sent - between) - 420.0 * speed
    nominal = replace(Nominal(), controller=replace(LOOP, rate_hz=rate_hz))
    log = Experiment("log", False, False, 0, time, position, None, torque, command)
    return ExperimentSet("stiff", nominal, (log,))


@pytest.mark.parametrize("late", [0.0, 0.5, 0.9])
def test_a_command_comes_when_it_did(late: float) -> None:
    made = recorded(late)
    raw, found = made.experiments[0], in_force(made).experiments[0]
    assert raw.position_command_rad is not None and found.position_command_rad is not None
    moved = (1.0 - late) * raw.position_command_rad + late * held(raw.position_command_rad)
    # A tick's velocity is a quarter of a row old, which looks like a trace of lateness.
    assert np.max(np.abs(found.position_command_rad - moved)) < 0.1 * np.max(np.abs(np.diff(moved)))


@pytest.mark.parametrize("gain", ["kp_nm_per_rad", "kd_nm_s_per_rad"])
@pytest.mark.parametrize("late", [0.1, 0.5])
@pytest.mark.parametrize("times", [1.05, 1.4])
def test_a_wrong_gain_is_no_lateness(late: float, gain: str, times: float) -> None:
    made = recorded(late, shaken_rad=0.02)
    stated = replace(LOOP, rate_hz=1000.0, **{gain: times * getattr(LOOP, gain)})
    raw = made.experiments[0].position_command_rad
    found = in_force(replace(made, nominal=replace(made.nominal, controller=stated))).experiments[0]
    assert raw is not None and found.position_command_rad is not None
    moved = (1.0 - late) * raw + late * held(raw)
    # Wrong gains alone would make it a whole row.
    assert np.max(np.abs(found.position_command_rad - moved)) < 0.3 * np.max(np.abs(np.diff(moved)))


def test_a_log_that_holds_every_tick_stays_as_it_is() -> None:
    made = recorded(0.5, rate_hz=500.0)
    assert in_force(made) is made
    assert in_force(replace(made, nominal=replace(made.nominal, controller=None))).experiments is made.experiments


@pytest.mark.parametrize("ticks", [1, 2, 5])
def test_a_column_between_its_rows_is_smooth(ticks: int) -> None:
    time = STEP_S * np.arange(400)
    every = np.minimum(np.arange(400 * ticks) * STEP_S / ticks, time[-1])
    finer = between(np.sin(7.0 * time) + 0.2 * np.sin(40.0 * time), ticks)
    assert np.max(np.abs(finer - np.sin(7.0 * every) - 0.2 * np.sin(40.0 * every))) < 1e-5
