"""One joint of every servo family, checked, calibrated and compensated against simulated servos at the wire."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from frictid_hil.config.profile import load_profile
from frictid_hil.config.search import find
from frictid_hil.errors import ProfileMismatch, UsageError
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.check import check
from frictid_hil.jobs.compensate import CompensateOptions, compensate
from frictid_hil.jobs.compensation.result import CompensationResult
from frictid_hil.jobs.compensation.wanted import Wanted
from frictid_hil.jobs.gap.belief import measured_by
from frictid_hil.jobs.watch import Silent
from frictid_hil.plan.mode import Mode

pytestmark = pytest.mark.slow

SPRING_NM_PER_RAD = 18.0


def robot_file(folder: Path, model: str) -> Path:
    values = yaml.safe_load(find("so101.yaml").read_text(encoding="utf-8"))
    joint = values["joints"]["shoulder_pan"] | {"options": {"model": model}}
    joint |= {"position_min_rad": -1.5, "position_max_rad": 1.5}
    path = folder / f"{model}.yaml"
    path.write_text(yaml.safe_dump({**values, "bus": f"virtual:{model}", "joints": {"0": joint}}, sort_keys=False))
    return path


def compensated(path: Path, profile: Path, mode: Mode, task: str = "track") -> CompensationResult:
    wanted = Wanted(task, ("nc", "mop") if task == "track" else (), duration_s=3.0, drive_mode=mode)
    out = path.parent / f"{task} {mode.name} by {profile.stem}"
    return compensate(CompensateOptions(str(path), profile, "0", wanted, out=out), Silent())


@pytest.mark.parametrize("model", ["STS3215", "SCS15", "XL330-M288", "XL430-W250"])
def test_every_family_is_checked_calibrated_and_compensated(tmp_path: Path, model: str) -> None:
    path, run = robot_file(tmp_path, model), tmp_path / "run"
    assert check(str(path))["ok"]
    calibration = calibrate(CalibrateOptions(str(path), out=run, seed=1, cycles=6), Silent()).to_json()
    assert calibration["outcome"] == "ok", calibration
    profile = run / "profile.yaml"
    entry = load_profile(profile).joint("0")
    assert entry.quality["loop_stiffness_nm_per_rad"] == pytest.approx(SPRING_NM_PER_RAD, rel=0.05)
    least = entry.presliding_stiffness_nm_per_rad
    assert least.value is not None and 50.0 < least.value < 0.3 / 5e-4, "below the simulated joint's"
    assert entry.presliding_yields == "unseen", "and no figure for a simulator"
    assert "presliding_stiffness_nm_per_rad" not in measured_by(entry)["friction"]
    tracked = compensated(path, profile, Mode.POSITION).to_json()
    assert tracked["outcome"] == "ok", tracked
    assert tracked["modes"]["mop"]["reduction_percent"] >= 15.0
    if model == "XL330-M288":
        tracked = compensated(path, profile, Mode.TORQUE).to_json()
        assert tracked["outcome"] == "ok", tracked
        assert tracked["modes"]["mop"]["reduction_percent"] >= 40.0
        guided = compensated(with_hand(path), profile, Mode.TORQUE, "hand").to_json()
        assert guided["outcome"] == "ok", guided
        assert guided["modes"]["mop"]["velocity_rms_rad_s"] > 0.5, "the hand moves it"
        return
    for task in ("track", "hand"):
        with pytest.raises(UsageError) as refused:
            compensated(with_hand(path), profile, Mode.TORQUE, task)
        assert "hand test" in refused.value.cause and "--drive-mode position" in refused.value.next_step
    if model == "STS3215":
        _refused_at_another_gain(path, profile, run)


def with_hand(path: Path) -> Path:
    """The robot with a simulated person, as the hand test asks for before the drives are asked."""
    values = yaml.safe_load(path.read_text(encoding="utf-8"))
    values["joints"]["0"]["simulated"]["hand"] = {"stiffness_nm_per_rad": 10.0, "damping_nm_s_per_rad": 0.5}
    path.write_text(yaml.safe_dump(values, sort_keys=False))
    return path


def _refused_at_another_gain(path: Path, profile: Path, run: Path) -> None:
    entry = load_profile(profile).joint("0")
    drive = entry.drive
    assert drive.settings["position_p_gain"] == 32
    other = profile.read_text(encoding="utf-8").replace("position_p_gain: 32", "position_p_gain: 16")
    (run / "other.yaml").write_text(other)
    with pytest.raises(ProfileMismatch, match="position_p_gain is 32, the profile was identified with 16"):
        compensated(path, run / "other.yaml", Mode.POSITION)
