"""The unattended job: promoted, refused, locked out, interlocked; every ending told and kept."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import filelock
import pytest

from frictid_hil.config.policy import Policy
from frictid_hil.config.profile import Estimate, FrictionProfile, JointProfile, load_profile
from frictid_hil.config.provenance import Provenance
from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump
from frictid_hil.errors import HardwareBusy, UsageError
from frictid_hil.jobs.recalibrate import RecalibrateOptions, recalibrate
from frictid_hil.jobs.watch import Silent
from frictid_hil.plan.plan import WarmUp
from frictid_hil.profiles.judgement import judge
from frictid_hil.profiles.store import ProfileStore
from frictid_hil.protocol.driver import Feedback, SetPoint
from frictid_hil.recording.mcap_reader import read_rows
from frictid_hil.runner.warm_up import WarmUpWatch

pytestmark = pytest.mark.slow

INTERLOCK = {"joint": "5", "bit": 3, "closed_when": 1}


def robot_file(place: Path, **changes: Any) -> str:
    """The smallest joint of the shipped robot alone, with a short procedure."""
    values = load_robot("hp3j").values()
    values |= {"name": "night", "bus": f"virtual:{place.name}", "joints": {"5": values["joints"]["5"]}}
    values["procedure"] |= {"amplitude_rad": 0.2, "velocity_rad_s": 1.5, "cycles": 3}
    values["policy"] = {"warm_up": {"fixed_s": 0.0}} | changes.pop("policy", {})
    friction = values["joints"]["5"]["simulated"]["friction"]
    for key in friction:
        friction[key] *= changes.get("friction", 1.0)
    values["options"] = changes.get("options", {})
    values |= changes.get("values", {})
    path = place / "night.yaml"
    path.write_text(dump(values))
    return str(path)


def night(place: Path, number: int, **changes: Any) -> dict[str, Any]:
    options = RecalibrateOptions(
        robot_file(place, **changes), store=place / "store", seed=number, out=place / f"run-{number}"
    )
    return recalibrate(options, Silent())


def test_nights_are_promoted_until_one_is_broken(tmp_path: Path) -> None:
    first = night(tmp_path, 1)
    assert first["promoted"] and first["outcome"] == "ok" and first["drift"]["5"]["distance_percent"] is None
    second = night(tmp_path, 2, friction=1.15)
    assert second["promoted"] and second["drifted"] == ["5"] and "look at joint 5:" in second["next_step"]
    assert second["drift"]["5"]["distance_percent"] == pytest.approx(15, abs=3)
    broken = night(tmp_path, 3, friction=2.0)
    assert (broken["outcome"], broken["exit_code"], broken["promoted"]) == ("gate_failed", 5, False)
    assert broken["active"] == second["active"] and broken["drift"]["5"]["broken"]
    load_profile(Path(broken["active"]))
    kept = ProfileStore(tmp_path / "store").attempts("night")
    assert [one.outcome for one in kept] == ["ok", "ok", "gate_failed"]
    assert all(one.next_step for one in kept)
    for key in ("recalibration_report", "history", "report"):
        assert Path(broken[key]).stat().st_size > 100_000


def test_a_real_robot_needs_permission(tmp_path: Path) -> None:
    options = RecalibrateOptions(robot_file(tmp_path), bus="socketcan:nowhere0", store=tmp_path / "store")
    with pytest.raises(UsageError, match="unattended"):
        recalibrate(options, Silent())
    (kept,) = ProfileStore(tmp_path / "store").attempts("night")
    assert (kept.exit_code, kept.promoted) == (2, False) and "unattended" in kept.next_step


def test_started_twice_the_second_moves_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "store" / "night"
    folder.mkdir(parents=True)
    with filelock.FileLock(folder / ".recalibrate.lock"), pytest.raises(HardwareBusy, match="another recalibration"):
        night(tmp_path, 1)
    assert not (tmp_path / "run-1").exists()


def test_an_open_interlock_keeps_everything_still(tmp_path: Path) -> None:
    unattended = {"allowed_by": "Iwatani", "date": "2026-11-21", "interlock_input": INTERLOCK}
    faults = {"faults": [{"kind": "interlock_open", "joint": "5", "at_s": 0.0}]}
    policy = {"unattended": unattended}
    result = night(tmp_path, 1, policy=policy, options=faults)
    assert (result["outcome"], result["exit_code"], result["promoted"]) == ("aborted", 4, False)
    assert "interlock is open" in result["error"]["what"]
    position = read_rows(tmp_path / "run-1" / "samples.mcap")["5"]["position_rad"]
    assert position.max() - position.min() < 1e-5


def test_an_interlock_that_opens_in_motion_stops_it(tmp_path: Path) -> None:
    unattended = {"allowed_by": "Iwatani", "date": "2026-11-21", "interlock_input": INTERLOCK}
    faults = {"faults": [{"kind": "interlock_open", "joint": "5", "at_s": 6.0}]}
    result = night(tmp_path, 1, policy={"unattended": unattended}, options=faults)
    assert (result["outcome"], result["exit_code"], result["promoted"]) == ("aborted", 4, False)
    assert "interlock is open" in result["error"]["what"] and result["next_step"]


def test_half_a_robot_is_no_point_of_a_trend(tmp_path: Path) -> None:
    joints = {name: load_robot("hp3j").values()["joints"][name] for name in ("4", "5")}
    unattended = {"allowed_by": "Iwatani", "date": "2026-11-21", "interlock_input": INTERLOCK}
    faults = {"faults": [{"kind": "interlock_open", "joint": "5", "at_s": 24.0}]}
    values = {"joints": joints, "cycle_hz": 500}
    result = night(tmp_path, 1, policy={"unattended": unattended}, options=faults, values=values)
    assert (result["outcome"], result["stored"], result["promoted"]) == ("aborted", None, False)
    assert load_profile(Path(result["profile"])).joints.keys() == {"4"}, "what was measured is kept in the run folder"
    store = ProfileStore(tmp_path / "store")
    assert store.history("night") == [] and store.trends("night") == {}
    assert "aborted" in Path(result["history"]).read_text()


def test_closed_interlock_lets_it_run(tmp_path: Path) -> None:
    unattended = {"allowed_by": "Iwatani", "date": "2026-11-21", "interlock_input": INTERLOCK}
    assert night(tmp_path, 1, policy={"unattended": unattended})["promoted"]


def test_the_command_line_prints_one_line_and_notifies(tmp_path: Path) -> None:
    told = tmp_path / "told.json"
    robot = robot_file(tmp_path, policy={"promotion": "by_person"})
    command = [sys.executable, "-m", "frictid_hil.cli.app", "recalibrate", "--robot", robot, "--json"]
    command += ["--store", str(tmp_path / "store"), "--out", str(tmp_path / "run"), "--notify", f"tee {told}"]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)
    assert answer.returncode == 0, answer.stderr
    (line,) = answer.stdout.splitlines()
    result = json.loads(line)
    assert result["promoted"] is False and "promote" in result["next_step"] and result["active"] is None
    assert json.loads(told.read_text())["schema"] == "frictid.recalibrate/1"


# -- the policy by itself -------------------------------------------------------------------------------------------


def profile(factor: float = 1.0, *, half: float = 0.05, serial: str = "1", joints: str = "01") -> FrictionProfile:
    torque = tuple(factor * t for t in (4.0, 5.0, 6.0))
    joint = JointProfile(
        method="aligned",
        velocity_rad_s=(0.5, 1.0, 1.5),
        torque_nm=torque,
        torque_interval_nm=tuple((t - half, t + half) for t in torque),
        coulomb_nm=Estimate(value=3.5 * factor),
    )
    joint = joint.model_copy(update={"drive": joint.drive.model_copy(update={"serial": serial})})
    provenance = Provenance(created_utc="2026-11-21T02:00:00Z")
    return FrictionProfile(robot="arm", joints=dict.fromkeys(joints, joint), provenance=provenance)


def test_drift_is_measured_from_the_baseline_damage_from_the_active() -> None:
    base, active = profile(), profile(1.25)
    verdict = judge(Policy(), profile(1.4), active, base, failed={})
    assert verdict.promote and verdict.drifted == ("0", "1")
    assert judge(Policy(), profile(1.7), active, base, failed={}).refused
    assert judge(Policy(drift_reference="active"), profile(1.3), active, base, failed={}).drifted == ()


def test_a_change_within_the_intervals_is_no_drift() -> None:
    assert judge(Policy(), profile(1.15, half=2.0), profile(half=2.0), profile(half=2.0), failed={}).drifted == ()


@pytest.mark.parametrize(
    ("newer", "failed", "says"),
    [
        (profile(), {"0": "too little tracking"}, "too little tracking"),
        (profile(serial="2"), {}, "drive serial 1 -> 2"),
        (profile(joints="0"), {}, "joint 1 of the active profile was not measured"),
    ],
)
def test_what_is_never_promoted_silently(newer: FrictionProfile, failed: dict[str, str], says: str) -> None:
    verdict = judge(Policy(), newer, profile(), profile(), failed=failed)
    assert verdict.refused and not verdict.promote and says in verdict.reason and verdict.next_step


# -- warming up -----------------------------------------------------------------------------------------------------


class _Still:
    def update(self, feedback: Any, set_point: Any) -> bool:
        return True


@pytest.mark.parametrize(("tau_s", "settles"), [(1e9, True), (20.0, True), (600.0, False)])
def test_a_warm_up_ends_once_friction_has_settled(tau_s: float, settles: bool) -> None:
    motion = WarmUp(0.0, 0.2, 1.0, longest_s=300.0, settled_percent_per_min=1.0)
    period_s = 0.01
    watch = WarmUpWatch(_Still(), motion, period_s)
    report, steps = Feedback(), 0
    while steps * period_s < motion.duration_s:
        phase = 2 * math.pi * (steps * period_s / motion.cycle_s)
        friction = 10.0 * (1 + 0.5 * math.exp(-steps * period_s / tau_s))
        report.velocity_rad_s = math.sin(phase)
        report.torque_nm = math.copysign(friction, report.velocity_rad_s) + 3.0
        if not watch.update(report, SetPoint()):
            break
        steps += 1
    assert watch.settled is settles
    if settles:
        assert abs(watch.percent_per_min or 0.0) <= 1.0
        assert steps % round(motion.cycle_s / period_s) == 0
    assert replace(motion, longest_s=1.0).duration_s >= 1.0
