"""Compensation whole: a one-joint robot on its simulated bus, calibrated by this product, in lock-step."""

from __future__ import annotations

import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from frictid_drivers.virtual import joint_drive, rack
from frictid_drivers.virtual.servo import Servo
from frictid_hil.config.profile import FrictionProfile, JointProfile, load_profile
from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump
from frictid_hil.errors import FrictidError, Interrupted, PlanRefused, ProfileMismatch, UsageError
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.compensate import CompensateOptions, compensate, plan_compensation
from frictid_hil.jobs.compensation.wanted import Wanted
from frictid_hil.jobs.watch import Silent
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import REHEARSAL, Plan
from frictid_hil.profiles.store import ProfileStore
from frictid_hil.recording.read import read
from frictid_hil.runner.events import Event, PhaseStarted
from frictid_hil.runs.folder import load_manifest
from frictid_hil.runs.rehearsals import Rehearsals

pytestmark = pytest.mark.slow

JOINT = "3"


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    values = load_robot("hp3j.yaml").values()
    values["joints"] = {JOINT: values["joints"][JOINT]}
    values["bus"] = f"virtual:compensate{os.getpid()}"
    path = tmp_path_factory.mktemp("robot") / "one.yaml"
    path.write_text(dump(values))
    return path


@pytest.fixture(scope="module")
def profile(robot: Path) -> Path:
    result = calibrate(CalibrateOptions(str(robot), out=robot.parent / "calibration"), Silent()).to_json()
    assert result["outcome"] == "ok", result
    return Path(result["profile"])


@pytest.fixture
def go(robot: Path, profile: Path, tmp_path: Path) -> Callable[..., dict[str, Any]]:
    def run(task: str = "hand", modes: tuple[str, ...] = ("nc", "mop"), **changes: Any) -> dict[str, Any]:
        wanted = Wanted(task, modes, duration_s=3.0)
        options = CompensateOptions(str(robot), profile, JOINT, wanted, out=tmp_path / "run")
        return compensate(changed(options, **changes), Silent()).to_json()

    return run


def changed(options: CompensateOptions, **changes: Any) -> CompensateOptions:
    """Options with some of them, or of what is wanted, replaced."""
    wanted = {name: changes.pop(name) for name in list(changes) if name in Wanted.__slots__}
    return replace(options, wanted=replace(options.wanted, **wanted), **changes)


def edited(profile: Path, to: Path, **changes: Any) -> Path:
    """A profile with one joint changed, consistently, as another tool might have written it."""
    whole = load_profile(profile)
    entry = whole.joints[JOINT]
    provenance = whole.provenance.model_copy(update=changes.pop("provenance", {}))
    drive = entry.drive.model_copy(update=changes.pop("drive", {}))
    fresh = {"measured_range_rad_s": None, "slopes_nm_s_per_rad": None}
    joint: JointProfile = entry.model_copy(update={**fresh, "drive": drive, **changes})
    FrictionProfile(robot=whole.robot, joints={JOINT: joint}, provenance=provenance).save(to)
    return to


def scaled(profile: Path, to: Path, factor: float) -> Path:
    entry = load_profile(profile).joints[JOINT]
    stiffness, level = entry.presliding_stiffness_nm_per_rad, entry.presliding_level_nm
    assert stiffness.value is not None and level.value is not None
    return edited(
        profile,
        to,
        torque_nm=tuple(factor * f for f in entry.torque_nm),
        torque_interval_nm=None,
        coulomb_nm=type(entry.coulomb_nm)(value=factor * (entry.coulomb_nm.value or 0.0)),
        presliding_stiffness_nm_per_rad=type(stiffness)(value=abs(factor) * stiffness.value),
        presliding_level_nm=type(level)(value=abs(factor) * level.value),
        quality={**entry.quality, "asymmetry_nm": [factor * a for a in entry.quality["asymmetry_nm"]]},
    )


# -- what it reaches --------------------------------------------------------------------------------------------------


def test_a_hand_needs_a_tenth_of_the_torque(go: Callable[..., dict[str, Any]]) -> None:
    result = go()
    assert result["outcome"] == "ok", result
    nc, mop = result["modes"]["nc"], result["modes"]["mop"]
    assert mop["reduction_inertia_removed_percent"] >= 90.0
    assert 80.0 <= mop["reduction_percent"] <= mop["ceiling_percent"] + 1.0
    assert mop["velocity_rms_rad_s"] == pytest.approx(nc["velocity_rms_rad_s"], rel=0.03)
    assert nc["reduction_percent"] == 0.0 and nc["tracking_rms_rad"] is None
    assert Path(result["report"]).stat().st_size > 100_000
    assert result["late_cycles"] == 0


def test_tracking_errors_fall_in_the_papers_order(go: Callable[..., dict[str, Any]]) -> None:
    result = go("track", ())
    error = {mode: figures["tracking_rms_rad"] for mode, figures in result["modes"].items()}
    assert list(error) == ["nc", "mo", "mol", "mop", "mop-reference"]
    assert error["nc"] > error["mo"] > error["mol"]
    assert error["mop"] <= 1.02 * error["mol"]
    found = result["modes"]["mop-reference"]
    assert result["friction_dominates"] is True and "friction dominates" in result["remarks"][0]
    assert 85.0 <= found["reduction_percent"] <= found["ceiling_percent"] + 0.5
    assert found["reduction_percent"] >= 0.95 * found["ceiling_percent"]
    assert result["modes"]["mop"]["torque_rms_nm"] is None


@pytest.mark.parametrize("mode", [Mode.POSITION, Mode.VELOCITY])
def test_as_an_offset_it_helps_the_drives_own_loop(go: Callable[..., dict[str, Any]], mode: Mode) -> None:
    result = go("track", ("nc", "mop"), drive_mode=mode)
    assert result["outcome"] == "ok", result
    assert result["modes"]["mop"]["tracking_rms_rad"] < result["modes"]["nc"]["tracking_rms_rad"]


def test_lock_step_is_bit_identical(robot: Path, profile: Path, tmp_path: Path) -> None:
    options = CompensateOptions(str(robot), profile, JOINT, Wanted("track", ("mop",), duration_s=3.0))
    first, second = (compensate(replace(options, out=tmp_path / name), Silent()).to_json() for name in ("a", "b"))
    assert first["modes"] == second["modes"]


def test_a_run_keeps_its_profile_when_another_is_promoted(robot: Path, profile: Path, tmp_path: Path) -> None:
    store, name = ProfileStore(tmp_path / "store"), load_profile(profile).robot
    first = store.add(load_profile(profile))
    other = store.add(load_profile(scaled(profile, tmp_path / "other.yaml", 0.9)))
    store.promote(name, first)

    class Promotes(Silent):
        def event(self, event: Event) -> None:
            if isinstance(event, PhaseStarted):
                store.promote(name, other)

    options = CompensateOptions(str(robot), store.path(name, first), JOINT, Wanted("track", ("mop",), duration_s=2.0))
    kept = compensate(replace(options, out=tmp_path / "kept"), Promotes()).to_json()
    active = store.active(name)
    assert active is not None and active.id == other
    alone = compensate(replace(options, out=tmp_path / "alone"), Silent()).to_json()
    assert kept["modes"] == alone["modes"] and kept["profile"] == str(store.path(name, first).resolve())
    by_name = replace(options, profile="active", store=store.root, out=tmp_path / "after")
    after = compensate(by_name, Silent()).to_json()
    assert after["profile"] == str(store.path(name, other).resolve())
    assert after["modes"] != alone["modes"], "the two profiles can be told apart"


def test_a_joint_that_yields_gradually_is_given_such_a_spring_by_our_setting_only(
    robot: Path, profile: Path, tmp_path: Path
) -> None:
    assert load_profile(profile).joints[JOINT].presliding_yields == "at once"
    other = edited(profile, tmp_path / "gradual.yaml", presliding_yields="gradually")
    assert load_profile(other).joints[JOINT].presliding_yields == "gradually"
    for found, setting, expected in ((profile, "ours", False), (other, "ours", True), (other, "paper", False)):
        laws = plan_compensation(
            CompensateOptions(str(robot), found, JOINT, Wanted("track", ("mop",), setting=setting))
        ).laws
        assert laws["mop"].friction is not None and laws["mop"].friction.gradual is expected


def test_r_falls_where_gravity_is_uncertain_and_the_plan_says_so(robot: Path, profile: Path, tmp_path: Path) -> None:
    entry = load_profile(profile).joints[JOINT]
    bias = entry.bias_nm.value or 0.0
    half_nm = 0.6 * entry.curve().coulomb_nm
    unsure = type(entry.bias_nm)(value=bias, low=bias - half_nm, high=bias + half_nm)
    doubtful = edited(profile, tmp_path / "doubtful.yaml", bias_nm=unsure)
    centre_rad = load_robot(robot).to_setup().joint(JOINT).start_position_rad + math.radians(10.0)
    planned = {}
    for found, setting in ((profile, "ours"), (doubtful, "ours"), (doubtful, "paper")):
        wanted = Wanted("hand", ("nc", "mop"), setting=setting)
        planned[found.stem, setting] = plan_compensation(CompensateOptions(str(robot), found, JOINT, wanted))
    law = planned["doubtful", "ours"].laws["mop"]
    assert law.friction_share(centre_rad) == 1.0
    spread_rad = math.radians(10.0) / math.sqrt(2.0)
    at_end = 0.95 - 0.6 * (math.cos(spread_rad) - math.cos(math.radians(20.0)))
    assert 0.95 * law.friction_share(centre_rad - math.radians(20.0)) == pytest.approx(
        at_end,
        abs=3e-4,  # a file rounds an interval to a hundredth of its width
    )
    assert planned["doubtful", "ours"].lowest_ratio == pytest.approx(at_end, abs=3e-4)
    assert any("falls from 0.95 to 0.918" in note for note in planned["doubtful", "ours"].plan.notes)
    # As calibrated: within the travel of the task gravity is known to a hundredth of F_0.
    assert 0.94 < (planned["profile", "ours"].lowest_ratio or 0.0) < 0.949
    assert planned["doubtful", "paper"].lowest_ratio == pytest.approx(0.9)


# -- profiles that do not fit -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"drive": {"serial": "4711"}}, "4711"),
        ({"drive": {"rated_torque_nm": 38.0}}, "38 N m"),
        ({"drive": {"gear_ratio": 100.0}}, "gear ratio is 120, the profile was identified with 100"),
        ({"provenance": {"created_utc": "2020-01-01T00:00:00Z"}}, "max_age_days is 180"),
    ],
)
def test_a_profile_of_something_else_is_refused_with_both_values(
    go: Callable[..., dict[str, Any]], profile: Path, tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    wrong = edited(profile, tmp_path / "wrong.yaml", **changes)
    with pytest.raises(ProfileMismatch) as refusal:
        go(profile=wrong)
    assert words in str(refusal.value)
    assert "--force" in refusal.value.next_step
    assert not (tmp_path / "run").exists()


def test_a_drive_with_another_filter_is_refused(
    go: Callable[..., dict[str, Any]], profile: Path, tmp_path: Path
) -> None:
    settings = load_profile(profile).joints[JOINT].drive.settings
    wrong = edited(profile, tmp_path / "wrong.yaml", drive={"settings": {**settings, "velocity low-pass, us": 4000}})
    with pytest.raises(ProfileMismatch, match="velocity low-pass, us is 1000, the profile was identified with 4000"):
        go(profile=wrong)


@pytest.fixture
def drives_that_compensate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drives whose own friction compensation was switched on and stored with the vendor's tool."""
    as_built = joint_drive.servo_for

    def with_own_compensation(*arguments: Any, **options: Any) -> Servo:
        servo = as_built(*arguments, **options)
        servo.write(0x2020, 1, 60, 0)  # per mille of 6076
        servo.write(0x1010, 1, int.from_bytes(b"save", "little"), 0)
        return servo

    monkeypatch.setattr(rack, "servo_for", with_own_compensation)


@pytest.mark.usefixtures("drives_that_compensate")
def test_a_drive_that_compensates_by_itself_is_refused_by_both_verbs_in_the_same_words(
    go: Callable[..., dict[str, Any]], tmp_path: Path, robot: Path
) -> None:
    with pytest.raises(PlanRefused, match="compensates friction by itself") as compensating:
        go()
    with pytest.raises(PlanRefused) as calibrating:
        calibrate(CalibrateOptions(str(robot), out=tmp_path / "run"), Silent())
    one, other = compensating.value, calibrating.value
    assert (one.what, one.where, one.next_step) == (other.what, other.where, other.next_step)
    assert one.exit_code == 2 and one.outcome == "refused"
    assert not (tmp_path / "run").exists()


@pytest.mark.usefixtures("drives_that_compensate")
def test_compensation_on_top_of_the_drives_own_that_is_forced_trips(
    go: Callable[..., dict[str, Any]], tmp_path: Path, robot: Path
) -> None:
    result = go(modes=("mop",), force=True)
    assert result["outcome"] == "aborted"
    samples = next(one for one in read(tmp_path / "run") if one.joint == JOINT)
    assert samples.velocity_rad_s is not None
    limit = load_robot(robot).to_setup().joint(JOINT).max_velocity_rad_s
    assert float(np.abs(samples.velocity_rad_s).max()) < 0.5 * limit


def test_what_is_recorded_as_command_is_the_reference(go: Callable[..., dict[str, Any]], tmp_path: Path) -> None:
    go("track", ("nc",))
    samples = next(one for one in read(tmp_path / "run") if one.joint == JOINT)
    mark = samples.marked("track nc")[0]
    part = samples.during(mark)
    assert part.position_command_rad is not None
    assert np.ptp(part.position_command_rad) == pytest.approx(math.radians(20.0), rel=0.01)
    speed = np.abs(np.diff(part.position_command_rad)) / 1e-3
    assert np.median(speed) == pytest.approx(math.radians(30.0), rel=1e-6)
    assert np.sqrt(np.mean((part.position_command_rad - part.position_rad) ** 2)) > math.radians(1.5)


def test_a_stale_profile_may_be_forced(go: Callable[..., dict[str, Any]], profile: Path, tmp_path: Path) -> None:
    stale = edited(profile, tmp_path / "stale.yaml", provenance={"created_utc": "2020-01-01T00:00:00Z"})
    result = go("track", ("mop",), profile=stale, force=True)
    assert result["outcome"] == "ok"
    assert any("days old" in warning for warning in result["warnings"])


def refused_by_the_probe(result: dict[str, Any], words: str, run: Path) -> None:
    """The joint has moved by then: what was measured is kept, and the refusal is how the run ended."""
    assert (result["outcome"], result["exit_code"], result["modes"]) == ("refused", 2, {})
    assert words in result["error"]["what"] and "--force" in result["error"]["next_step"]
    assert result["run"] == str(run) and load_manifest(run)["outcome"] == "refused"
    assert [mark.name for mark in read(run)[0].marks][-1] == "hold", "up to the probe"


def test_a_doubled_profile_is_refused_by_the_probe(
    go: Callable[..., dict[str, Any]], profile: Path, tmp_path: Path
) -> None:
    result = go(profile=scaled(profile, tmp_path / "doubled.yaml", 2.0))
    refused_by_the_probe(result, "friction at slow motion", tmp_path / "run")


def test_a_cold_joint_is_refused_by_the_probe(go: Callable[..., dict[str, Any]], profile: Path, tmp_path: Path) -> None:
    warm = edited(profile, tmp_path / "warm.yaml", temperature_c=80.0)
    refused_by_the_probe(go(profile=warm), "80.0 degC", tmp_path / "run")


@pytest.mark.parametrize("task", ["hand", "track"])
def test_a_doubled_profile_that_is_forced_is_stopped_before_the_speed_limit(
    go: Callable[..., dict[str, Any]], profile: Path, tmp_path: Path, robot: Path, task: str
) -> None:
    doubled = scaled(profile, tmp_path / "doubled.yaml", 2.0)
    result = go(task, ("nc", "mop"), profile=doubled, force=True)
    limit = load_robot(robot).to_setup().joint(JOINT).max_velocity_rad_s
    samples = next(one for one in read(tmp_path / "run") if one.joint == JOINT)
    assert samples.velocity_rad_s is not None
    assert float(np.abs(samples.velocity_rad_s).max()) < 0.5 * limit
    if task == "hand":
        assert result["outcome"] == "aborted" and result["exit_code"] == 4
        assert "mop" not in result["modes"] and "nc" in result["modes"]


def test_a_stale_profile_of_a_stiffer_gear_that_is_forced_trips_while_the_joint_must_stand(
    go: Callable[..., dict[str, Any]], profile: Path, tmp_path: Path, robot: Path
) -> None:
    colder = scaled(profile, tmp_path / "colder.yaml", 1.4)
    stale = edited(colder, tmp_path / "stale.yaml", provenance={"created_utc": "2020-01-01T00:00:00Z"})
    with pytest.raises(ProfileMismatch, match="days old"):
        go(profile=stale)
    result = go(modes=("mop",), profile=stale, force=True)
    assert result["outcome"] == "aborted" and result["exit_code"] == 4
    samples = next(one for one in read(tmp_path / "run") if one.joint == JOINT)
    assert samples.velocity_rad_s is not None
    limit = load_robot(robot).to_setup().joint(JOINT).max_velocity_rad_s
    assert float(np.abs(samples.velocity_rad_s).max()) < 0.5 * limit


def test_a_profile_with_the_wrong_sign_is_refused_even_when_forced(
    go: Callable[..., dict[str, Any]], profile: Path, tmp_path: Path
) -> None:
    negative = scaled(profile, tmp_path / "negative.yaml", -1.0)
    for force in (False, True):
        with pytest.raises(ProfileMismatch, match="not positive"):
            go(profile=negative, force=force)


def test_gravity_with_the_wrong_sign_is_found_by_the_probe(
    go: Callable[..., dict[str, Any]], profile: Path, tmp_path: Path
) -> None:
    entry = load_profile(profile).joints[JOINT]
    wrong = type(entry.bias_nm)(value=-2.0)
    result = go(profile=edited(profile, tmp_path / "wrong.yaml", bias_nm=wrong))
    refused_by_the_probe(result, "holding torque", tmp_path / "run")


def test_wrong_gravity_that_is_forced_trips_at_once(
    go: Callable[..., dict[str, Any]], profile: Path, tmp_path: Path, robot: Path
) -> None:
    entry = load_profile(profile).joints[JOINT]
    wrong = edited(profile, tmp_path / "wrong.yaml", bias_nm=type(entry.bias_nm)(value=-6.0))
    result = go(profile=wrong, force=True)
    assert result["outcome"] == "aborted" and result["exit_code"] == 4
    limit = load_robot(robot).to_setup().joint(JOINT).max_velocity_rad_s
    samples = next(one for one in read(tmp_path / "run") if one.joint == JOINT)
    assert samples.velocity_rad_s is not None
    assert float(np.abs(samples.velocity_rad_s).max()) < 0.5 * limit
    assert abs(float(samples.velocity_rad_s[-1])) < math.radians(0.5)


# -- the rehearsal ----------------------------------------------------------------------------------------------------


@pytest.fixture
def asked(robot: Path, profile: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CompensateOptions:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    wanted = Wanted("track", ("mop",), duration_s=3.0)
    return CompensateOptions(str(robot), profile, JOINT, wanted, out=tmp_path / "run")


@pytest.fixture
def real(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the simulated drives were real ones: what they rehearse is kept."""
    as_built = Rehearsals.__init__

    def kept(self: Rehearsals, *arguments: Any) -> None:
        as_built(self, *arguments)
        self._simulated = False

    monkeypatch.setattr(Rehearsals, "__init__", kept)


def rehearses(plan: Plan) -> bool:
    return any(motion.name == REHEARSAL for motion in plan.joints[0].motions)


def test_on_a_bus_that_never_saw_this_travel_it_is_rehearsed_slowly_and_whole(asked: CompensateOptions) -> None:
    planned = plan_compensation(changed(asked, bus="socketcan:can0", task="hand"))
    assert any("it slowly, torque watched" in note for note in planned.plan.notes)
    motions = planned.plan.joints[0].motions
    names = [motion.name for motion in motions]
    assert names[:2] == ["move", REHEARSAL] and names.index(REHEARSAL) < names.index("probe")
    seen = motions[1]
    travel = seen.position_rad(np.linspace(0.0, seen.duration_s, 1001))
    assert np.ptp(travel) == pytest.approx(math.radians(40.0), rel=1e-3)
    assert np.abs(np.gradient(travel, seen.duration_s / 1000)).max() <= math.radians(20.1)


@pytest.mark.usefixtures("real")
def test_what_was_rehearsed_is_not_rehearsed_again_and_a_longer_travel_is(asked: CompensateOptions) -> None:
    assert rehearses(plan_compensation(asked).plan)
    result = compensate(asked, Silent()).to_json()
    assert result["outcome"] == "ok", result
    assert [mark.name for mark in next(iter(read(asked.out or Path()))).marks][1:4] == [REHEARSAL, "hold", "probe"]
    again = plan_compensation(asked).plan
    assert not rehearses(again) and not any("rehearse" in note for note in again.notes)
    assert rehearses(plan_compensation(changed(asked, task="hand")).plan)
    assert rehearses(plan_compensation(replace(asked, bus="socketcan:can0")).plan)


@pytest.mark.usefixtures("real")
@pytest.mark.parametrize(("ending", "kept"), [(Interrupted("stopped on request"), True), (None, False)])
def test_a_service_that_is_interrupted_has_rehearsed_and_a_run_that_tripped_has_not(
    asked: CompensateOptions, profile: Path, tmp_path: Path, ending: FrictidError | None, kept: bool
) -> None:
    class Ends(Silent):
        def event(self, event: Event) -> None:
            if isinstance(event, PhaseStarted) and event.phase == "rest mop" and ending is not None:
                raise ending

    doubled = scaled(profile, tmp_path / "doubled.yaml", 1.0 if ending else 2.0)
    by_hand = changed(asked, task="hand", profile=doubled, force=True)
    result = compensate(by_hand, Ends()).to_json()
    assert result["outcome"] == ("interrupted" if ending else "aborted"), result
    assert rehearses(plan_compensation(by_hand).plan) is not kept


def test_a_dry_run_tells_of_the_rehearsal_and_opens_nothing(asked: CompensateOptions, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "frictid_hil.cli.app", "compensate", "--robot", asked.robot, "--task", "track"]
    command += ["--profile", str(asked.profile), "--joint", JOINT, "--bus", "socketcan:can0", "--dry-run"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr
    assert "it slowly, torque watched" in " ".join(done.stdout.split())
    as_json = subprocess.run([*command, "--json"], capture_output=True, text=True, cwd=tmp_path, check=False)
    told = json.loads(as_json.stdout)
    assert told["dry_run"] and told["outcome"] == "ok" and told["plan"]["joints"][0]["joint"] == JOINT
    assert list(tmp_path.iterdir()) == []


# -- requests that cannot work ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"ratio": 1.0}, "R = 1"),
        ({"ratio": 0.95, "stiffness_nm_per_rad": 6000.0}, "presliding"),
        ({"modes": ("nc", "mop-reference")}, "person's hand"),
        ({"drive_mode": Mode.POSITION}, "guided by hand"),
        ({"modes": ("dahl",)}, "no mode 'dahl'"),
        ({"task": "push"}, "no task 'push'"),
        ({"setting": "theirs"}, "no setting 'theirs'"),
        ({"duration_s": 0.0, "modes": ("nc", "mop")}, "one mode"),
        ({"task": "track", "duration_s": 0.0}, "until interrupted"),
        ({"centre_rad": 3.3}, "leaves its limits"),
        ({"speed_rad_s": 6.0}, "above its limit"),
    ],
)
def test_requests_that_cannot_work_are_refused_before_the_bus_is_opened(
    go: Callable[..., dict[str, Any]], changes: dict[str, Any], words: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError) as refusal:
        go(changes.pop("task", "hand"), changes.pop("modes", ("nc", "mop")), **changes)
    assert words in str(refusal.value)
    assert not (tmp_path / "run").exists()


def test_without_a_yes_nothing_moves(robot: Path, profile: Path, tmp_path: Path) -> None:
    class No(Silent):
        def confirm(self, plan: object, preflight: object) -> bool:
            return False

    options = CompensateOptions(str(robot), profile, JOINT, Wanted("hand", ("mop",)), out=tmp_path / "run")
    with pytest.raises(FrictidError, match="nothing has moved"):
        compensate(options, No())


# -- the service ------------------------------------------------------------------------------------------------------


def test_a_service_runs_until_interrupted_and_leaves_its_figures(robot: Path, profile: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "frictid_hil.cli.app", "compensate", "--robot", str(robot), "--profile"]
    command += [str(profile), "--joint", JOINT, "--task", "hand", "--duration", "0", "--yes"]
    command += ["--bus", f"virtual:service{os.getpid()}", "--out", str(tmp_path / "service")]
    service = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert service.stderr is not None
    seen = []
    deadline = time.monotonic() + 60
    for line in service.stderr:
        seen.append(line)
        if sum("N m rms" in shown for shown in seen) >= 20 or time.monotonic() > deadline:
            break
    service.send_signal(signal.SIGINT)
    out, err = service.communicate(timeout=60)
    assert service.returncode == 130, (seen, out, err)
    assert "until interrupted" in "".join(seen)
    manifest = json.loads((tmp_path / "service" / "manifest.json").read_text())
    assert manifest["outcome"] == "interrupted"
    samples = next(one for one in read(tmp_path / "service") if one.joint == JOINT)
    assert len(samples) > 10_000
    assert re.search(r"mop .* 0\.[345]\d* N m", out), "the hand still needs a tenth, whatever moment it was ended at"


@pytest.mark.slow
def test_on_the_wall_clock_it_reaches_the_same(go: Callable[..., dict[str, Any]], tmp_path: Path) -> None:
    lock_step = go("hand", ("nc", "mop"), out=tmp_path / "lock_step", duration_s=2.0)
    wall = go("hand", ("nc", "mop"), out=tmp_path / "wall", realtime=True, duration_s=2.0)
    assert wall["outcome"] == "ok", wall
    found, expected = (r["modes"]["mop"]["reduction_inertia_removed_percent"] for r in (wall, lock_step))
    assert found == pytest.approx(expected, abs=1.0)
