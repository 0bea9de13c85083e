"""Promote, diff and compare: what they keep, and what they say of profiles that do not belong together."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from frictid_hil.config.profile import Estimate, FrictionProfile, JointProfile, JudgedGate, ProcedureUsed, load_profile
from frictid_hil.config.provenance import Provenance
from frictid_hil.config.robot import load_robot
from frictid_hil.errors import UsageError
from frictid_hil.jobs.compare import compare
from frictid_hil.jobs.compensation.profile_fit import doubts_of_file
from frictid_hil.jobs.identification.joint_profile import joint_result
from frictid_hil.jobs.profiles import diff, named_profile, promote, rollback, show
from frictid_hil.profiles.store import ProfileStore


def joint(level_nm: float = 5.0, *, cycles: int = 10, prismatic: bool = False) -> JointProfile:
    return JointProfile(
        method="aligned",
        prismatic=prismatic,
        velocity_rad_s=(0.5, 1.0, 1.5),
        torque_nm=(level_nm, level_nm + 1, level_nm + 2),
        coulomb_nm=Estimate(value=level_nm - 1),
        procedure=ProcedureUsed(amplitude_rad=0.35, velocity_rad_s=2.0, cycles=cycles, ratio=0.8),
        gates=(JudgedGate(name="tracking", passed=True, message=""),),
    )


def written(path: Path, joints: dict[str, JointProfile], days_ago: int = 0, robot: str = "hp3j") -> Path:
    created = (datetime.now(UTC) - timedelta(days=days_ago)).strftime("%Y-%m-%dT%H:%M:%SZ")
    FrictionProfile(robot=robot, joints=joints, provenance=Provenance(created_utc=created)).save(path)
    return path


def test_promoting_one_joint_keeps_the_others(tmp_path: Path) -> None:
    store = tmp_path / "store"
    whole = written(tmp_path / "whole.yaml", {"0": joint(), "1": joint(7.0), "2": joint(9.0)}, 200)
    first = promote(str(whole), store=store)
    assert first["joints_kept"] == []
    one = written(tmp_path / "one.yaml", {"1": joint(7.5)}, 0)
    second = promote(str(one), store=store)
    assert second["joints_kept"] == ["0", "2"]
    active = load_profile(second["active"])
    assert list(active.joints) == ["0", "1", "2"]
    assert [active.joint(name).torque_nm[0] for name in "012"] == [5.0, 7.5, 9.0]
    assert "joints 0, 2 as in the profile of" in active.provenance.notes[0]
    robot = load_robot("hp3j")
    doubts = {name: doubts_of_file(active, robot.to_setup().joint(name), "hp3j", robot.policy) for name in "01"}
    assert "200 days old" in doubts["0"][0] and doubts["1"] == [], "a joint taken over keeps its age"
    again = promote(str(written(tmp_path / "other.yaml", {"2": joint(9.5)}, 1)), store=store)
    assert load_profile(again["active"]).identified_utc("0") == load_profile(whole).provenance.created_utc
    assert rollback("hp3j", store=store)["id"] == second["id"]


def test_joints_of_another_robot_are_not_taken_over(tmp_path: Path) -> None:
    promote(str(written(tmp_path / "a.yaml", {"0": joint(), "1": joint()})), store=tmp_path / "store")
    other = promote(str(written(tmp_path / "b.yaml", {"0": joint()}, robot="other")), store=tmp_path / "store")
    assert list(load_profile(other["active"]).joints) == ["0"]


def test_the_active_profile_has_a_name(tmp_path: Path) -> None:
    store = tmp_path / "store"
    with pytest.raises(UsageError, match="no profile of hp3j is active yet"):
        named_profile("active", "hp3j", store)
    result = promote(str(written(tmp_path / "a.yaml", {"0": joint()})), store=store)
    profile, place = named_profile("active", "hp3j", store)
    assert str(place) == result["active"] and profile == ProfileStore(store).active_profile("hp3j")


def test_profiles_that_do_not_belong_together_are_told(tmp_path: Path) -> None:
    one = written(tmp_path / "a.yaml", {"0": joint(), "1": joint()})
    other = written(tmp_path / "b.yaml", {"0": joint(cycles=5), "1": joint()}, robot="other")
    for warnings in (diff(str(one), str(other))["warnings"], compare(other, one, None)["warnings"]):
        assert warnings[0] == "they are of different robots: hp3j and other"
        assert warnings[1].startswith("joint 0 was measured by different procedures: A = 0.35 rad, V = 2 rad/s, N = 10")
        assert len(warnings) == 2
    assert "procedure" in diff(str(one), str(other))["joints"]["0"]["other_changes"]
    assert diff(str(one), str(one))["warnings"] == []
    assert compare(other, None, "hp3j.yaml")["warnings"] == ["they are of different robots: other and hp3j"]


def test_a_linear_axis_speaks_newtons_in_json_too(tmp_path: Path) -> None:
    path = written(tmp_path / "a.yaml", {"x": joint(prismatic=True)})
    shown = show(path)["joints"]["x"]
    assert {"velocity_m_s", "force_n", "coulomb_n"} <= shown.keys()
    told = [shown, diff(str(path), str(path))["joints"]["x"], compare(path, path, None)["joints"]["x"]]
    assert not [key for values in told for key in values if "_nm" in key or "_rad" in key]


def test_a_calibrated_linear_axis_speaks_newtons_in_json() -> None:
    told = joint_result(joint(prismatic=True))
    assert told.keys() >= {"velocity_m_s", "force_n", "force_interval_n", "coulomb_n", "mass_kg"}
    assert not [key for key in told if key.endswith(("_nm", "_rad_s", "_kg_m2", "_per_rad"))]
