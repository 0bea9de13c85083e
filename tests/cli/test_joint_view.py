"""The rows a person watches: what they say of made-up samples, and of a whole run."""

from __future__ import annotations

import io
import math
import re
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from frictid_hil.cli import progress
from frictid_hil.cli.joint_view import JointView, Lateness, figures_of, torque_bar
from frictid_hil.cli.output import Output
from frictid_hil.cli.progress import TerminalWatcher
from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.runner.ring import SAMPLE_ROW, Rows

PERIOD_S = 0.001


def terminal() -> Console:
    environ = {"TERM": "xterm"}  # also where the tests themselves run on a dumb one
    return Console(
        file=io.StringIO(), force_terminal=True, width=160, legacy_windows=False, color_system=None, _environ=environ
    )


def shown(console: Console) -> str:
    assert isinstance(console.file, io.StringIO)
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", console.file.getvalue())


def rows_of(joint: int, count: int = 4, start_ns: int = 0, **columns: float) -> Rows:
    rows = np.zeros(count, dtype=SAMPLE_ROW)
    rows["joint"] = joint
    rows["t_ns"] = start_ns + np.arange(count) * 1_000_000
    for name, value in columns.items():
        rows[name] = value
    return rows


def test_figures_are_the_worst_of_the_rows_and_blank_where_nothing_was_measured() -> None:
    rows = rows_of(0, position_command_rad=1.0, position_rad=1.0, torque_nm=-5.0, temperature_c=36.54)
    rows["position_rad"][1] -= math.radians(0.25)
    rows["torque_nm"][2] = math.nan
    figures = figures_of(rows, max_torque_nm=10.0)
    assert figures["error"] == "0.250 deg"
    assert figures["torque"] == "█████·····   5.0 N m"
    assert figures["temperature"] == "36.5 C"
    rows["temperature_c"] = rows["torque_nm"] = rows["position_command_rad"] = math.nan
    assert figures_of(rows, 10.0) == {"error": "", "torque": "", "temperature": ""}


@pytest.mark.parametrize(("torque_nm", "cells"), [(0.0, 0), (10.0, 10), (25.0, 10)])
def test_the_bar_is_full_at_the_limit(torque_nm: float, cells: int) -> None:
    assert torque_bar(torque_nm, 10.0).count("█") == cells


def test_lateness_counts_over_the_borders_of_blocks_but_not_over_pauses() -> None:
    late = Lateness(PERIOD_S)
    times = np.array([0, 1, 2, 4, 5, 8], dtype=np.int64) * 1_000_000
    assert late.take(times[:3]) == 0
    assert late.take(times[3:]) == 2
    late.pause()
    assert late.take(times + 10**9) == 4


def test_every_joint_has_its_row_also_where_several_move_together() -> None:
    console, setup = terminal(), load_robot("hp3j").to_setup()
    view = JointView(console, setup, PERIOD_S, {"0, 1": 10.0, "5": 4.0}, {"0, 1": ["0", "1"], "5": ["5"]})
    view.phase("0, 1", "cycles", 0.0)
    limit_nm = setup.joint("1").max_torque_nm
    both = np.concatenate([rows_of(0, torque_nm=1.0), rows_of(1, torque_nm=limit_nm, temperature_c=41.0)])
    view.rows(both, 5.0)
    view.done("0", 3)
    view.close()
    last = shown(console).splitlines()[-3:]
    assert re.search(r"joint 0 .* done .* 3 late +0:00:00", last[0]), last
    assert re.search(r"joint 1 .* cycles +0\.000 deg █{10} +[\d.]+ N m +41\.0 C +0 late", last[1]), last
    assert re.search(r"joint 5 .* waiting .* -:--:--", last[2]), last


@pytest.mark.slow
def test_a_whole_run_on_a_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("frictid_hil.cli.joint_view._REDRAW_S", 0.0)
    console = terminal()
    monkeypatch.setattr(Output, "err", property(lambda _: console))
    values = load_robot("hp3j").values()
    values |= {"name": "watched", "bus": "virtual:watched", "joints": {one: values["joints"][one] for one in "45"}}
    values["procedure"] |= {"amplitude_rad": 0.2, "velocity_rad_s": 1.5, "cycles": 2}
    robot = tmp_path / "watched.yaml"
    robot.write_text(dump(values))
    with progress.watching(Output(), yes=True, live=False, live_at=None) as watcher:
        assert isinstance(watcher, TerminalWatcher)
        calibrate(CalibrateOptions(str(robot), out=tmp_path / "run"), watcher)
    text = shown(console)
    assert re.search(r"joint 4 .* cycles +0\.\d{3} deg [█·]{10} +\d+\.\d N m", text), "error and torque while it moves"
    assert re.search(r"joint 5 .* cycles .*0 late +0:00:\d\d", text), "what is left of its time"
    assert re.search(r"joint 4 .* done .* 0 late +0:00:00\s+joint 5 .* done .* 0 late +0:00:00\s*$", text)
