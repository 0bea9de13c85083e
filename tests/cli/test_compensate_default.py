"""Without ``--profile`` the profile that is in force is used; a person who promoted one need not name it."""

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from frictid_hil.cli.app import app
from frictid_hil.config.profile import Estimate, FrictionProfile, JointProfile, JudgedGate
from frictid_hil.config.provenance import Provenance


def saved(path: Path, level_nm: float) -> Path:
    joint = JointProfile(
        method="aligned",
        velocity_rad_s=(0.5, 1.0, 1.5),
        torque_nm=(level_nm, level_nm + 1, level_nm + 2),
        coulomb_nm=Estimate(value=level_nm - 1),
        presliding_stiffness_nm_per_rad=Estimate(value=1000.0 * level_nm),
        presliding_level_nm=Estimate(value=0.9 * level_nm),
        inertia_kg_m2=Estimate(value=0.1),
        gravity_cos_nm=Estimate(value=0.5),
        gravity_sin_nm=Estimate(value=0.0),
        bias_nm=Estimate(value=0.0),
        gates=(JudgedGate(name="tracking", passed=True, message=""),),
    )
    FrictionProfile(robot="hp3j", joints={"5": joint}, provenance=Provenance(created_utc="2026-01-01T00:00:00Z")).save(
        path
    )
    return path


def planned(store: Path, *arguments: str) -> dict[str, Any]:
    asked = ("compensate", "--robot", "hp3j", "--joint", "5", "--task", "hand", "--dry-run", "--force", "--json")
    answer = CliRunner().invoke(app, [*asked, "--store", str(store), *arguments])
    told: dict[str, Any] = json.loads(answer.stdout)
    assert (answer.exit_code, told["outcome"]) in ((0, "ok"), (2, "refused"))
    return told


@pytest.mark.slow
def test_the_profile_in_force_is_the_default(tmp_path: Path) -> None:
    store = tmp_path / "store"
    assert "no profile of hp3j is active" in planned(store)["error"]["what"]
    plans = []
    for level_nm in (2.0, 5.0):
        profile = saved(tmp_path / f"{level_nm}.yaml", level_nm)
        assert CliRunner().invoke(app, ["profile", "promote", str(profile), "--store", str(store)]).exit_code == 0
        plans.append(planned(store)["plan"])
        assert plans[-1] == planned(store, "--profile", "active")["plan"]
        assert plans[-1] == planned(store, "--profile", str(profile))["plan"]
    assert plans[0] != plans[1], "the two can be told apart"
