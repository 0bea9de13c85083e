"""The main job, whole: the shipped robot on its simulated bus, in lock-step."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from frictid_hil.config.profile import load_profile
from frictid_hil.errors import PlanRefused
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate, plan_calibration
from frictid_hil.jobs.compare import compare
from frictid_hil.jobs.identify import IdentifyOptions, identify
from frictid_hil.jobs.watch import Silent
from frictid_hil.plan import REHEARSAL
from frictid_hil.runner.run_folder import load_manifest


def run(out: Path, **changes: object) -> dict[str, object]:
    options = CalibrateOptions("hp3j.yaml", bus=f"virtual:{out.name}", out=out, **changes)  # type: ignore[arg-type]
    return calibrate(options, Silent())


@pytest.fixture(scope="module")
def joint_5(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("calibrate") / "joint5"
    result = run(out, joints=("5",))
    assert result["outcome"] == "ok", result
    return out


def test_a_run_leaves_everything_behind(joint_5: Path) -> None:
    names = {path.name for path in joint_5.iterdir()}
    assert names >= {"config.yaml", "manifest.json", "samples.mcap", "bus.blf", "profile.yaml", "report.html"}
    manifest = load_manifest(joint_5)
    assert manifest["outcome"] == "ok"
    assert manifest["sessions"][0]["late_cycles"] == 0


def test_the_identified_curve_is_near_the_truth(joint_5: Path) -> None:
    distance = compare(joint_5, None, "hp3j.yaml")["joints"]["5"]
    assert distance["e_percent_measured_range"] <= 0.5
    assert distance["e_percent"] <= 1.5


def test_the_profile_holds_what_later_verbs_need(joint_5: Path) -> None:
    joint = load_profile(joint_5 / "profile.yaml").joint("5")
    for name in ("inertia_kg_m2", "gravity_cos_nm", "gravity_sin_nm", "bias_nm", "presliding_stiffness_nm_per_rad"):
        figure = getattr(joint, name)
        assert figure.value is not None and figure.low < figure.value < figure.high, name
    assert joint.published is not None
    assert joint.inertia_kg_m2.value == pytest.approx(0.065, rel=0.02)
    assert all(gate.passed for gate in joint.gates)
    assert joint.drive.serial and joint.torque_source


def test_recorded_samples_identify_to_the_same_profile(joint_5: Path) -> None:
    out = joint_5.parent / "again"
    again = identify(IdentifyOptions((joint_5,), robot="hp3j.yaml", out=out))
    assert again["outcome"] == "ok"
    first, second = load_profile(joint_5 / "profile.yaml"), load_profile(out / "profile.yaml")
    assert first.joints == second.joints
    assert first.content_sha256 == second.content_sha256


def test_the_same_seed_gives_the_same_bytes_but_for_provenance(joint_5: Path, tmp_path: Path) -> None:
    run(tmp_path / "second", joints=("5",))
    first = (joint_5 / "profile.yaml").read_text().split("provenance:")[0]
    second = (tmp_path / "second" / "profile.yaml").read_text().split("provenance:")[0]
    assert first == second


def test_a_run_on_simulated_drives_spares_no_real_joint_its_rehearsal(joint_5: Path) -> None:
    planned = plan_calibration(CalibrateOptions("hp3j.yaml", bus="socketcan:can0", joints=("5",)))
    assert REHEARSAL in [motion.name for motion in planned.plan.joints[0].motions]
    assert "rehearse it slowly" in " ".join(planned.plan.notes)


def test_the_plan_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(PlanRefused, match="predicted torque"):
        run(tmp_path / "refused", joints=("1",), amplitude_rad=0.0873)
    assert not (tmp_path / "refused").exists()


def test_a_no_leaves_nothing_behind(tmp_path: Path) -> None:
    class No(Silent):
        def confirm(self, plan: object, preflight: object) -> bool:
            return False

    options = CalibrateOptions("hp3j.yaml", bus="virtual:no", joints=("5",), out=tmp_path / "no")
    with pytest.raises(PlanRefused, match="not confirmed"):
        calibrate(options, No())
    assert not (tmp_path / "no").exists()


def test_the_manifest_is_plain_json(joint_5: Path) -> None:
    manifest = json.loads((joint_5 / "manifest.json").read_text())
    assert manifest["identities"]["5"]["serial"]
    assert [mark["name"] for mark in manifest["sessions"][0]["marks"]][3] == "cycles"
