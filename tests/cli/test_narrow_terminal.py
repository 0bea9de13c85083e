"""What is printed on a terminal of 80 columns is folded, and no name or number in it is cut."""

from __future__ import annotations

import io
import logging
import math
import re
from pathlib import Path

import numpy as np
import pytest
import typer
from called import run
from rich.console import Console

from frictid_hil.cli.joint_view import JointView
from frictid_hil.cli.output import Output
from frictid_hil.config.profile import Estimate, FrictionProfile, JointProfile
from frictid_hil.config.provenance import Provenance
from frictid_hil.config.robot import load_robot
from frictid_hil.profiles.store import ProfileStore
from frictid_hil.runner.ring import SAMPLE_ROW

NARROW = 80
SPEEDS = (0.123456, 1.234567)


def profile(day: int) -> FrictionProfile:
    joints = {
        name: JointProfile(
            method="aligned",
            velocity_rad_s=SPEEDS,
            torque_nm=(123.4 + day, 234.5),
            coulomb_nm=Estimate(value=111.25 + day, low=100.0, high=120.0),
            temperature_c=31.0,
        )
        for name in "012345"
    }
    return FrictionProfile(
        robot="hp3j", joints=joints, provenance=Provenance(created_utc=f"2026-03-{day:02d}T02:00:00Z")
    )


@pytest.fixture
def narrow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a profile and a store, in a terminal of 80 columns."""
    store = ProfileStore(tmp_path / "store")
    for day in (1, 2):
        store.promote("hp3j", store.add(profile(day)), by="test", reason="night")
    profile(3).save(tmp_path / "profile.yaml")

    def console(_: Output) -> Console:
        return Console(width=NARROW, highlight=False)

    monkeypatch.setattr(Output, "out", property(console))
    return tmp_path


@pytest.mark.parametrize(
    ("words", "whole"),
    [
        ("profile history hp3j --store store", ("112.2 N m", "113.2 N m", "31 degC")),
        ("profile show profile.yaml", ("7.074", "126.4", "234.5")),
        ("profile diff profile.yaml profile.yaml", ("+0.0", "0.00")),
        ("compare profile.yaml --truth hp3j.yaml", ("joint",)),
        ("check --robot hp3j.yaml --bus virtual:narrow", ("joint 5",)),
        ("calibrate --robot hp3j.yaml --dry-run", ("115.0 of 135", "213.1", "34.5 s")),
        ("calibrate --robot hp3j.yaml --together --dry-run", ("115.0 of 135",)),
    ],
)
def test_tables_fold_and_cut_nothing(words: str, whole: tuple[str, ...], narrow: Path) -> None:
    told = run(*words.split(), cwd=narrow)
    assert told.returncode == 0, told.stderr
    assert "…" not in told.stdout
    assert max(len(line) for line in told.stdout.splitlines() if re.match(r"[│┃┏└]", line)) <= NARROW
    assert all(number in told.stdout for number in whole)


def test_the_time_left_is_whole_beside_a_long_name() -> None:
    setup = load_robot("hp3j").to_setup()
    drawn = io.StringIO()
    console = Console(file=drawn, force_terminal=True, width=NARROW, color_system=None, _environ={"TERM": "xterm"})
    view = JointView(console, setup, 0.001, {"5": 600.0}, {"5": ["5"]})
    view.phase("5", "measure skew", 0.0)
    rows = np.zeros(3, SAMPLE_ROW)
    rows["joint"], rows["torque_nm"], rows["temperature_c"] = 5, -123.4, 31.5
    rows["t_ns"] = 1_000_000 * np.arange(3)
    rows["position_command_rad"] = math.radians(179.0)
    view.rows(rows, 1.0)
    view.close()
    shown = drawn.getvalue()
    assert (
        "…" not in shown
        and "179.000 deg" in shown
        and "123.4 N m" in shown
        and re.search(r"-:--:--|\d:\d\d:\d\d", shown)
    )


def test_what_the_library_logs_is_printed_for_a_person(capsys: pytest.CaptureFixture[str]) -> None:
    def job() -> dict[str, str]:
        logging.getLogger("frictid_hil.simulation").info("compiling, once")
        return {}

    for quiet in (False, True):
        with pytest.raises(typer.Exit):
            Output(quiet=quiet).run("check", job)
    assert capsys.readouterr().err.count("compiling, once") == 1
