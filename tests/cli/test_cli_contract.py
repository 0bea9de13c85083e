"""The command line as its users meet it: exit codes, one JSON object, errors that tell what to do."""

from __future__ import annotations

import json
import os
import socket
import subprocess
from pathlib import Path
from typing import Any

import pytest
from called import PROGRAM, run
from rich.console import Console

from frictid_hil.cli.progress import print_plan
from frictid_hil.config.profile import Estimate, FrictionProfile, JointProfile
from frictid_hil.config.provenance import Provenance
from frictid_hil.jobs.calibrate import CalibrateOptions, plan_calibration
from frictid_hil.profiles.store import ProfileStore

VERBS = ["check", "calibrate", "identify", "compare", "compensate", "replay", "recalibrate", "schedule"]
VERBS += ["profile", "emulate", "gap", "report"]


def as_json(result: subprocess.CompletedProcess[str]) -> dict[str, Any]:
    (only_line,) = result.stdout.splitlines()
    value = json.loads(only_line)
    assert isinstance(value, dict)
    return value


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_explains_itself(verb: str) -> None:
    result = run(verb, "--help")
    assert result.returncode == 0
    assert "Usage" in result.stdout


@pytest.mark.slow
def test_the_installed_command_starts_and_tells_its_exit_code() -> None:
    asked = [PROGRAM, "compare", "no-such.yaml", "--truth", "hp3j", "--json"]
    result = subprocess.run(asked, capture_output=True, text=True, timeout=200, check=False)
    assert (result.returncode, as_json(result)["outcome"]) == (2, "refused")
    assert "no-such.yaml" in result.stderr and "Traceback" not in result.stderr


def test_no_arguments_show_the_verbs() -> None:
    result = run()
    assert "calibrate" in result.stdout + result.stderr


def test_a_dry_run_prints_the_plan_and_opens_nothing(tmp_path: Path) -> None:
    result = run("calibrate", "--robot", "hp3j.yaml", "--dry-run", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "115 deg/s" in result.stdout
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("bus", "told"),
    [
        ("virtual:hp3j", "SIMULATED: no real robot moves (bus virtual:hp3j)"),
        ("socketcan:can9", "REAL: the robot on socketcan:can9 moves"),
    ],
)
def test_a_plan_says_first_whether_a_real_robot_moves(bus: str, told: str) -> None:
    options = CalibrateOptions("hp3j", bus=bus, joints=("5",))
    planned = plan_calibration(options)
    console = Console(record=True, width=150)
    print_plan(console, planned.plan, planned.order.setup)
    assert console.export_text().startswith(told)


def test_a_plan_tells_each_joints_limits_and_which_of_them_another_file_states(tmp_path: Path) -> None:
    site = tmp_path / "site.yaml"
    dropped = "".join(f'  "{name}": null\n' for name in range(4))
    site.write_text(
        f'schema: frictid.robot/1\nextends: hp3j.yaml\nname: site\njoints:\n{dropped}  "5": {{max_torque_nm: 9.0}}\n'
    )
    planned = plan_calibration(CalibrateOptions(str(site)))
    console = Console(record=True, width=200)
    print_plan(console, planned.plan, planned.order.setup)
    told = console.export_text()
    assert [entry.joint for entry in planned.plan.joints] == ["4", "5"]
    assert "of 9.0" in told and "of 28.5" in told
    assert "position_max_rad" in told and "of joint 5 are inherited from hp3j.yaml" in told
    assert "max_torque_nm of joint 4 are inherited from hp3j.yaml" in told.replace("\n", " ")


def test_a_dry_run_in_json_carries_the_plan() -> None:
    plan = as_json(run("calibrate", "--robot", "hp3j.yaml", "--dry-run", "--joint", "1", "--json"))
    assert plan["schema"] == "frictid.calibrate/1"
    assert plan["outcome"] == "ok"
    assert plan["plan"]["joints"][0]["joint"] == "1"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["calibrate", "--robot", "no-such.yaml", "--yes"], "no-such.yaml"),
        (["calibrate", "--robot", "hp3j", "--joint", "7", "--yes"], "no joint named '7'"),
        (["calibrate", "--robot", "hp3j", "--amplitude", "20", "--yes"], "has no unit"),
        (["calibrate", "--robot", "hp3j", "--velocity", "2rad", "--yes"], "is not a unit of angular velocity"),
        (["calibrate", "--robot", "hp3j", "--amplitude", "400deg", "--yes"], "leaves its limits"),
        (["calibrate", "--robot", "hp3j", "--velocity", "150deg/s", "--joint", "1", "--yes"], "planned speed"),
        (["calibrate", "--robot", "hp3j", "--method", "magic", "--yes", "--joint", "5"], "magic"),
        (["calibrate", "--robot", "hp3j"], "--yes"),
        (["identify", "no-such.csv"], "no-such.csv"),
        (["compare", "no-such.yaml", "--truth", "hp3j"], "no-such.yaml"),
    ],
)
def test_a_users_mistake_is_exit_2_with_a_reason(arguments: list[str], said: str, tmp_path: Path) -> None:
    result = run(*arguments, cwd=tmp_path)
    assert result.returncode == 2, result.stderr
    assert said in " ".join(result.stderr.replace("│", " ").split())
    assert "Traceback" not in result.stderr
    assert result.stdout == ""
    assert not list(tmp_path.rglob("samples*")), "nothing may have been started"


@pytest.mark.parametrize(
    ("arguments", "said", "schema"),
    [
        (("compensate", "--json"), "Missing option '--robot'", "frictid.compensate/1"),
        (("calibrate", "--robot", "hp3j.yaml", "--json", "--bogus"), "No such option", "frictid.calibrate/1"),
        (("calibrate", "--json", "-A", "3"), "has no unit", "frictid.calibrate/1"),
        (("profile", "shwo", "--json"), "No such command", "frictid.profile/1"),
        (("gap", "check", "--cases", "x", "--json"), "Invalid value", "frictid.gap_check/1"),
    ],
)
def test_json_is_one_object_for_a_mistyped_command_too(arguments: tuple[str, ...], said: str, schema: str) -> None:
    result = run(*arguments)
    told = as_json(result)
    assert (result.returncode, told["outcome"], told["schema"]) == (2, "refused", schema)
    assert said in told["error"]["what"] and "--help" in told["error"]["next_step"]
    assert said in result.stderr and "Traceback" not in result.stderr


def test_a_port_that_is_taken_is_one_object_too() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        told = run("dashboard", "--json", "--port", str(other.getsockname()[1]))
    assert told.returncode == 3 and "cannot be had" in as_json(told)["error"]["what"]


def test_a_travel_too_short_for_the_torque_is_refused_beforehand(tmp_path: Path) -> None:
    result = run("calibrate", "--robot", "hp3j", "--joint", "1", "--amplitude", "5deg", "--yes", "--json", cwd=tmp_path)
    assert result.returncode == 2
    refusal = as_json(result)
    assert refusal["outcome"] == "refused"
    assert "predicted torque" in refusal["error"]["what"]
    assert "213.1 N m" in refusal["error"]["what"]


def test_errors_keep_file_line_and_column(tmp_path: Path) -> None:
    site = tmp_path / "site.yaml"
    site.write_text("schema: frictid.robot/1\nextends: hp3j.yaml\nname: mine\njoints:\n  '1':\n    gear_ration: 224\n")
    result = run("check", "--robot", str(site))
    assert result.returncode == 2
    assert "site.yaml:6:5" in result.stderr
    assert "gear_ratio" in result.stderr, "the nearest known key is suggested"


@pytest.mark.parametrize(
    ("driver", "option", "meant"), [("virtual", "fault", "faults"), ("cia402", "watchdog", "watchdog_ms")]
)
def test_a_misspelt_option_is_told_with_its_place(tmp_path: Path, driver: str, option: str, meant: str) -> None:
    site = tmp_path / "site.yaml"
    site.write_text(
        f"schema: frictid.robot/1\nextends: hp3j.yaml\nname: mine\ndriver: {driver}\noptions:\n  {option}: 1\n"
    )
    result = run("check", "--robot", str(site))
    assert result.returncode == 2
    assert "site.yaml:6:" in result.stderr
    assert f"did you mean {meant}?" in result.stderr


@pytest.mark.slow
def test_what_a_driver_misses_is_told_with_its_place() -> None:
    result = run("check", "--robot", "hp3j.yaml", "--bus", "serial:/dev/nowhere")
    assert result.returncode == 2
    assert "hp3j.yaml:" in result.stderr
    assert "joints.0.options.pulses_per_degree" in result.stderr


@pytest.mark.parametrize("verb", [("check",), ("calibrate", "--joint", "5", "--yes")])
def test_a_simulated_joint_that_cannot_be_is_told_with_its_place(verb: tuple[str, ...], tmp_path: Path) -> None:
    site = tmp_path / "site.yaml"
    site.write_text(
        "schema: frictid.robot/1\nextends: hp3j.yaml\nname: mine\nbus: virtual:mine\njoints:\n  '1':\n    simulated:\n"
        "      effects:\n        backlash:\n          gap_deg: 1\n"
    )
    result = run(verb[0], "--robot", str(site), *verb[1:], cwd=tmp_path)
    assert result.returncode == 2, result.stderr
    assert "site.yaml:10:" in result.stderr
    assert "gap_deg" in result.stderr
    assert not (tmp_path / "runs").exists() or not list((tmp_path / "runs").rglob("*.mcap"))


def completed(line: str, **environment: str) -> list[str]:
    """What a shell offers after ``line``."""
    words = line.split(" ")
    told = {"_FRICTID_HIL_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)}
    told |= environment
    offered = subprocess.run([PROGRAM], env={**os.environ, **told}, capture_output=True, text=True, check=False)
    return offered.stdout.split()


@pytest.mark.slow
def test_the_shell_completes_verbs_robot_files_and_choices() -> None:
    assert "calibrate" in completed("frictid-hil cal")
    assert "hp3j.yaml" in completed("frictid-hil calibrate --robot hp")
    assert completed("frictid-hil calibrate --method al") == ["aligned"]
    assert completed("frictid-hil compensate --task ") == ["hand", "track"]


@pytest.mark.slow
def test_the_shell_completes_joints_robots_and_profiles(tmp_path: Path) -> None:
    assert completed("frictid-hil calibrate --robot hp3j.yaml --joint ") == ["0", "1", "2", "3", "4", "5"]
    assert completed("frictid-hil calibrate --robot no-such.yaml --joint ") == []
    home = {"XDG_DATA_HOME": str(tmp_path)}
    joint = JointProfile(
        method="aligned", velocity_rad_s=(1.0, 2.0), torque_nm=(4.0, 5.0), coulomb_nm=Estimate(value=3.0)
    )
    provenance = Provenance(created_utc="2026-03-01T02:00:00Z")
    store = ProfileStore(tmp_path / "frictid-hil" / "store")
    stored = store.add(FrictionProfile(robot="bench", joints={"0": joint}, provenance=provenance))
    assert completed("frictid-hil profile history be", **home) == ["bench"]
    assert completed("frictid-hil report --robot ", **home) == ["bench"]
    assert completed("frictid-hil profile promote 2026", **home) == [stored]
