"""One joint of every family from unknown friction to compensated, against its simulated device at the wire."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mit_bench import FAMILIES, robot_file
from typer.testing import CliRunner

from frictid_hil.cli.app import app
from frictid_hil.config.profile import load_profile
from frictid_hil.config.robot import load_robot
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.check import check
from frictid_hil.jobs.compensate import CompensateOptions, compensate
from frictid_hil.jobs.compensation.wanted import Wanted
from frictid_hil.jobs.watch import Silent
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.steady import true_curve_nm

pytestmark = pytest.mark.slow

COULOMB_NM = 0.24


def calibrated(path: Path, out: Path, seed: int) -> None:
    result = calibrate(CalibrateOptions(str(path), out=out, seed=seed, cycles=5), Silent()).to_json()
    assert result["outcome"] == "ok", result
    joint = load_profile(out / "profile.yaml").joint("0")
    setup = load_robot(path).to_setup()
    model = JointModel.of(setup.joint("0"), "0")
    coulomb_nm = model.friction.coulomb_nm
    assert joint.coulomb_nm.value == pytest.approx(coulomb_nm, rel=0.05)
    assert joint.coulomb_nm.low < coulomb_nm < joint.coulomb_nm.high
    truth_nm = true_curve_nm(model, np.array(joint.velocity_rad_s))
    assert np.allclose(joint.torque_nm, truth_nm, rtol=0.03)
    low_nm, high_nm = np.array(joint.torque_interval_nm).T
    assert np.mean((low_nm <= truth_nm) & (truth_nm <= high_nm)) >= 0.8


def test_bounds_that_suit_another_arm_are_printed_before_anything_moves() -> None:
    told = " ".join(CliRunner().invoke(app, ["calibrate", "--robot", "mit-bench.yaml", "--dry-run"]).output.split())
    assert "bounds of care from the robot file: following_error_rad 0.2 (usually 0.0873)" in told
    assert "bounds of care from the driver: still_rad_s 0.05 (usually 0.00873)" in told


def test_limits_of_quality_gates_are_printed_before_anything_moves_and_kept_beside_the_result(tmp_path: Path) -> None:
    path = robot_file(tmp_path, "damiao", {"gates": {"direction_asymmetry": 0.001, "drift": 0.1}})
    told = " ".join(CliRunner().invoke(app, ["calibrate", "--robot", str(path), "--dry-run"]).output.split())
    said = "direction_asymmetry 0.001 (usually 0.3), drift 0.1 (usually 0.05)"
    assert f"limits of quality gates from the robot file: {said}" in told
    result = calibrate(CalibrateOptions(str(path), out=tmp_path / "run", cycles=3), Silent()).to_json()
    assert result["outcome"] == "gate_failed"
    joint = result["joints"]["0"]
    assert "allowed 0.1 %" in joint["remarks"][0] and said in " ".join(joint["notes"])


@pytest.mark.slow
def test_can_fd_changes_no_figure(tmp_path: Path) -> None:
    classical, fast = tmp_path / "classical", tmp_path / "fast"
    for folder, options in ((classical, {}), (fast, {"fd": True})):
        folder.mkdir()
        calibrated(robot_file(folder, "damiao", {"options": options}), folder / "run", 4)
    first, second = (load_profile(folder / "run" / "profile.yaml").joint("0") for folder in (classical, fast))
    assert first.torque_nm == second.torque_nm


@pytest.mark.slow
@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_compensation_follows_better_than_none(tmp_path: Path, family: str) -> None:
    options = {"allow_torque_without_watchdog": True}  # nothing here can be hurt
    path = robot_file(tmp_path, family, {"options": options})
    assert check(str(path))["ok"]
    calibrated(path, tmp_path / "run", 4)
    wanted = Wanted("track", ("nc", "mop"), duration_s=4.0)
    result = compensate(
        CompensateOptions(str(path), tmp_path / "run" / "profile.yaml", "0", wanted, out=tmp_path / "compensated"),
        Silent(),
    ).to_json()
    assert result["outcome"] == "ok", result
    assert result["modes"]["mop"]["reduction_percent"] >= 50.0
