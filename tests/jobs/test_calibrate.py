"""The main job, whole: the shipped robot on its simulated bus, in lock-step."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from frictid_hil.config.profile import load_profile
from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump
from frictid_hil.errors import Interrupted, PlanRefused, UsageError
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate, plan_calibration
from frictid_hil.jobs.compare import compare
from frictid_hil.jobs.identify import IdentifyOptions, identify
from frictid_hil.jobs.report import report, whole_profile
from frictid_hil.jobs.watch import Silent
from frictid_hil.plan.plan import REHEARSAL
from frictid_hil.profiles.store import ProfileStore
from frictid_hil.runner.events import Event, PhaseStarted
from frictid_hil.runs.folder import load_manifest

pytestmark = pytest.mark.slow


def run(out: Path, **changes: object) -> dict[str, object]:
    options = CalibrateOptions("hp3j.yaml", bus=f"virtual:{out.name}", out=out, **changes)  # type: ignore[arg-type]
    return calibrate(options, Silent()).to_json()


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
    assert whole_profile(joint_5).joint("5").published is not None
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


def test_a_profile_is_written_over_only_where_that_is_asked_for(joint_5: Path, tmp_path: Path) -> None:
    before = (joint_5 / "profile.yaml").read_bytes()
    with pytest.raises(UsageError, match="exists already") as told:
        identify(IdentifyOptions((joint_5,), robot="hp3j.yaml", out=joint_5))
    assert (joint_5 / "profile.yaml").read_bytes() == before and "--force" in told.value.next_step
    shutil.copytree(joint_5, tmp_path / "run")
    identify(IdentifyOptions((joint_5,), robot="hp3j.yaml", out=tmp_path / "run", force=True))
    assert (tmp_path / "run" / "profile.yaml").read_bytes() != before


def test_the_same_seed_gives_the_same_bytes_but_for_provenance(joint_5: Path, tmp_path: Path) -> None:
    run(tmp_path / "second", joints=("5",))
    first = (joint_5 / "profile.yaml").read_text().split("provenance:")[0]
    second = (tmp_path / "second" / "profile.yaml").read_text().split("provenance:")[0]
    assert first == second


def test_a_run_on_simulated_drives_spares_no_real_joint_its_rehearsal(joint_5: Path) -> None:
    planned = plan_calibration(CalibrateOptions("hp3j.yaml", bus="socketcan:can0", joints=("5",)))
    assert REHEARSAL in [motion.name for motion in planned.plan.joints[0].motions]
    assert "it slowly, torque watched" in " ".join(planned.plan.notes)


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


# -- going on after an interruption -----------------------------------------------------------------------------------


class StoppedAt(Silent):
    """A person who presses Ctrl-C when a joint begins its cycles."""

    def __init__(self, joint: str) -> None:
        self._joint = joint

    def event(self, event: Event) -> None:
        if isinstance(event, PhaseStarted) and (event.joint, event.phase) == (self._joint, "cycles"):
            raise Interrupted("stopped on request; the joint was brought to rest")


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """A robot of three joints, and a run of two of them that was stopped during the second one."""
    place = tmp_path_factory.mktemp("interrupted")
    values = load_robot("hp3j").values()
    values |= {"name": "two", "bus": "virtual:two", "joints": {n: values["joints"][n] for n in ("3", "4", "5")}}
    robot = place / "two.yaml"
    robot.write_text(dump(values))
    asked = CalibrateOptions(
        str(robot), joints=("4", "5"), amplitude_rad=0.2, velocity_rad_s=1.5, cycles=3, seed=7, out=place / "run"
    )
    result = calibrate(asked, StoppedAt("5")).to_json()
    assert (result["outcome"], result["exit_code"]) == ("interrupted", 130)
    assert result["error"]["next_step"] == f"continue with `frictid-hil calibrate --resume {place / 'run'}`"
    assert list(result["joints"]) == ["4"] and load_profile(result["profile"]).joints.keys() == {"4"}
    return str(robot), place / "run"


def resume(robot: str, run: Path) -> dict[str, Any]:
    return calibrate(CalibrateOptions(robot, resume=run), Silent()).to_json()


def test_a_run_is_continued_with_the_joints_it_lacks(interrupted: tuple[str, Path], tmp_path: Path) -> None:
    robot, run = interrupted
    whole = tmp_path / "run"
    shutil.copytree(run, whole)
    before = load_profile(run / "profile.yaml").joints["4"]
    result = resume(robot, whole)
    assert result["outcome"] == "ok" and list(result["joints"]) == ["4", "5"]
    profile = load_profile(whole / "profile.yaml")
    assert profile.joints["4"] == before and profile.joints.keys() == {"4", "5"}
    assert [session["joint"] for session in load_manifest(whole)["sessions"]] == ["4", "5"]


def test_a_continued_run_needs_its_folder_alone_and_moves_as_it_began(
    interrupted: tuple[str, Path], tmp_path: Path
) -> None:
    robot, run = interrupted
    whole = tmp_path / "run"
    shutil.copytree(run, whole)
    planned = plan_calibration(CalibrateOptions(resume=whole))
    assert [entry.joint for entry in planned.plan.joints] == ["5"] and planned.order.setup.seed == 7
    result = calibrate(CalibrateOptions(resume=whole), Silent())
    assert list(result.joints) == ["4", "5"] and result.profile is not None
    used = [joint.procedure for joint in result.profile.joints.values() if joint.procedure is not None]
    assert {(one.amplitude_rad, one.velocity_rad_s, one.cycles) for one in used} == {(0.2, 1.5, 3)}
    first, second = (run / "samples.mcap").read_bytes(), (whole / "samples.mcap").read_bytes()
    assert first == second and (whole / "samples-2.mcap").exists()
    again = identify(IdentifyOptions((whole,), robot=robot, out=tmp_path / "again"))
    assert again["joints"].keys() == {"4", "5"} and again["outcome"] == "ok"
    # Nothing is missing any more: the result is formed anew, and no bus is opened.
    assert calibrate(CalibrateOptions(resume=whole), Silent()).profile_file == whole / "profile.yaml"


@pytest.mark.parametrize(
    "other",
    [
        {"amplitude_rad": 0.3},
        {"joints": ("3",)},
        {"bus": "virtual:elsewhere"},
        {"together": True},
        {"program": "quick"},
        {"seed": 8},
    ],
)
def test_a_run_is_not_continued_otherwise_than_it_began(interrupted: tuple[str, Path], other: dict[str, Any]) -> None:
    _, run = interrupted
    (name,) = other
    with pytest.raises(UsageError, match=f"began otherwise: {name} is .* now and was"):
        plan_calibration(CalibrateOptions(resume=run, **other))


def test_a_run_whose_robot_file_is_gone_is_continued_with_its_own_copy(
    interrupted: tuple[str, Path], tmp_path: Path
) -> None:
    robot, run = interrupted
    whole = tmp_path / "run"
    shutil.copytree(run, whole)
    manifest = load_manifest(whole)
    (whole / "manifest.json").write_text(json.dumps({**manifest, "robot_file": str(tmp_path / "gone.yaml")}))
    assert plan_calibration(CalibrateOptions(resume=whole)).order.robot.path == whole / "config.yaml"
    (whole / "manifest.json").write_text(json.dumps({**manifest, "verb": "gap-record"}))
    with pytest.raises(UsageError, match="a run of gap-record"):
        plan_calibration(CalibrateOptions(robot, resume=whole))
    for broken in ({"options": 3}, {"options": {"cycles": "many"}}):
        (whole / "manifest.json").write_text(json.dumps({**manifest, **broken}))
        with pytest.raises(UsageError, match="its options cannot be read"):
            plan_calibration(CalibrateOptions(robot, resume=whole))


def test_a_calibration_without_a_robot_is_refused() -> None:
    with pytest.raises(UsageError, match="which robot"):
        plan_calibration(CalibrateOptions())


def test_a_run_of_another_drive_is_not_continued(interrupted: tuple[str, Path], tmp_path: Path) -> None:
    robot, run = interrupted
    other = tmp_path / "run"
    shutil.copytree(run, other)
    manifest = load_manifest(other)
    manifest["identities"]["4"]["serial"] = "of another drive"
    (other / "manifest.json").write_text(json.dumps(manifest))
    before = {path.name: path.read_bytes() for path in other.glob("joints/*")}
    with pytest.raises(UsageError, match=r"joint 4.*serial number .* began with of another drive"):
        resume(robot, other)
    assert {path.name: path.read_bytes() for path in other.glob("joints/*")} == before
    assert [session["joint"] for session in load_manifest(other)["sessions"]] == ["4"], "nothing has moved"


def test_a_run_of_a_changed_robot_file_is_not_continued(interrupted: tuple[str, Path], tmp_path: Path) -> None:
    robot, run = interrupted
    values = load_robot(robot).values()
    values["joints"]["5"]["gear_ratio"] += 1
    changed = tmp_path / "two.yaml"
    changed.write_text(dump(values))
    with pytest.raises(UsageError, match="robot file has changed since this run began"):
        resume(str(changed), run)


# -- the page ---------------------------------------------------------------------------------------------------------


def test_the_page_compares_with_the_profile_in_force(interrupted: tuple[str, Path], tmp_path: Path) -> None:
    robot, run = interrupted
    whole, store = tmp_path / "run", ProfileStore(tmp_path / "store")
    shutil.copytree(run, whole)
    assert "There is no earlier profile to compare with" in (whole / "report.html").read_text()
    old = load_profile(whole / "profile.yaml")
    slower = {
        n: one.model_copy(update={"torque_nm": tuple(1.5 * t for t in one.torque_nm)}) for n, one in old.joints.items()
    }
    store.promote("two", store.add(old.model_copy(update={"joints": slower})))
    calibrate(CalibrateOptions(robot, resume=whole, store=store.root), Silent())
    assert "Compared with the profile that was active then" in (whole / "report.html").read_text()
    (whole / "report.html").unlink()
    page = Path(report(whole)["report"]).read_text()
    assert "Compared with the profile that was active then" in page and "active before" in page
