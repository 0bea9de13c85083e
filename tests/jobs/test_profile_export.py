"""A profile in the form of the place where it acts: what is written is the curve, as near as the form allows."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import yaml

from frictid_hil.config.profile import load_profile
from frictid_hil.errors import UsageError
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.jobs.profiles import export

PROFILE = Path(__file__).parents[1] / "config" / "golden" / "profile-1.yaml"


def curves() -> dict[str, FrictionCurve]:
    joints = load_profile(PROFILE).joints
    return {n: FrictionCurve.through(np.array(j.velocity_rad_s), np.array(j.torque_nm)) for n, j in joints.items()}


def test_a_table_has_twenty_points_of_the_curve(tmp_path: Path) -> None:
    told = export(PROFILE, "table", tmp_path / "t.csv")
    with (tmp_path / "t.csv").open() as file:
        rows = list(csv.DictReader(file))
    for name, curve in curves().items():
        own = [row for row in rows if row["joint"] == name]
        assert len(own) == 20 and [float(r["velocity_rad_s"]) for r in own] == sorted(
            float(r["velocity_rad_s"]) for r in own
        )
        for row in own:
            assert float(row["torque_nm"]) == pytest.approx(
                curve.torque(np.array(float(row["velocity_rad_s"]))), rel=1e-4
            )
    assert told["worst_percent"] < 5.0


def test_levels_and_slopes_are_the_nearest_line(tmp_path: Path) -> None:
    line = export(PROFILE, "ros2", tmp_path / "r.yaml")
    parameters = yaml.safe_load((tmp_path / "r.yaml").read_text())["/**"]["ros__parameters"]
    assert parameters["joints"] == list(curves())
    level = export(PROFILE, "i2rt", tmp_path / "i.yaml")
    assert len(yaml.safe_load((tmp_path / "i.yaml").read_text())["coulomb_friction"]) == len(curves())
    assert line["worst_percent"] < level["worst_percent"], "a slope is nearer than a level alone"


def test_unknown_places_and_files_that_are_there_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no target 'plc'"):
        export(PROFILE, "plc", tmp_path / "x")
    (tmp_path / "x").write_text("mine")
    with pytest.raises(UsageError, match="would be overwritten"):
        export(PROFILE, "i2rt", tmp_path / "x")
    export(PROFILE, "i2rt", tmp_path / "x", force=True)
